"""Which rays are traced from patches towards emitters."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from server.light.arrivals import begin_arrivals
from server.light.shell.bright_surface import BrightSurface
from server.light.shell.emitters import CELL_M
from server.light.shell.patches import GRIDS, PATCH_M, Patches
from server.light.shell.picture import Seen, SeenBright
from server.opencl.engine import Engine
from server.volume.volume import Volume
from tests.scenes.analytic import Floats

LAMPS = np.array([0.15, 0.15, 0.15]) + 2 * CELL_M * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])


def show(surface: BrightSurface, at: Floats) -> None:
    facing = np.array([[0.0, 0.0, -1.0]])
    surface.add(SeenBright(at[None], facing, np.ones((1, 3)), np.array([0.01]), at + facing[0]), at[None])


def patches_before_the_lamps() -> Patches:
    """25 in each grid, in a plane."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(5) * PATCH_M, np.arange(5) * PATCH_M))
    patches = Patches()
    at, facing = np.stack([x, y, np.full(25, -0.5)], axis=1), np.tile([0.0, 0.0, 1.0], (25, 1))
    patches.add(Seen(at, facing, np.zeros((25, 3)), np.zeros(25), np.zeros(25)))
    patches.traced_in[:] = 1
    return patches


def test_only_what_is_not_known_is_traced(engine: Engine) -> None:
    """All emitters from patches whose rays are traced anew; from the others the one that has moved."""
    volume = Volume(engine, (-1.0, -1.0, -1.0, 2.0, 2.0, 2.0), 0.05)  # nothing stands between
    patches, surface = patches_before_the_lamps(), BrightSurface()

    def asked_by(traced: NDArray[np.int64]) -> list[tuple[int, int]]:
        begun = surface.begin_trace(volume, patches, traced)
        groups = [one.rays for one in begun]
        surface.end_trace(volume, begun, begin_arrivals(engine, volume, groups).results())
        return [group.shape for group in groups]

    for lamp in LAMPS:
        show(surface, lamp)
    used = patches.used
    assert asked_by(used) == [(25 * GRIDS, 3)]
    assert asked_by(used[:2]) == [(2, 3)]
    for _ in range(4):
        show(surface, LAMPS[1] + np.array([0.1, 0.0, 0.0]))
    surface.visibility[used, surface.emitters()[1][0]] = 0  # what is known stays
    assert asked_by(used[:2]) == [(2, 3), (25 * GRIDS - 2, 1)]
    rows = surface.emitters()[1]
    visible = surface.visibility[np.ix_(used, rows)]
    assert (visible[:2] == 1).all()
    assert (visible[2:] == [0, 1, 1]).all()
