"""Horizontal surfaces of points that lie on a floor, a table and what stands there."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from server.maths.horizontal_surfaces import (
    CELL_M,
    HorizontalSurface,
    find_horizontal_surfaces,
    floor_of,
    tables_of,
)

Floats = NDArray[np.float64]
UP = np.array([0.0, 1.0, 0.0])
FLOOR_M, TABLE_M = -0.2, 0.55
SPACING_M = 0.01


def rectangle(x: tuple[float, float], z: tuple[float, float], height_m: float) -> Floats:
    """Points on a level rectangle."""
    columns, rows = np.meshgrid(np.arange(*x, SPACING_M), np.arange(*z, SPACING_M))
    return np.stack([columns, np.full_like(columns, height_m), rows], axis=-1).reshape(-1, 3)


def wall(x: tuple[float, float], y: tuple[float, float], z: float) -> Floats:
    columns, heights = np.meshgrid(np.arange(*x, SPACING_M), np.arange(*y, SPACING_M))
    return np.stack([columns, heights, np.full_like(columns, z)], axis=-1).reshape(-1, 3)


def scene(noise_m: float = 0.0) -> tuple[Floats, Floats]:
    """A floor of 3 x 2 m, a table of 1.2 x 0.8 m over it with a box in one half, a wall: points and normals [n, 3]."""
    level = [rectangle((-1.5, 1.5), (0, 2), FLOOR_M), rectangle((-0.6, 0.6), (1, 1.8), TABLE_M)]
    box = [rectangle((0.1, 0.5), (1.1, 1.6), TABLE_M + 0.1), wall((0.1, 0.5), (TABLE_M + 0.04, TABLE_M + 0.1), 1.1)]
    parts = [(points, UP) for points in (*level, box[0])] + [(box[1], -np.eye(3)[2])]
    parts += [(wall((-1.5, 1.5), (FLOOR_M, 2.0), 2.0), -np.eye(3)[2])]
    points = np.concatenate([points for points, _ in parts])
    normals = np.concatenate([np.tile(normal, (len(points), 1)) for points, normal in parts])
    return points + np.random.default_rng(0).normal(0, noise_m, points.shape), normals


def best(surface: HorizontalSurface) -> tuple[Floats, float]:
    index = int(np.argmax(surface.radii_m))
    return surface.centers[index], float(surface.radii_m[index])


@pytest.mark.parametrize("noise_m", [0.0, 0.004])
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.5, -1.2, 2.0)])
def test_floor_and_table_are_found_wherever_up_is(noise_m: float, turn: tuple[float, float, float]) -> None:
    rotation = Rotation.from_rotvec(turn)
    points, normals = scene(noise_m)
    up = rotation.apply(UP)
    found = find_horizontal_surfaces(rotation.apply(points), rotation.apply(normals), up)
    floor = floor_of(found, rotation.apply(points) @ up, camera_m=1.2)
    assert floor is not None
    table = tables_of(found, floor)[0]
    assert floor.height_m == pytest.approx(FLOOR_M, abs=1e-3)
    assert table.height_m == pytest.approx(TABLE_M, abs=1e-3)
    border_m2 = 2 * CELL_M * (1.2 + 0.8)
    assert table.area_m2 == pytest.approx(1.2 * 0.8, abs=border_m2)
    np.testing.assert_allclose(table.centers @ up, TABLE_M, atol=2e-3)


def test_nothing_is_free_under_the_table_or_at_the_box() -> None:
    points, normals = scene()
    found = find_horizontal_surfaces(points, normals, UP)
    floor = floor_of(found, points @ UP, camera_m=1.2)
    table = tables_of(found, floor)[0]
    assert floor is not None
    under = (np.abs(floor.centers[:, 0]) < 0.6) & (floor.centers[:, 2] > 1) & (floor.centers[:, 2] < 1.8)
    assert not under.any()
    x, z = table.centers[:, 0], table.centers[:, 2]
    assert not ((x > 0.1) & (x < 0.5) & (z > 1.1) & (z < 1.6)).any()
    place, radius_m = best(table)
    # Between the table's left edge and the box are 0.7 m, along the depth 0.8 m; a cell may be lost at each side.
    assert 0.35 - 3 * CELL_M < radius_m <= 0.35 + CELL_M
    assert place[0] == pytest.approx(-0.25, abs=2 * CELL_M)


def test_a_floor_has_nothing_below_it_and_is_far_below_the_camera() -> None:
    points, normals = scene()
    on_table = (points[:, 1] > TABLE_M - 0.1) & (points[:, 2] < 1.9)  # nothing lower is seen
    only_table = find_horizontal_surfaces(points[on_table], normals[on_table], UP)
    assert floor_of(only_table, points[on_table] @ UP, camera_m=TABLE_M + 0.6) is None
    assert tables_of(only_table, None)[0].height_m == pytest.approx(TABLE_M, abs=1e-3)
    taken_for_a_floor = floor_of(only_table, points[on_table] @ UP, camera_m=TABLE_M + 1.4)
    assert taken_for_a_floor is not None
    below = np.concatenate([points, wall((-0.5, 0.5), (FLOOR_M - 0.8, FLOOR_M - 0.2), 2.0)])
    found = find_horizontal_surfaces(points, normals, UP)
    assert floor_of(found, below @ UP, camera_m=1.2) is None
    assert floor_of([], points @ UP, camera_m=1.2) is None


def test_slopes_and_specks_are_no_surfaces() -> None:
    points, normals = scene()
    slope = Rotation.from_rotvec([np.radians(35), 0, 0]).apply(normals)
    assert find_horizontal_surfaces(points, slope, UP) == []
    speck = rectangle((0, 0.1), (0, 0.1), 0.0)
    assert find_horizontal_surfaces(speck, np.tile(UP, (len(speck), 1)), UP) == []
    assert find_horizontal_surfaces(np.zeros((0, 3)), np.zeros((0, 3)), UP) == []
