"""Placement: the point, the up direction, the heading and the scale."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from server.scene.mesh import Mesh, UpAxis
from server.scene.placement import Placement, world_from_model

POINT = (1.0, -2.0, 3.0)


def mesh_of(up_axis: UpAxis) -> Mesh:
    """A box from (0, 1, 2) to (2, 4, 10): its middle is (1, 2.5, 6)."""
    vertices = np.array([[0, 1, 2], [2, 1, 2], [2, 4, 10], [0, 4, 10]], np.float32)
    return Mesh(vertices, np.array([[0, 1, 2]], np.int32), vertices * 0, vertices, up_axis)


def place(up: ArrayLike, up_axis: UpAxis = "y", scale: float = 1.0, yaw_deg: float = 0.0) -> NDArray[np.float64]:
    return world_from_model(mesh_of(up_axis), Placement(POINT, scale, yaw_deg), np.asarray(up, np.float64))


def directions(count: int) -> NDArray[np.float64]:
    vectors = np.random.default_rng(0).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("up", directions(20))
@pytest.mark.parametrize(
    ("up_axis", "bottom", "model_up"), [("y", (1, 1, 6), (0, 1, 0)), ("z", (1, 2.5, 2), (0, 0, 1))]
)
def test_bottom_stands_on_the_point_and_up_is_up(
    up: NDArray[np.float64], up_axis: UpAxis, bottom: ArrayLike, model_up: ArrayLike
) -> None:
    matrix = place(7 * up, up_axis, scale=2.5, yaw_deg=33)
    np.testing.assert_allclose(matrix @ [*np.asarray(bottom, float), 1], [*POINT, 1], atol=1e-12)
    np.testing.assert_allclose(matrix[:3, :3] @ np.asarray(model_up) / 2.5, up, atol=1e-12)
    np.testing.assert_allclose(matrix[:3, :3].T @ matrix[:3, :3], 6.25 * np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix[:3, :3]) > 0


@pytest.mark.parametrize(
    ("up", "right", "front"),
    [
        ((0, 1, 0), (1, 0, 0), (0, 0, 1)),  # upright like the model: unturned
        ((0, -1, 0), (1, 0, 0), (0, 0, -1)),  # a camera's axes: facing the camera
        ((0, 0, 1), (1, 0, 0), (0, -1, 0)),
        ((0, 0, -1), (1, 0, 0), (0, 1, 0)),
    ],
)
def test_heading(up: ArrayLike, right: ArrayLike, front: ArrayLike) -> None:
    matrix = place(up)[:3, :3]
    np.testing.assert_allclose(matrix @ [1, 0, 0], right, atol=1e-12)
    np.testing.assert_allclose(matrix @ [0, 0, 1], front, atol=1e-12)
    z_up = place(up, "z")[:3, :3]
    np.testing.assert_allclose(z_up @ [0, -1, 0], front, atol=1e-12)  # front of a z-up model


def test_upright_models_in_upright_worlds_keep_their_axes() -> None:
    np.testing.assert_allclose(place((0, 1, 0), "y")[:3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(place((0, 0, 1), "z")[:3, :3], np.eye(3), atol=1e-12)


@pytest.mark.parametrize("up", [v for v in directions(40) if abs(v[0]) < 0.95])
def test_heading_is_nearest_to_the_worlds_x_and_continuous(up: NDArray[np.float64]) -> None:
    matrix = place(up)[:3, :3]
    right, front = matrix[:, 0], matrix[:, 2]
    assert abs(front[0]) < 1e-12  # turning right or left takes it farther from the world's x
    assert right[0] > 0
    for nudge in 1e-4 * directions(10):
        moved = place(up + nudge)[:3, :3]
        assert np.linalg.norm(moved - matrix) < 1e-3  # seen: 3.3e-4


@pytest.mark.parametrize("up", [(1, 0, 0), (-1, 0, 0), (1, 1e-5, 0)])
def test_up_along_x_still_has_a_heading(up: ArrayLike) -> None:
    matrix = place(up)[:3, :3]
    np.testing.assert_allclose(matrix @ [1, 0, 0], [0, 1, 0], atol=1e-4)
    np.testing.assert_allclose(matrix.T @ matrix, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("up", [(0, 1, 0), (0, -1, 0), (0, 0, 1), (0.2, -0.9, 0.3)])
def test_yaw_turns_counter_clockwise_seen_from_above(up: ArrayLike) -> None:
    up = np.asarray(up, float) / np.linalg.norm(up)
    start, turned = place(up)[:3, 2], place(up, yaw_deg=30)[:3, 2]
    assert start @ turned == pytest.approx(np.cos(np.radians(30)))
    assert np.cross(start, turned) @ up == pytest.approx(np.sin(np.radians(30)))


def test_unplaced_is_left_as_it_is() -> None:
    matrix = world_from_model(mesh_of("z"), Placement(None, 3.0, 45.0), np.array([0.0, -1.0, 0.0]))
    np.testing.assert_array_equal(matrix, np.eye(4))


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf])
def test_impossible_scale(scale: float) -> None:
    with pytest.raises(ValueError, match="scale"):
        Placement(POINT, scale)


@pytest.mark.parametrize("position", [(np.nan, 0.0, 0.0), (0.0, np.inf, 0.0)])
def test_impossible_position(position: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="finite"):
        Placement(position)


@pytest.mark.parametrize("up", [(0, 0, 0), (np.nan, 0, 1), (np.inf, 0, 0)])
def test_impossible_up(up: ArrayLike) -> None:
    with pytest.raises(ValueError, match="no direction"):
        place(up)


@pytest.mark.parametrize(
    ("placement", "words"),
    [
        (Placement(POINT, scale=1e6), "8e\\+06 m long.*another scale"),
        (Placement(POINT, scale=1e-6), "8e-06 m long.*another scale"),
        (Placement((0.0, 0.0, 1e7)), "1e\\+07 m away"),
        (Placement((0.0, -1e300, 0.0)), "m away"),
        (Placement(POINT, scale=1e300), "m long"),
    ],
)
def test_what_cannot_be_drawn_is_refused(placement: Placement, words: str) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        world_from_model(mesh_of("y"), placement, np.array([0.0, 1.0, 0.0]))
    assert "\n" not in str(caught.value)


def test_vertices_that_are_world_coordinates_are_held_to_the_same() -> None:
    vertices = np.array([[3e5, 0, 0], [3e5 + 1, 0, 0], [3e5, 1, 0]], np.float32)
    far = Mesh(vertices, np.array([[0, 1, 2]], np.int32), vertices * 0, vertices, "y")
    with pytest.raises(ValueError, match="m away"):
        world_from_model(far, Placement(None, scale=9.0), np.array([0.0, 1.0, 0.0]))
