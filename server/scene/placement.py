"""Placement of a virtual object: the transform from model metres to the world."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from protocol.messages import Spot
from server.scene.mesh import Mesh, UpAxis

Matrix = NDArray[np.float64]

SMALLEST_M, LARGEST_M = 1e-4, 1e5
"""Limits of an object's longest side, and of its distance from the world's origin."""

_Y_UP_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_LEAST_HORIZONTAL = 1e-3
"""If the horizontal part of the world's x axis is shorter, it does not define a heading."""


@dataclass(frozen=True)
class Placement:
    """`position_m`: world position of the bottom centre of the bounding box; None: the vertices are world coordinates
    already, and scale and yaw are not used. `yaw_deg` rotates counter-clockwise seen from above.
    `room_from_client`: rigid [4, 4] from the client's world to the room's; None: they are equal.
    Raises ValueError for numbers that are not finite and for a scale that is not positive.
    """

    position_m: tuple[float, float, float] | None = None
    scale: float = 1.0
    yaw_deg: float = 0.0
    room_from_client: Matrix | None = None

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (*(self.position_m or ()), self.scale, self.yaw_deg))):
            raise ValueError("an object's position, scale and yaw must be finite")
        if self.scale <= 0:
            raise ValueError(f"an object's scale is {self.scale}, must be positive")


@dataclass(frozen=True)
class SpotPlacement:
    """A placement whose position is still to be found in a frame, in the client's world. `scale`: None, the size that
    fits. Raises ValueError as Placement does.
    """

    spot: Spot
    scale: float | None = None
    yaw_deg: float = 0.0

    def __post_init__(self) -> None:
        self.at((0.0, 0.0, 0.0), self.scale or 1.0)

    def at(self, position_m: tuple[float, float, float], scale: float) -> Placement:
        """The placement, once position and scale are known."""
        return Placement(position_m, scale, self.yaw_deg)


def requested_placement(
    mesh: Mesh,
    position_m: tuple[float, float, float] | None,
    spot: Spot | None,
    scale: float = 1.0,
    height_m: float | None = None,
    yaw_deg: float = 0.0,
) -> Placement | SpotPlacement:
    """The placement of a request: at a position, or at a spot; `height_m` takes the place of `scale`.

    On an `auto` spot without a height the size is chosen. Raises ValueError as Placement does, and for a flat model
    with a height.
    """
    if height_m is not None:
        scale = scale_of_height(mesh, height_m)
    if spot is None:
        return Placement(position_m, scale, yaw_deg)
    return SpotPlacement(spot, None if spot.on == "auto" and height_m is None else scale, yaw_deg)


def scale_of_height(mesh: Mesh, height_m: float) -> float:
    """The scale at which the model is `height_m` high. Raises ValueError, one line, for a model without height."""
    own = model_size(mesh)[1]
    if own <= 0:
        raise ValueError("the model is flat, a height does not say its size: give a scale")
    return height_m / own


def model_size(mesh: Mesh) -> tuple[float, float]:
    """Diagonal of the floor of the model's box, and its height, in model metres."""
    low, high = mesh.bounds
    size = high - low
    height = float(size["xyz".index(mesh.up_axis)])
    return math.sqrt(max(float(size @ size) - height**2, 0.0)), height


def world_from_model(mesh: Mesh, placement: Placement, up: NDArray[np.float64]) -> Matrix:
    """[4, 4] rotation, uniform scale and translation; `up` [3] is the world direction away from the floor, any length.

    Heading at yaw 0: the model's +x points along the horizontal direction nearest to the world's +x. A model thus keeps
    the axes it was made in where the world is upright in the same way, and faces the first camera (front: +z of a y-up
    model, -y of a z-up one) where the world is that camera's. The heading changes continuously with `up`, except near
    the world's x axis, where the world's +y takes the place of its +x. Raises ValueError if `up` has no direction, and
    as check_size() does.
    """
    check_size(mesh, placement)
    if placement.room_from_client is not None:
        here = replace(placement, room_from_client=None)
        return placement.room_from_client @ world_from_model(mesh, here, placement.room_from_client[:3, :3].T @ up)
    if placement.position_m is None:
        return np.eye(4)
    linear = placement.scale * _yaw(up, placement.yaw_deg) @ _upright(up) @ _y_up(mesh.up_axis)
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    matrix[:3, 3] = np.asarray(placement.position_m) - linear @ bottom_center(mesh)
    return matrix


def check_size(mesh: Mesh, placement: Placement) -> None:
    """Raises ValueError if the object is too small, too large or too far away for float32."""
    low, high = mesh.bounds
    scale = 1.0 if placement.position_m is None else placement.scale
    size_m = float((high - low).max()) * scale
    away_m = max(map(abs, placement.position_m or (*low.tolist(), *high.tolist())))
    if not SMALLEST_M <= size_m <= LARGEST_M:
        raise ValueError(
            f"the object would be {size_m:.3g} m long, must be between {SMALLEST_M:g} and {LARGEST_M:g} m: "
            "choose another scale"
        )
    if away_m > LARGEST_M:
        raise ValueError(f"the object would be {away_m:.3g} m away, more than {LARGEST_M:g} m: choose another place")


def bottom_center(mesh: Mesh) -> NDArray[np.float64]:
    """[3] model metres: centre of the lower side of the bounding box."""
    low, high = mesh.bounds
    center = (low + high) / 2
    axis = "xyz".index(mesh.up_axis)
    center[axis] = low[axis]
    return center


def _y_up(up_axis: UpAxis) -> Matrix:
    return np.eye(3) if up_axis == "y" else _Y_UP_FROM_Z_UP


def _unit_up(up: NDArray[np.float64]) -> NDArray[np.float64]:
    up = np.asarray(up, np.float64)
    length = float(np.linalg.norm(up))
    if not (math.isfinite(length) and length > 1e-9):
        raise ValueError(f"the up direction {up.tolist()} has no direction")
    return up / length


def _upright(up: NDArray[np.float64]) -> Matrix:
    """[3, 3] rotation that takes +y to `up`, and +x to the horizontal direction nearest to the world's +x."""
    up = _unit_up(up)
    for axis in np.eye(3)[:2]:
        right = axis - (axis @ up) * up
        if np.linalg.norm(right) > _LEAST_HORIZONTAL:
            break
    right /= np.linalg.norm(right)
    return np.stack([right, up, np.cross(right, up)], axis=1)


def _yaw(up: NDArray[np.float64], yaw_deg: float) -> Matrix:
    """[3, 3] right-handed rotation about `up` (Rodrigues)."""
    x, y, z = _unit_up(up)
    angle = math.radians(yaw_deg)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: Matrix = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return rotation
