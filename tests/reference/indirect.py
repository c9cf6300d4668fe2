"""Float64 twin of cl_kernels/indirect.cl: an exact walk to the voxel that a ray meets (Amanatides & Woo 1987)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def first_solid(
    solid: Bools, voxel_m: float, origins: Floats, directions: Floats, ray_length_m: float
) -> NDArray[np.int64]:
    """[n, 3] the voxel (z, y, x) of `solid` that each unit ray meets first within `ray_length_m`; -1: none."""
    position, size = origins / voxel_m, np.array(solid.shape[::-1])
    slope = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
    cell = np.floor(position).astype(int)
    step = np.sign(slope).astype(int)
    onward = (cell + (step > 0) - position) / slope
    found = np.full((len(origins), 3), -1)
    walking = np.ones(len(origins), bool)
    for _ in range(sum(solid.shape) + 3):
        held = np.clip(cell, 0, size - 1)
        met = walking & ((cell >= 0) & (cell < size)).all(-1) & solid[held[:, 2], held[:, 1], held[:, 0]]
        found[met] = cell[met, ::-1]
        walking &= ~met & (onward.min(-1) < ray_length_m / voxel_m)
        rows, axis = np.flatnonzero(walking), onward.argmin(-1)[walking]
        cell[rows, axis] += step[rows, axis]
        onward[rows, axis] += np.abs(1 / slope[rows, axis])
    return found


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
    z, y, x = first_solid(solid, voxel_m, origins[row, col], directions[followed], ray_length_m).T
    counted = (z >= 0) & has_color[z, y, x]
    radiance = np.append(colors[z, y, x], np.ones((len(z), 1)), axis=1)
    hits = np.zeros((rows, cols, 4))
    np.add.at(hits, (row, col), (every * counted * cosine[followed])[:, None] * radiance)
    return hits
