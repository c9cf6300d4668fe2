"""Float64 twin of cl_kernels/indirect.cl: an exact walk to the voxel that a ray meets."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tests.reference.visibility import walk

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def gather_hits(
    positions: Floats,
    normals: Floats,
    free: Bools,
    directions: Floats,
    solid: Bools,
    colors: Floats,
    has_color: Bools,
    voxel_m: float,
    ray_length_m: float,
    every: int,
    least_cosine: float,
) -> Floats:
    """[rows, cols, 4] sums of cosine times radiance and of cosine, times `every`, over the hidden directions followed.

    Per sample: positions, normals [rows, cols, 3], free [rows, cols, count], directions [rows, cols, count, 3]. Per
    voxel [z, y, x]: solid, colors [3], has_color. Of hidden directions those are followed whose number, from
    (col + 2 row) % every, is a multiple of `every`.
    """
    rows, cols = free.shape[:2]
    cosine = np.einsum("rcjk,rck->rcj", directions, normals)
    hidden = (cosine >= least_cosine) & ~free
    first = (np.arange(cols) + 2 * np.arange(rows)[:, None]) % every
    followed = hidden & ((first[..., None] + hidden.cumsum(axis=-1) - 1) % every == 0)
    row, col, _ = np.nonzero(followed)
    origins = positions + voxel_m * normals
    z, y, x = walk(solid, voxel_m, origins[row, col], directions[followed], ray_length_m)[1].T
    counted = (z >= 0) & has_color[z, y, x]
    radiance = np.append(colors[z, y, x], np.ones((len(z), 1)), axis=1)
    hits = np.zeros((rows, cols, 4))
    np.add.at(hits, (row, col), (every * counted * cosine[followed])[:, None] * radiance)
    return hits
