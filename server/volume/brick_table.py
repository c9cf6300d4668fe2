"""Maps bricks of the volume to slots of the pool. Host only; the device has a copy of `slots`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.input.measure import GREATEST_DEPTH_M

BRICK = 8
NO_SLOT = -1
AWAY_SLOT = 0
"""Slot of every brick that is released to the host: its voxels are never seen, all its octets solid."""

Indices = NDArray[np.int32]
"""[n] indices of bricks in the grid, x fastest."""


class BrickTable:
    """Slots by brick and bricks by slot; slots count from 1."""

    def __init__(self, bricks: tuple[int, int, int]) -> None:
        self.slots = np.full(bricks[::-1], NO_SLOT, np.int32)
        """[z, y, x]"""
        self._brick_of_slot = np.empty(0, np.int32)
        self._last_requested = np.zeros(self.slots.size, np.int32)
        self._is_settled = np.zeros(self.slots.size, np.bool_)

    def grow(self, capacity: int) -> None:
        """Grow to `capacity` slots."""
        added = np.full(capacity - len(self._brick_of_slot), NO_SLOT, np.int32)
        self._brick_of_slot = np.concatenate([self._brick_of_slot, added])

    def resident(self) -> Indices:
        """All bricks with a slot of their own, in the order of their slots."""
        return self._brick_of_slot[self._brick_of_slot >= 0]

    def slots_of(self, indices: Indices) -> Indices:
        """[n] slots."""
        return self.slots.ravel()[indices]

    def take(self, indices: Indices) -> Indices:
        """Give each brick the lowest free slot. Returns the slots."""
        free = np.flatnonzero(self._brick_of_slot < 0)[: len(indices)].astype(np.int32)
        self._brick_of_slot[free] = indices
        self.slots.ravel()[indices] = free + 1
        return free + 1

    def leave(self, indices: Indices, slot: int) -> None:
        """Free the slots of bricks that have one; `slot`: AWAY_SLOT or NO_SLOT."""
        slots = self.slots_of(indices)
        self._brick_of_slot[slots[slots > AWAY_SLOT] - 1] = NO_SLOT
        self.slots.ravel()[indices] = slot

    def touch(self, indices: Indices, frame: int) -> None:
        """Note that a frame has requested these bricks."""
        self._last_requested[indices] = frame
        self._is_settled[indices] = False

    def last_requested(self, indices: Indices) -> NDArray[np.int32]:
        """[n] frames that requested the bricks last."""
        return self._last_requested[indices]

    def settle(self, indices: Indices, before: int) -> Indices:
        """Bricks that no frame has requested since `before`; each once, until it is requested again."""
        idle = indices[(self._last_requested[indices] < before) & ~self._is_settled[indices]]
        self._is_settled[idle] = True
        return idle

    def coordinates(self, indices: Indices) -> Indices:
        """[n, 3] x, y, z."""
        z, y, x = np.unravel_index(indices, self.slots.shape)
        return np.stack([x, y, z], axis=-1).astype(np.int32)

    def in_camera(
        self, indices: Indices, volume_from_camera: NDArray[np.float64], voxel_m: float
    ) -> NDArray[np.float64]:
        """[n, 3] centres of bricks in camera space, metres."""
        centers = (self.coordinates(indices) + 0.5) * (BRICK * voxel_m)
        placed: NDArray[np.float64] = (centers - volume_from_camera[:3, 3]) @ volume_from_camera[:3, :3]
        return placed


def in_view(camera: CameraModel, centers: NDArray[np.float64], voxel_m: float) -> NDArray[np.bool_]:
    """[n] whether bricks with centres [n, 3] in camera space touch the camera's view frustum, or nearly."""
    radius = 0.5 * np.sqrt(3) * (BRICK + 2) * voxel_m  # of the brick and the voxels that interpolation reads around it
    x, y, z = np.abs(centers[:, 0]), np.abs(centers[:, 1]), centers[:, 2]
    side_x = (max(camera.cx, camera.width - 1 - camera.cx) + 0.5) / camera.fx  # farthest pixel from the axis
    side_y = (max(camera.cy, camera.height - 1 - camera.cy) + 0.5) / camera.fy
    near = (z > -radius) & (z < GREATEST_DEPTH_M + radius)
    beside_x = (x - side_x * z) < radius * np.hypot(1, side_x)
    beside_y = (y - side_y * z) < radius * np.hypot(1, side_y)
    seen: NDArray[np.bool_] = near & beside_x & beside_y
    return seen
