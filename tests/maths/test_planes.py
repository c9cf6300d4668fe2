"""Planes in oriented points: found, kept, and where rays meet what was not seen of them."""

from __future__ import annotations

import numpy as np
import pytest

from server.maths.planes import CELL_M, STEPS_M, PlanePatch, find_planes
from tests.reference.planes import beyond
from tests.scenes.analytic import Floats
from tests.scenes.plane_patches import FLOOR, WALL, corner


def plane_with(planes: list[PlanePatch], normal: Floats) -> PlanePatch:
    found = [plane for plane in planes if plane.normal @ normal > 0.99]
    assert len(found) == 1
    return found[0]


def test_wall_and_floor_are_found() -> None:
    planes = find_planes(*corner(), [])
    assert len(planes) == 2
    assert plane_with(planes, WALL).offset_m == pytest.approx(-2.0, abs=0.002)
    assert plane_with(planes, FLOOR).offset_m == pytest.approx(-1.0, abs=0.002)


def test_axes_are_orthonormal_and_follow_the_plane_it_stands_on() -> None:
    for plane in find_planes(*corner(), []):
        axes = np.stack([plane.across, plane.along, plane.normal])
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-9)
        assert np.abs(axes).max(axis=1) == pytest.approx(np.ones(3), abs=0.02)


def test_scattered_points_are_no_plane() -> None:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(500, 3))
    assert find_planes(rng.random((500, 3)), normals / np.linalg.norm(normals, axis=1, keepdims=True), []) == []


def test_a_plane_found_again_keeps_what_is_known_of_it_and_grows() -> None:
    planes = find_planes(*corner(), [])
    wall = plane_with(planes, WALL)
    wall.steps[:] = 3
    wall.empty[0, 0] = True
    before = wall.seen.copy()
    again = plane_with(find_planes(*corner(shift=0.5), planes), WALL)
    assert again is wall
    assert again.empty[0, 0]
    assert (again.steps == 3).all()
    grown = np.ptp(again.seen, axis=0) - np.ptp(before, axis=0)
    assert sorted(grown) == pytest.approx([0, 0.5], abs=0.03)


def test_how_far_beyond_each_side_a_ray_meets_the_plane() -> None:
    wall = plane_with(find_planes(*corner(noise_m=0.0), []), WALL)
    targets = np.array([[1.4, 0.5, 2.0], [-0.3, 0.5, 2.0], [0.5, -0.7, 2.0], [0.5, 0.5, 2.0], [1.25, -0.35, 2.0]])
    origin = np.array([[0.5, 0.5, 0.5]])
    directions = targets - origin
    far = np.stack(beyond(wall, origin, directions / np.linalg.norm(directions, axis=1, keepdims=True), 0.03))[:, 0]
    assert sorted(far[:, 0])[-1] == pytest.approx(0.4, abs=0.02)
    assert (np.sort(far, axis=0)[:-1, :3] == 0).all()
    assert far[:, 1].max() == pytest.approx(0.3, abs=0.02)
    assert far[:, 2].max() == pytest.approx(0.7, abs=0.02)
    assert (far[:, 3] == 0).all()
    assert np.sort(far[:, 4])[-2:] == pytest.approx([0.25, 0.35], abs=0.02)


def test_rays_that_miss_or_go_where_a_camera_looked_through() -> None:
    wall = plane_with(find_planes(*corner(), []), WALL)
    origin = np.array([[0.5, 0.5, 0.5]])
    ahead, back, beside = np.array([[0.0, 0, 1]]), np.array([[0.0, 0, -1]]), np.array([[1.0, 0, 0]])
    assert np.isfinite(beyond(wall, origin, ahead, 0.03)[0]).all()
    assert np.isinf(beyond(wall, origin, back, 0.03)[0]).all()
    assert np.isinf(beyond(wall, origin, beside, 0.03)[0]).all()
    assert np.isinf(beyond(wall, np.array([[0.5, 0.5, 1.98]]), ahead, 0.03)[0]).all()  # it does not hide from itself
    centers = wall.cell_centers()
    looked = np.linalg.norm(centers[..., :2] - 0.5, axis=-1) < 2 * CELL_M
    wall.empty |= looked
    assert np.isinf(beyond(wall, origin, ahead, 0.03)[0]).all()


def test_the_box_is_what_was_seen_and_what_it_is_taken_to_go_on() -> None:
    wall = plane_with(find_planes(*corner(), []), WALL)
    wall.steps[:] = [0, 2, 0, 4]
    (low_x, low_y), (high_x, high_y) = wall.seen
    np.testing.assert_allclose(wall.box, [low_x, high_x + STEPS_M[2], low_y, high_y + STEPS_M[4]])


def test_scattered_points_are_of_no_plane() -> None:
    """Fewer than three on any: as of a first picture whose depth is nothing but noise."""
    rng = np.random.default_rng(3)
    normals = rng.normal(size=(40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert find_planes(rng.uniform(0, 50, (40, 3)), normals, []) == []


def test_steps_needed_are_those_of_how_far_beyond() -> None:
    """But for rays within float32 of a step's end or of a cell's border."""
    rng = np.random.default_rng(5)
    for plane in find_planes(*corner(), []):
        plane.empty |= rng.random(plane.empty.shape) < 0.2
        origins = np.array([0.5, 0.5, 1.5]) + 0.4 * rng.normal(size=(300, 3))
        directions = rng.normal(size=(400, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        directions[:2] = plane.across, -plane.along  # along it: they never meet it
        exact = np.searchsorted(np.array(STEPS_M), np.stack(beyond(plane, origins, directions, 0.03)))
        of_origins, of_directions = (index.ravel() for index in np.mgrid[:300, :400])
        found = plane.steps_needed(origins, directions, of_origins, of_directions, 0.03).reshape(4, 300, 400)
        assert (found[..., :2] == len(STEPS_M)).all()
        assert (exact < len(STEPS_M)).mean() > 0.1
        assert (found != exact).mean() < 1e-3
