"""Float64 twin of cl_kernels/cell_transfer.cl."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
LEAST_COSINE = 0.05
COLOR_APART = 0.12


@dataclass(frozen=True)
class Pools:
    """Of a picture's pools [pool rows, pool cols], zeros where the middle is not usable."""

    transfer: Floats
    """[..., cells]."""
    seen: Floats
    """[..., 3]."""
    sent: Floats
    """[..., 3]."""
    unseen: Floats
    weights: Floats
    facing: Floats
    """[..., 3]."""
    positions: Floats
    """[..., 3]."""


def clamped_mean(x: Floats, reach: float) -> Floats:
    """Mean of max(x, 0) over cells whose cosines reach so far around x."""
    return np.where(x >= reach, x, np.where(x <= -reach, 0.0, (x + reach) ** 2 / (4 * reach)))


def same_surface(position: Floats, normal: Floats, others: Floats, other_normals: Floats, voxel_m: float) -> Bools:
    """[...] whether samples [..., 3] lie on the plane of one, to a voxel and a tenth of the distance, facing alike."""
    offset = others - position
    off_plane = np.abs(offset @ normal)
    return (off_plane < voxel_m + 0.1 * np.linalg.norm(offset, axis=-1)) & (other_normals @ normal > 0.9)


def same_color(color: Floats, others: Floats) -> Bools:
    """[...] whether every channel differs by at most COLOR_APART of the brighter one."""
    return (np.abs(color - others) <= COLOR_APART * np.maximum(color, others)).all(axis=-1)


def pool(
    position: Floats,
    normal: Floats,
    observed: Floats,
    hits: Floats,
    free: Bools,
    directions: Floats,
    cell_of: NDArray[np.integer],
    centers: Floats,
    half_cell: float,
    unseen: Floats,
    step: int,
    voxel_m: float,
) -> Pools:
    """Per sample [rows, cols]: position, normal [3], observed [4] (w = 1 usable), hits [4] (sums of cosine times
    radiance and of cosine), free [count], directions [count, 3], cell_of [count]; centers [cells, 3]; unseen [3]
    radiance of surface that no picture shows.
    """
    rows, cols = observed.shape[:2]
    shape = (-(-rows // step), -(-cols // step))
    pools = Pools(*(np.zeros((*shape, *more)) for more in ((len(centers),), (3,), (3,), (), (), (3,), (3,))))
    for place in np.ndindex(shape):
        row, col = (i * step for i in place)
        if observed[row, col, 3] <= 0:
            continue
        box = np.s_[
            max(row - step // 2, 0) : min(row + step + step // 2, rows),
            max(col - step // 2, 0) : min(col + step + step // 2, cols),
        ]
        same = same_surface(position[row, col], normal[row, col], position[box], normal[box], voxel_m)
        same &= same_color(observed[row, col, :3], observed[box][..., :3]) & (observed[box][..., 3] > 0)
        mean = normal[box][same].sum(axis=0)
        mean /= np.linalg.norm(mean)
        cosine = directions[box][same] @ mean
        cosine = np.where(cosine < LEAST_COSINE, 0, cosine)
        open_cosine = cosine * free[box][same]
        everything, open_ = (
            np.bincount(cell_of[box][same].ravel(), weight.ravel(), len(centers)) for weight in (cosine, open_cosine)
        )
        openness = open_.sum() / everything.sum() if everything.sum() > 0 else 0.0
        visible = np.full(len(centers), openness)
        np.divide(open_, everything, out=visible, where=everything > 0)
        share = clamped_mean(centers @ mean, half_cell)
        pools.transfer[place] = share / share.sum() * visible
        hidden = max(1 - pools.transfer[place].sum(), 0.0)
        met = hits[box][same].sum(axis=0)
        known = min(met[3] / max(everything.sum() - open_.sum(), 1e-6), 1.0) if met[3] > 0 else 0.0
        radiance = met[:3] / met[3] if met[3] > 0 else np.zeros(3)
        pools.sent[place] = hidden * (known * radiance + (1 - known) * unseen)
        pools.unseen[place] = hidden * (1 - known)
        pools.seen[place] = observed[box][same][:, :3].mean(axis=0)
        pools.weights[place] = same.sum() / (4 * step * step)
        pools.facing[place] = mean
        pools.positions[place] = position[row, col]
    return pools


def met_planes(
    origins: Floats, directions: Floats, planes: Floats, maps: list[Bools], cell_m: float, least_m: float
) -> Bools:
    """[n, m] whether rays from `origins` [n, 3] along `directions` [m, 3] meet a plane where it is taken to be.

    planes [k, 4, 4]: (normal, offset), (across, first edge of the map), (along, likewise), and its box in the map; maps
    [rows, cols] of cells of `cell_m`: where a plane may be. From `least_m` on.
    """
    met = np.zeros((len(origins), len(directions)), bool)
    for ((*normal, offset), (*across, left), (*along, low), box), cells in zip(planes, maps, strict=True):
        with np.errstate(divide="ignore"):
            t = (offset - origins @ np.array(normal))[:, None] / (directions @ np.array(normal))
        points = origins[:, None] + np.where(np.isfinite(t), t, -1.0)[..., None] * directions
        x, y = points @ np.array(across) - left, points @ np.array(along) - low
        inside = (t >= least_m) & (x >= box[0]) & (x <= box[1]) & (y >= box[2]) & (y <= box[3])
        row, col = (
            np.clip(np.floor(a / cell_m), 0, n - 1).astype(int) for a, n in zip((y, x), cells.shape, strict=True)
        )
        met |= inside & cells[row, col]
    return met
