"""Float64 twin of cl_kernels/near_light.cl."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tests.reference.radiance_transfer import direction_set

Floats = NDArray[np.float64]
IsFree = Callable[[Floats, Floats, Floats], NDArray[np.bool_]]
"""(origins [n, 3], unit directions [n, 3], reach [n] metres) -> whether nothing is in the way."""

STATIC = 1
POOL = 4


def emitter_shares(positions: Floats, normals: Floats, emitters: Floats, lift_m: float, is_free: IsFree) -> Floats:
    """[emitters, points] V max(n.w, 0) / (pi d^2): radiance that white shows per radiant intensity of a point source.

    V: the way from the point, lifted off its surface, to the emitter.
    """
    result = np.zeros((len(emitters), len(positions)))
    for k, emitter in enumerate(emitters):
        towards = emitter - positions
        distance = np.linalg.norm(towards, axis=1)
        cosine = (towards * normals).sum(1) / distance
        way = emitter - (positions + lift_m * normals)
        length = np.linalg.norm(way, axis=1)
        free = is_free(positions + lift_m * normals, way / length[:, None], length)
        result[k] = np.where(free, np.maximum(cosine, 0) / (np.pi * distance**2), 0)
    return result


def remove_lamps(radiance: Floats, shares: Floats, intensities: Floats, albedo: float) -> Floats:
    """[pixels, 4] radiance (rgb, w) less albedo times the lamps' light.

    shares [lamps, pixels], intensities [lamps, 3].
    """
    without = radiance.copy()
    without[:, :3] = np.maximum(radiance[:, :3] - albedo * shares.T @ intensities, 0)
    return without


def pool_sky(
    stride: int,
    positions: Floats,
    normals: Floats,
    labels: NDArray[np.uint8],
    radiance: Floats,
    openness: Floats,
    flatness: Floats,
    least: tuple[float, float],
    voxel_m: float,
    directions: Floats,
    lobes: Floats,
    free: NDArray[np.bool_],
) -> tuple[Floats, Floats, Floats, Floats]:
    """Means over the usable samples of 4 x 4 that lie on the first one's surface, and their view of the lobes.

    positions, normals [h, w, 3], labels [h, w], radiance [h, w, 4]; openness, flatness [rows, cols], `least` of each;
    directions [sets, count, 4], lobes [sets, count, n], free [rows, cols, count].
    -> [pool_rows, pool_cols, ...]: position and share of samples (4), normal (3), colour (3), lobes over white (n).
    """
    height, width = labels.shape
    rows, cols = openness.shape[0] // POOL, openness.shape[1] // POOL
    place, facing, color = np.zeros((rows, cols, 4)), np.zeros((rows, cols, 3)), np.zeros((rows, cols, 3))
    sky = np.zeros((rows, cols, lobes.shape[2]))
    for pool_row in range(rows):
        for pool_col in range(cols):
            members: list[tuple[int, int, int, int, Floats]] = []
            for k in range(POOL * POOL):
                row, col = POOL * pool_row + k // POOL, POOL * pool_col + k % POOL
                y, x = stride // 2 + row * stride, stride // 2 + col * stride
                window = np.ix_(np.clip([y - 1, y, y + 1], 0, height - 1), np.clip([x - 1, x, x + 1], 0, width - 1))
                usable = (radiance[window][..., 3] > 0).all() and (labels[window] == STATIC).all()
                if not usable or openness[row, col] < least[0] or flatness[row, col] < least[1]:
                    continue
                if members:
                    first = members[0][2:4]
                    offset = positions[y, x] - positions[first]
                    off_plane = abs(offset @ normals[first])
                    if normals[y, x] @ normals[first] < 0.9 or off_plane > voxel_m + 0.1 * np.linalg.norm(offset):
                        continue
                members.append((row, col, y, x, radiance[window][..., :3].mean((0, 1))))
            if not members:
                continue
            at = np.array([m[2] for m in members]), np.array([m[3] for m in members])
            place[pool_row, pool_col] = [*positions[at].mean(0), len(members) / POOL**2]
            total = normals[at].sum(0)
            facing[pool_row, pool_col] = total / np.linalg.norm(total)
            color[pool_row, pool_col] = np.mean([m[4] for m in members], axis=0)
            for row, col, *_ in members:
                turned = direction_set(row, col)
                cosine = np.maximum(directions[turned][:, :3] @ facing[pool_row, pool_col], 0)
                weight = cosine * directions[turned][:, 3] * free[row, col] / np.pi
                sky[pool_row, pool_col] += weight @ lobes[turned] / len(members)
    return place, facing, color, sky
