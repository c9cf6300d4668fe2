"""Float64 twin of cl_kernels/differential_rendering.cl (thesis 7.1)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tests.reference.radiance_transfer import direction_set

Floats = NDArray[np.float64]
IsFree = Callable[[Floats, Floats], NDArray[np.bool_]]
LEAST_SHADING = 0.02
Y_00 = 0.5 / np.sqrt(np.pi)


def _shares(normal: Floats, directions: Floats) -> Floats:
    """[count] cos(theta) dw / pi of directions [count, 4], 0 below the surface."""
    return np.maximum(directions[:, :3] @ normal, 0) * directions[:, 3] / np.pi


def shadow_real(
    positions: Floats,
    normals: Floats,
    stride: int,
    transfer: Floats,
    free: NDArray[np.bool_],
    light: Floats,
    directions: Floats,
    arriving: Floats,
    passes_objects: IsFree,
) -> Floats:
    """R' / R [rows, cols, 4] at the samples, w = 0 without surface; passes_objects(origins, directions).

    positions, normals [h, w, 4]; transfer [rows, cols, n]; free [rows, cols, count]: directions that real things leave
    free; light [n, 3]; directions [sets, count, 4]; arriving [sets, count, 3]: the light's radiance along them.
    """
    rows, cols, _ = transfer.shape
    ratio = np.zeros((rows, cols, 4))
    least = LEAST_SHADING * Y_00 * light[0] + 1e-9
    for row in range(rows):
        for col in range(cols):
            position, normal = (a[stride // 2 + row * stride, stride // 2 + col * stride] for a in (positions, normals))
            if position[3] <= 0 or normal[3] <= 0:
                continue
            turned = direction_set(row, col)
            rays = directions[turned]
            origins = np.tile(position[:3], (len(rays), 1))
            taken = free[row, col] & ~passes_objects(origins, rays[:, :3])
            without = transfer[row, col] @ light
            left = without - (_shares(normal[:3], rays) * taken) @ arriving[turned]
            ratio[row, col, :3] = np.maximum(left, least) / np.maximum(without, least)
            ratio[row, col, 3] = 1
    return ratio


def shading_without(
    count: int, transfer: Floats, light: Floats, openness: float, hit: Floats, unseen: Floats, surface_gain: float
) -> Floats:
    """[3] R of one sample: what reaches it, over pi, without virtual objects.

    count: of its directions; transfer [n], light [n, 3]; hit [4]: of indirect.cl; unseen [3]: what surface that no
    picture shows sends.
    """
    hidden = min(max(1 - openness, 0.0), 1.0)
    known = min(hit[3] / max(count / 4 * hidden, 1e-6), 1.0)
    sent = known * surface_gain * hit[:3] / max(hit[3], 1e-6) + (1 - known) * unseen
    return np.asarray(transfer @ light + hidden * sent)


def shadow_virtual(
    positions: Floats,
    normals: Floats,
    stride: int,
    directions: Floats,
    arriving: Floats,
    cell_m: float,
    voxel_m: float,
    passes_objects: IsFree,
    passes_volume: IsFree,
) -> Floats:
    """Radiance [rows, cols, 4] that virtual and real things take from virtual surfaces, w = 1 where there is one."""
    rows, cols = positions.shape[0] // stride, positions.shape[1] // stride
    occluded = np.zeros((rows, cols, 4))
    for row in range(rows):
        for col in range(cols):
            position, normal = (a[stride // 2 + row * stride, stride // 2 + col * stride] for a in (positions, normals))
            if position[3] <= 0:
                continue
            turned = direction_set(row, col)
            rays = directions[turned]
            off_object, off_volume = (np.tile(position[:3] + d * normal[:3], (len(rays), 1)) for d in (cell_m, voxel_m))
            free = passes_objects(off_object, rays[:, :3]) & passes_volume(off_volume, rays[:, :3])
            occluded[row, col, :3] = (_shares(normal[:3], rays) * ~free) @ arriving[turned]
            occluded[row, col, 3] = 1
    return occluded
