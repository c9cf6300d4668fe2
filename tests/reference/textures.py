"""Float64 twin of include/textures.clh: textures are lists of levels of linear values, finest first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Levels = list[Floats]
"""[h, w, 3] each."""


def halved(values: Floats) -> Floats:
    """The next level: sides halved downwards, each texel the mean over the area it covers, by an exact integral."""
    for axis in (0, 1):
        size = values.shape[axis]
        edges = np.linspace(0, size, max(size // 2, 1) + 1)
        moved = np.moveaxis(values, axis, 0)
        running = np.concatenate([np.zeros((1, *moved.shape[1:])), np.cumsum(moved, axis=0)])
        low = np.minimum(np.floor(edges).astype(int), size - 1)
        share = (edges - low).reshape(-1, *[1] * (moved.ndim - 1))
        at_edges = running[low] + share * moved[low]
        means = np.diff(at_edges, axis=0) / np.diff(edges).reshape(-1, *[1] * (moved.ndim - 1))
        values = np.moveaxis(means, 0, axis)
    return values


def inside(x: Floats, beyond: int) -> Floats:
    """Coordinates brought into 0 to 1: 0 repeats, 1 stays at the edge, 2 mirrors."""
    if beyond == 1:
        return np.clip(x, 0, 1)
    if beyond == 0:
        return x - np.floor(x)
    rest = x - 2 * np.floor(x / 2)
    return np.where(rest > 1, 2 - rest, rest)


def bilinear(values: Floats, uv: Floats, beyond: tuple[int, int]) -> Floats:
    """[..., 3] between the centres of the four texels around `uv` [..., 2]."""
    height, width = values.shape[:2]
    axes = []
    for k, size in ((0, width), (1, height)):
        place = inside(uv[..., k], beyond[k]) * size - 0.5
        low = np.floor(place).astype(int)
        pair = [low % size, (low + 1) % size] if beyond[k] == 0 else [np.clip(low + i, 0, size - 1) for i in (0, 1)]
        axes.append((pair, (place - low)[..., None]))
    (x, x_share), (y, y_share) = axes
    rows = [values[y[i], x[0]] * (1 - x_share) + values[y[i], x[1]] * x_share for i in (0, 1)]
    return rows[0] * (1 - y_share) + rows[1] * y_share


def trilinear(levels: Levels, uv: Floats, detail: Floats, beyond: tuple[int, int]) -> Floats:
    """[..., 3] at a level of detail [...]: 0 the finest; between two levels, their mixture."""
    detail = np.clip(detail, 0, len(levels) - 1)
    fine = np.minimum(np.floor(detail).astype(int), max(len(levels) - 2, 0))
    result = np.zeros((*uv.shape[:-1], 3))
    for k in range(len(levels)):
        weight = np.where(fine == k, 1 - (detail - fine), 0) + np.where(fine + 1 == k, detail - fine, 0)
        result += weight[..., None] * bilinear(levels[k], uv, beyond)
    return result


def sample_texture(
    levels: Levels, uv: Floats, du: Floats, dv: Floats, beyond: tuple[int, int], most_probes: int
) -> Floats:
    """[n, 3] mean over the ellipse that a pixel covers: uv [n, 2], its change from pixel to pixel in x and in y."""
    size = np.array(levels[0].shape[1::-1])
    jacobian = np.stack([du * size, dv * size], axis=-1)  # texels by pixels
    directions, lengths, _ = np.linalg.svd(jacobian)
    most, least = lengths[:, 0], np.maximum(lengths[:, 1], 1.0)
    least = np.minimum(least, np.maximum(most, 1.0))
    probes = np.clip((most / least + 0.999).astype(int), 1, most_probes)
    detail = np.log2(np.maximum(most / probes, least))
    step = directions[:, :, 0] * (most / probes)[:, None] / size
    total = np.zeros((len(uv), 3))
    for i in range(most_probes):
        at = uv + (i - (probes - 1) / 2)[:, None] * step
        total += np.where((i < probes)[:, None], trilinear(levels, at, detail, beyond), 0)
    return total / probes[:, None]
