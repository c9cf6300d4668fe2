"""Which rays are traced from patches towards emitters."""

from __future__ import annotations

import numpy as np
import pytest

from server.light.arrivals import PendingArrivals
from server.light.shell import bright_surface
from server.light.shell.bright_surface import CELL_M, BrightSurface
from server.light.shell.patches import PATCH_M, Patches
from server.light.shell.picture import Seen, SeenBright
from server.opencl.engine import Engine
from server.volume.volume import Volume
from tests.scenes.analytic import Floats

LAMPS = np.array([0.15, 0.15, 0.15]) + 2 * CELL_M * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])


def show(surface: BrightSurface, at: Floats) -> None:
    facing = np.array([[0.0, 0.0, -1.0]])
    surface.add(SeenBright(at[None], facing, np.ones((1, 3)), np.array([0.01]), at + facing[0]), at[None])


def patches_before_the_lamps() -> Patches:
    """25 of them, in a plane."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(5) * PATCH_M, np.arange(5) * PATCH_M))
    patches = Patches()
    at, facing = np.stack([x, y, np.full(25, -0.5)], axis=1), np.tile([0.0, 0.0, 1.0], (25, 1))
    patches.add(Seen(at, facing, np.zeros((25, 3)), np.zeros(25), np.zeros(25)))
    patches.traced_in[:] = 1
    return patches


def test_only_what_is_not_known_is_traced(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    """All emitters from patches whose rays are traced anew; from the others the one that has moved."""
    begin, asked = bright_surface.begin_arrivals, []

    def counted(engine: Engine, volume: Volume, points: Floats, normals: None, directions: Floats) -> PendingArrivals:
        asked.append(directions.shape[:2])
        return begin(engine, volume, points, normals, directions)

    monkeypatch.setattr(bright_surface, "begin_arrivals", counted)
    volume = Volume(engine, (-1.0, -1.0, -1.0, 2.0, 2.0, 2.0), 0.05)  # nothing stands between
    patches, surface = patches_before_the_lamps(), BrightSurface()
    for lamp in LAMPS:
        show(surface, lamp)
    used = patches.used
    for traced, expected in ((used, [(25, 3)]), (used[:2], [(2, 3)])):
        surface.end_trace(surface.begin_trace(engine, volume, patches, traced))
        assert asked == expected
        asked.clear()
    for _ in range(4):
        show(surface, LAMPS[1] + np.array([0.1, 0.0, 0.0]))
    surface.visibility[used, surface.emitters()[1][0]] = 0  # what is known stays
    surface.end_trace(surface.begin_trace(engine, volume, patches, used[:2]))
    assert asked == [(2, 3), (23, 1)]
    rows = surface.emitters()[1]
    visible = surface.visibility[np.ix_(used, rows)]
    assert (visible[:2] == 1).all()
    assert (visible[2:] == [0, 1, 1]).all()
