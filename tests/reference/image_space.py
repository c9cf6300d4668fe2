"""Float64 twin of cl_kernels/image_space.cl (thesis 6.2, eq. 6.1-6.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.reference.radiance_transfer import direction_set, smooth_normal
from tests.reference.sh import open_transfer

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Views:
    """Auxiliary views: as server.transfer.auxiliary_views.AuxiliaryViews, on the host."""

    axes: Floats
    """[views, 3, 3] rows right, down, forward."""
    depths: Floats
    """[views, side, side]."""
    center: Floats
    distance_m: float
    per_pixel: float
    solid: Bools | None = None
    """[z, y, x] the solid voxels of `voxel_m` as they are now; None: as when the views were drawn."""
    voxel_m: float = 0.0

    def lines(self, view: int) -> Floats:
        """[side, side, 3] lines of sight with 1 along the axis, volume space."""
        side = self.depths.shape[1]
        slope = (np.arange(side) - (side - 1) / 2) * self.per_pixel
        right, down, forward = self.axes[view]
        return slope[:, None, None] * down + slope[None, :, None] * right + forward

    def line(self, view: int, row: int, col: int) -> Floats:
        """[3] the line of sight of one pixel."""
        right, down, forward = self.axes[view]
        middle = (self.depths.shape[1] - 1) / 2
        return self.per_pixel * ((col - middle) * right + (row - middle) * down) + forward

    def eye(self, view: int) -> Floats:
        """[3] volume space."""
        return self.center - self.distance_m * self.axes[view, 2]

    def lit(
        self, view: int, point: Floats, normal: Floats, shift: tuple[float, float], ray_length_m: float, lift_m: float
    ) -> bool:
        """Whether the view sees a surface point: nothing in its pixel is nearer, within reach and above its plane."""
        side = self.depths.shape[1]
        x, y, z = self.axes[view] @ (point - self.eye(view))
        col, row = (
            int(np.clip(np.floor(across / z / self.per_pixel + side / 2 + by), 0, side - 1))
            for across, by in zip((x, y), shift, strict=True)
        )
        depth = self.depths[view, row, col]
        if depth == 0 or depth >= z:
            return True
        met = self.eye(view) + depth * self.line(view, row, col)
        to = met - point
        is_beside = to @ normal <= lift_m or to @ to >= ray_length_m**2
        return bool(is_beside or not self.is_still_there(view, met))

    def is_still_there(self, view: int, met: Floats) -> bool:
        """Whether a block of 4x4x4 voxels half a voxel or two and a half behind `met` has a solid one."""
        if self.solid is None:
            return True
        for behind in (0.5, 2.5):
            voxel = np.trunc(met / self.voxel_m + behind * self.axes[view, 2]).astype(int)[::-1]
            first = np.clip(voxel, 0, np.array(self.solid.shape) - 1) // 4 * 4
            if self.solid[tuple(slice(i, i + 4) for i in first)].any():
                return True
        return False


@dataclass(frozen=True)
class Near:
    """How the camera's own picture is looked into."""

    depths: Floats
    """[h, w] metres, 0 = none."""
    unknown: Bools
    """[h, w] surface that the sensor alone knows."""
    camera_from_volume: Floats
    intrinsics: tuple[float, float, float, float]
    starts: Floats
    """[4, count]."""
    ratio: float
    steps: int
    near_m: float
    ray_length_m: float
    slack: float
    threshold: float

    def visibility(
        self, point: Floats, normal: Floats, direction: Floats, start_m: float, bias_m: float, lift_m: float
    ) -> float:
        """V' of eq. 6.3: least over the samples y whose line of sight meets the surface s before them."""
        turn, shift = self.camera_from_volume[:3, :3], self.camera_from_volume[:3, 3]
        surface, n, w = turn @ point + shift, turn @ normal, turn @ direction
        origin = surface + bias_m * n
        fx, fy, cx, cy = self.intrinsics
        height, width = self.depths.shape
        free = 1.0
        for r in start_m * self.ratio ** np.arange(self.steps):
            y = origin + r * w
            if y[2] <= 1e-3 or r >= self.ray_length_m:
                continue
            u, v = fx * y[0] / y[2] + cx + 0.5, fy * y[1] / y[2] + cy + 0.5
            if not (0 < u < width and 0 < v < height):
                continue
            col, row = int(u), int(v)
            depth = self.depths[row, col]
            if depth == 0 or y[2] - depth <= bias_m or (r >= self.near_m and not self.unknown[row, col]):
                continue
            seen = depth * np.array([(col - cx) / fx, (row - cy) / fy, 1.0])
            if (seen - surface) @ n <= lift_m:
                continue
            t = y * min(depth + self.slack * r, y[2]) / y[2] - origin  # eq. 6.2
            apart = 1 - t @ w / np.linalg.norm(t)
            free = min(free, max(apart, 0.0) / self.threshold)  # eq. 6.3
        return free


def transfer_from_views(
    positions: Floats,
    normals: Floats,
    stride: int,
    radius: int,
    voxel_m: float,
    directions: Floats,
    basis: Floats,
    views: Views,
    view_of: NDArray[np.int32],
    near: Near,
    ray_length_m: float,
    lift_m: float,
) -> tuple[Floats, Floats, Floats]:
    """Transfer [rows, cols, n], openness [rows, cols] (-1: no surface), V' [rows, cols, count] (0 below the horizon).

    positions, normals [h, w, 4]; directions [sets, count, 4]; basis [sets, count, n].
    """
    n, count, half = basis.shape[-1], directions.shape[1], stride // 2
    rows, cols = positions.shape[0] // stride, positions.shape[1] // stride
    transfer, openness = np.zeros((rows, cols, n)), np.full((rows, cols), -1.0)
    visible = np.zeros((rows, cols, count))
    for row, col in np.ndindex(rows, cols):
        x, y = half + col * stride, half + row * stride
        if positions[y, x, 3] <= 0 or normals[y, x, 3] <= 0:
            continue
        point = positions[y, x, :3]
        normal, _ = smooth_normal(positions, normals, x, y, radius, voxel_m)
        chosen = direction_set(row, col)
        share = np.maximum(directions[chosen, :, :3] @ normal, 0) * directions[chosen, :, 3] / np.pi
        shift = ((col % 2) / 2 - 0.25, (row % 2) / 2 - 0.25)
        phase = row % 2 * 2 + col % 2
        for j in np.flatnonzero(share > 0):
            direction = directions[chosen, j, :3]
            if views.lit(int(view_of[chosen, j]), point, normal, shift, ray_length_m, lift_m):
                visible[row, col, j] = near.visibility(
                    point, normal, direction, near.starts[phase, j], voxel_m, voxel_m
                )
        blocked = share * (1 - visible[row, col])
        transfer[row, col] = open_transfer(normal, round(n**0.5)) - blocked @ basis[chosen]
        openness[row, col] = 1 - blocked.sum() / share.sum()
    return transfer, openness, visible
