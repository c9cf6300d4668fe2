"""The shell around surface, as the solver finds it."""

from __future__ import annotations

from server.light.shell.shell import Shell, closed_sides, room_axes, shell_around
from tests.scenes.analytic import Floats


def shell_of(
    points: Floats,
    normals: Floats,
    cameras: Floats,
    up: Floats,
    patch_m2: float,
    before: Shell | None = None,
    *,
    has_walls: bool = True,
) -> Shell:
    """`points`, `normals` [n, 3] of surface and `cameras` [m, 3], metres; the others as of server.light.shell.shell."""
    axes = room_axes(normals, up, before)
    closed = closed_sides(points, normals, axes, patch_m2, has_walls=has_walls)
    return shell_around(points, cameras, axes, closed, before)
