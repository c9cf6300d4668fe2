"""The 6x6 system of a registration: what is solved, what is left alone, and what a twist does."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from server.maths.registration import (
    Floats,
    Scale,
    angle_between,
    distance_between,
    least_information,
    motion_of_twist,
    solve_where_fixed,
    symmetric,
)

SCALE = Scale(np.array([0.1, -0.2, 1.5]), 0.6)


def equations(points: Floats, normals: Floats, moved: Floats) -> tuple[Floats, Floats]:
    """Information and gradient of point-to-plane residuals after all points have moved by the twist `moved`."""
    jacobian = np.concatenate([np.cross(points, normals), normals], axis=1)
    return jacobian.T @ jacobian, jacobian.T @ (jacobian @ moved)


def points_around(seed: int = 0) -> Floats:
    return SCALE.center + np.random.default_rng(seed).normal(0, 0.6, (400, 3))


def test_a_twist_is_the_matrix_exponential() -> None:
    rng = np.random.default_rng(1)
    for size in (0.0, 1e-12, 1e-6, 9.9e-5, 1.01e-4, 1e-2, 1.0, 3.1):
        axis = rng.normal(size=3)
        twist = np.concatenate([size * axis / np.linalg.norm(axis), rng.normal(size=3)])
        x, y, z = twist[:3]
        generator = np.array([[0, -z, y, twist[3]], [z, 0, -x, twist[4]], [-y, x, 0, twist[5]], [0, 0, 0, 0]])
        np.testing.assert_allclose(motion_of_twist(twist), expm(generator), atol=1e-12)


def test_symmetric_fills_both_halves() -> None:
    matrix = np.random.default_rng(2).normal(size=(6, 6))
    matrix += matrix.T
    np.testing.assert_array_equal(symmetric(matrix[np.triu_indices(6)]), matrix)


@pytest.mark.parametrize("scale", [SCALE, Scale(np.zeros(3), 1.0), Scale(np.array([0.0, 0.0, 30.0]), 12.0)])
def test_where_all_is_fixed_the_step_undoes_the_motion(scale: Scale) -> None:
    """Whatever the scale: it decides what is fixed, not where the minimum is."""
    rng = np.random.default_rng(3)
    normals = rng.normal(size=(400, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    moved = rng.normal(0, 0.01, 6)
    solution = solve_where_fixed(*equations(points_around(), normals, moved), scale, 0.0)
    np.testing.assert_allclose(solution.twist, -moved, rtol=1e-7, atol=1e-12)
    assert solution.free.shape == (0, 6)


def test_the_step_is_as_long_as_the_points_move() -> None:
    normals = np.random.default_rng(4).normal(size=(400, 3))
    for moved, length in (
        (np.array([0, 0, 0, 0.03, 0, 0.04]), 0.05),
        (np.concatenate([[0, 0.1, 0], np.cross(SCALE.center, [0, 0.1, 0])]), 0.06),
    ):
        solution = solve_where_fixed(*equations(points_around(), normals, moved), SCALE, 0.0)
        assert solution.step_m == pytest.approx(length)


def plane_equations(moved: Floats) -> tuple[Floats, Floats]:
    points = points_around()
    points[:, 2] = 1.5
    return equations(points, np.tile([0.0, 0.0, -1.0], (400, 1)), moved)


def test_a_plane_fixes_three_motions_of_six() -> None:
    moved = np.array([0.01, -0.02, 0.03, 0.04, 0.05, 0.006])
    solution = solve_where_fixed(*plane_equations(moved), SCALE, 1.0)
    assert len(solution.free) == 3
    before, after = (equations_left(plane_equations, moved + step) for step in (np.zeros(6), solution.twist))
    assert after < 1e-20 * before
    # Its own axes: shifts along x and y first, then the turn about z.
    shifts, turn = solution.free[:2], solution.free[2]
    np.testing.assert_allclose(shifts[:, [0, 1, 2, 5]], 0, atol=1e-9)
    np.testing.assert_allclose(np.abs(turn), [0, 0, 1, 0, 0, 0], atol=1e-9)
    # Along them the camera does not move.
    np.testing.assert_allclose(solution.twist[[2, 3, 4]], 0, atol=1e-9)


def equations_left(make: object, moved: Floats) -> float:
    """What is left of the residuals' energy."""
    information, _ = make(moved)  # type: ignore[operator]
    return float(moved @ information @ moved)


def test_a_sphere_fixes_its_centre_only() -> None:
    """The three free motions are turns about it."""
    normals = np.random.default_rng(5).normal(size=(400, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    moved = np.concatenate([np.zeros(3), [0.01, 0.02, -0.03]])
    information, gradient = equations(SCALE.center + 0.4 * normals, normals, moved)
    solution = solve_where_fixed(information, gradient, SCALE, 1e-3)
    np.testing.assert_allclose(solution.twist[3:] + np.cross(solution.twist[:3], SCALE.center), -moved[3:], atol=1e-9)
    assert solution.free.shape == (3, 6)
    np.testing.assert_allclose(solution.free[:, 3:], 0, atol=1e-6)


def test_nothing_is_fixed_by_nothing() -> None:
    solution = solve_where_fixed(np.zeros((6, 6)), np.zeros(6), SCALE, 0.0)
    assert not solution.twist.any()
    assert solution.free.shape == (6, 6)


def test_the_least_information_is_what_noise_leaves() -> None:
    """A direction with it is known to the tolerance: information is the inverse of a variance."""
    assert least_information(4.0, 0.01, 0.0, 1e9) == pytest.approx(4.0 / 0.01**2)
    rng = np.random.default_rng(6)
    noise = 0.03
    normals = np.array([0.0, 0.0, -1.0]) + noise * rng.normal(size=(400, 3))
    information, gradient = equations(points_around() * [1, 1, 0] + [0, 0, 1.5], normals, np.full(6, 0.01))
    least = least_information(0.0, 1.0, noise, float(np.trace(information[3:, 3:])))
    scale = Scale(SCALE.center, 0.6 * np.sqrt(2))  # as far as the points lie from it
    assert len(solve_where_fixed(information, gradient, scale, 0.0).free) == 0  # the noise looks like structure
    assert len(solve_where_fixed(information, gradient, scale, least).free) == 3


def test_angles_and_distances_of_poses() -> None:
    for angle in (0.0, 1e-9, 1e-3, 1.0, 3.0):
        turned = motion_of_twist(np.array([0.6 * angle, 0.0, 0.8 * angle, 3.0, 0.0, 4.0]))
        assert angle_between(np.eye(4), turned) == pytest.approx(angle, abs=1e-12)
        assert angle_between(turned, np.eye(4)) == pytest.approx(angle, abs=1e-12)
    far = np.eye(4)
    far[:3, 3] = 3, 0, 4
    assert distance_between(np.eye(4), far) == 5
