"""A box of a room in closed form: floor and two walls were scanned, a lamp hangs on the ceiling that was not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from server.light.shell.objective import Unknowns, step
from server.light.shell.patches import Patches, Seen, hemisphere_rays
from server.light.shell.shell import Shell, shell_around
from server.light.shell.transport import Transport
from tests.scenes.analytic import Floats

SIZE_M = np.array([4.0, 3.6, 2.4])
CAMERA = np.array([3.0, 2.6, 1.5])
UP = np.array([0.0, 0.0, 1.0])
SPACING_M = 0.2
KNOWN = np.array([0.22, 0.2, 0.18])
"""Radiance that the scanned surfaces send."""
ALBEDOS = {0: (0.6, 0.3, 0.2), 1: (0.55, 0.55, 0.5), 2: (0.3, 0.4, 0.6)}
"""Of the wall x = 0, the wall y = 0 and the floor: red, white and blue."""


@dataclass(frozen=True)
class Lamp:
    """A square on the ceiling."""

    center: tuple[float, float]
    side_m: float
    radiance: tuple[float, float, float]


@dataclass
class ShellRoom:
    """A room ready to be solved."""

    patches: Patches
    transport: Transport
    shell: Shell
    unknowns: Unknowns

    def solve(self, steps: int) -> None:
        """Take Gauss-Newton steps."""
        for _ in range(steps):
            step(self.unknowns, self.patches, self.transport, self.shell)


def sent(points: Floats, directions: Floats, lamp: Lamp | None, ambient: Floats) -> tuple[Floats, Floats]:
    """Radiance [n, m, 3] that arrives at `points` [n, 3] along `directions` [n, m, 3], and the arrivals [n, m, 4]."""
    with np.errstate(divide="ignore"):
        far = np.where(directions > 0, SIZE_M - points[:, None], -points[:, None]) / directions
    far = np.where(np.isfinite(far) & (far > 1e-9), far, np.inf)
    axis, distance = far.argmin(-1), far.min(-1)
    along = np.take_along_axis(directions, axis[..., None], -1)[..., 0]
    is_scanned = along < 0  # the faces x = 0, y = 0 and z = 0
    ends = points[:, None] + distance[..., None] * directions
    radiance = np.where(is_scanned[..., None], KNOWN, ambient)
    if lamp is not None:
        on_ceiling = (axis == 2) & (along > 0)
        inside = np.all(np.abs(ends[..., :2] - lamp.center) < lamp.side_m / 2, axis=-1)
        radiance = np.where((on_ceiling & inside)[..., None], lamp.radiance, radiance)
    arrivals = np.zeros((*distance.shape, 4))
    arrivals[is_scanned, :3], arrivals[is_scanned, 3] = KNOWN, distance[is_scanned]
    return radiance, arrivals


def make_room(
    lamp: Lamp | None, ambient: tuple[float, float, float], albedos: dict[int, tuple[float, float, float]] = ALBEDOS
) -> ShellRoom:
    """The room as exact pictures show it."""
    points, normals, colors = [], [], []
    for axis, color in albedos.items():
        first, second = (a for a in range(3) if a != axis)
        u, v = np.meshgrid(*(np.arange(SPACING_M / 2, SIZE_M[a], SPACING_M) for a in (first, second)))
        at = np.zeros((u.size, 3))
        at[:, first], at[:, second] = u.ravel(), v.ravel()
        points.append(at)
        normals.append(np.tile(np.eye(3)[axis], (u.size, 1)))
        colors.append(np.tile(color, (u.size, 1)))
    at, facing, albedo = np.concatenate(points), np.concatenate(normals), np.concatenate(colors)
    patches = Patches()
    rows: NDArray[np.int64] = np.arange(len(at))
    directions = hemisphere_rays(facing, rows).astype(np.float64)
    radiance, arrivals = sent(at, directions, lamp, np.array(ambient))
    shown = np.log(albedo * radiance.mean(axis=1))
    patches.add(Seen(at + 1e-4, facing, shown, np.zeros(len(at)), np.zeros(len(at))))
    # `add` sorts the patches: bring the rays into its order.
    order = np.array([np.abs(at + 1e-4 - position).sum(1).argmin() for position in patches.positions[rows]])
    patches.directions[rows], patches.arrivals[rows] = directions[order], arrivals[order]
    patches.traced_in[rows] = 1
    shell = shell_around(at, facing, np.stack([CAMERA, SIZE_M - 1.0]), UP, None)
    transport = Transport()
    transport.update(patches, rows, shell)
    return ShellRoom(patches, transport, shell, Unknowns())
