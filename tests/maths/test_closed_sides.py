"""How far the sides of a room are closed by scanned wall: little by little, whatever single patches do."""

from __future__ import annotations

import numpy as np
import pytest

from server.light.shell.patches import PATCH_M
from server.light.shell.shell import BEHIND_M, CAMERA_M, WALL_M, closed_sides
from tests.scenes.analytic import Floats
from tests.scenes.shell_room import UP
from tests.scenes.shells import shell_of

PLACE = np.stack(np.meshgrid(np.arange(0.05, 2, 0.15), np.arange(0.05, 2, 0.15)), -1).reshape(-1, 2)
FLOOR = np.column_stack([PLACE, np.zeros(len(PLACE))])
PATCH_M2 = PATCH_M**2
INTO_ROOM = np.array([1.0, 0.0, 0.0])
"""From the side of low x."""


def closed_by(wall: Floats, facing: Floats = INTO_ROOM, beside: Floats | None = None) -> float:
    """Of the side of low x, by patches `wall` [n, 3] on a floor. beside: [m, 3] others, that face up."""
    others = FLOOR if beside is None else np.concatenate([FLOOR, beside])
    facings = np.broadcast_to(facing, wall.shape), np.tile(UP, (len(others), 1))
    points, normals = np.concatenate([wall, others]), np.concatenate(facings)
    return float(closed_sides(points, normals, np.eye(3), PATCH_M2)[0])


def patches_at(x_m: float, count: int) -> Floats:
    return np.column_stack([np.full(count, x_m), PLACE[:count]])


def test_scanned_walls_close_their_sides() -> None:
    """And bring the box from behind the camera to the wall; what faces out of the room closes nothing."""
    wall = patches_at(0.0, len(PLACE))
    points, normals = np.concatenate([wall, FLOOR]), np.repeat([INTO_ROOM, UP], len(PLACE), axis=0)
    np.testing.assert_array_equal(closed_sides(points, normals, np.eye(3), PATCH_M2), [1, 0, 0, 0, 1, 0])
    np.testing.assert_array_equal(closed_sides(points, -normals, np.eye(3), PATCH_M2), np.zeros(6))
    on_a_table = closed_sides(points, normals, np.eye(3), PATCH_M2, has_walls=False)
    np.testing.assert_array_equal(on_a_table, [0, 0, 0, 0, 1, 0])
    some = np.arange(len(wall) - 1, len(points))  # all of the floor, and one patch of wall
    assert 0 < closed_sides(points[some], normals[some], np.eye(3), PATCH_M2)[0] < 0.3
    camera, to_wall = np.array([[0.3, 1.0, 1.5]]), np.array([[-1.0, 0.0, 0.0]])
    behind_m = BEHIND_M + CAMERA_M
    for facing, has_walls, distance_m in ((normals, True, 0.3), (-normals, True, behind_m), (normals, False, behind_m)):
        shell = shell_of(points, facing, camera, UP, PATCH_M2, has_walls=has_walls)
        assert shell.distances(camera, to_wall).min() == pytest.approx(distance_m, abs=0.01)


def test_a_patch_more_closes_little() -> None:
    """A full wall closes its side whatever is missing of it."""
    closed = np.array([closed_by(patches_at(0.0, count)) for count in range(1, 40)])
    assert (np.diff(closed) >= 0).all()
    assert closed[0] < 0.08
    assert np.diff(closed).max() < 0.25
    assert (closed[8:] == 1).all()


@pytest.mark.parametrize("behind", [0.5, 1.0, 1.5])
@pytest.mark.parametrize("count", range(0, 12, 3))
def test_where_the_scan_ends_closes_little_by_little(behind: float, count: int) -> None:
    """A row of floor that begins a millimetre farther out, by about a wall's depth, half or one and a half."""
    rows = (patches_at(-(behind * WALL_M + step_m), count) * [1, 1, 0] for step_m in (-5e-4, 5e-4))
    before, after = (closed_by(patches_at(0.0, 6), beside=row) for row in rows)
    assert before == pytest.approx(after, abs=0.05)


def test_stray_depth_behind_a_wall_leaves_it_closed() -> None:
    """One patch in a hundred a metre behind it; where a third of the scan is, what faces the room is furniture."""
    assert closed_by(patches_at(0.0, 40), beside=patches_at(-1.0, 2)) == 1.0
    assert closed_by(patches_at(0.0, 40), beside=patches_at(-1.0, 100)) == 0.0


def test_a_wall_that_is_turned_closes_less() -> None:
    turns = np.radians(np.arange(0, 91, 5))
    closed = [closed_by(patches_at(0.0, 6), np.array([np.cos(turn), np.sin(turn), 0.0])) for turn in turns]
    assert closed[0] > 0.9
    assert (np.diff(closed) <= 0).all()
    assert closed[-1] == closed[10] == 0.0
    assert np.abs(np.diff(closed)).max() < 0.5
