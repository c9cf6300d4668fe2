"""Float64 twin of cl_kernels/track.cl: projective point-to-plane ICP (Newcombe et al. 2011, 3.5; thesis 4.2.1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from server.maths.rigid import inverse_rigid

Floats = NDArray[np.float64]
Intrinsics = tuple[float, float, float, float]


def halve_depth(depth_m: Floats, edge: float) -> Floats:
    """[h // 2, w // 2]: mean of those of 2 x 2 depths within `edge` times the nearest of them; 0 where all are 0."""
    height, width = depth_m.shape[0] // 2, depth_m.shape[1] // 2
    halved = np.zeros((height, width))
    for y, x in np.ndindex(height, width):
        block = depth_m[2 * y : 2 * y + 2, 2 * x : 2 * x + 2]
        there = block[block > 0]
        if there.size:
            halved[y, x] = there[there <= there.min() * (1 + edge)].mean()
    return halved


def view_model(hit: NDArray[np.bool_], positions: Floats, normals: Floats, pose: Floats, stride: int) -> Floats:
    """[4, h, w] depth (0 = none) and normal, camera axes, of every stride-th pixel. pose: volume_from_camera."""
    height, width = hit.shape[0] // stride, hit.shape[1] // stride
    taken = np.s_[: height * stride : stride, : width * stride : stride]
    depth = (positions[taken] - pose[:3, 3]) @ pose[:3, 2]
    planes = np.stack([depth, *(normals[taken] @ pose[:3, :3]).transpose(2, 0, 1)])
    return np.where(hit[taken], planes, 0)


def pairs(
    view: Floats, depth_m: Floats, view_intrinsics: Intrinsics, intrinsics: Intrinsics, model_from_current: Floats
) -> tuple[Floats, Floats, Floats, NDArray[np.bool_], NDArray[np.bool_], Floats]:
    """Model points v, normals n, measured points T p [h, w, 3] in model axes, whether a model point is in the picture
    and measured there, and the pixel coordinates [h, w, 2] that it falls on."""
    fx, fy, cx, cy = view_intrinsics
    row, column = np.indices(view.shape[1:])
    model = np.stack([(column - cx) / fx, (row - cy) / fy, np.ones(row.shape)], -1) * view[0][..., None]
    seen = model @ inverse_rigid(model_from_current)[:3, :3].T + inverse_rigid(model_from_current)[:3, 3]
    fx, fy, cx, cy = intrinsics
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel = np.nan_to_num(seen[..., :2] / seen[..., 2:] * (fx, fy) + (cx, cy), posinf=-9, neginf=-9)
    size = np.array(depth_m.shape[::-1])
    in_view = (view[0] > 0) & (seen[..., 2] > 0.01) & ((pixel >= -0.5) & (pixel < size - 0.5)).all(-1)
    u, v = np.where(in_view[..., None], np.floor(pixel + 0.5), 0).astype(int).transpose(2, 0, 1)
    depth = depth_m[v, u]
    point = np.stack([(u - cx) / fx * depth, (v - cy) / fy * depth, depth], -1)
    moved = point @ model_from_current[:3, :3].T + model_from_current[:3, 3]
    return model, view[1:].transpose(1, 2, 0), moved, in_view, in_view & (depth > 0), pixel


def sum_equations(
    view: Floats,
    depth_m: Floats,
    view_intrinsics: Intrinsics,
    intrinsics: Intrinsics,
    model_from_current: Floats,
    noise_m: float,
    cutoff: float,
    gate_m: float,
) -> Floats:
    """[32] sums, see the kernel."""
    model, normal, moved, in_view, measured, _ = pairs(view, depth_m, view_intrinsics, intrinsics, model_from_current)
    residual = ((moved - model) * normal).sum(-1) / noise_m
    ratio = (residual / cutoff) ** 2
    used = measured & (ratio < 1) & (np.linalg.norm(moved - model, axis=-1) < gate_m)
    weight, e = np.where(used, (1 - ratio) ** 2, 0)[used], residual[used]
    jacobian = np.concatenate([np.cross(moved, normal), normal], -1)[used] / noise_m
    matrix = (weight[:, None] * jacobian).T @ jacobian
    last = [weight @ e**2, weight.sum(), weight @ view[0][used], measured.sum(), in_view.sum()]
    return np.concatenate([matrix[np.triu_indices(6)], (weight * e) @ jacobian, last])
