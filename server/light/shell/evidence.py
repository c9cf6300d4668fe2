"""The rows of the objective: what patches show, and of which region, surface and material they are."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from server.light.shell.patches import MOST_WEIGHT, Patches
from server.light.shell.segments import segments
from server.light.shell.switches import Switches
from server.light.shell.weights import MATERIAL_CHROMA, PATCH_NOISE
from server.maths.normals import normal_weights

DARKEST = 0.002
"""Radiance below which a logarithm says nothing: a code or two of 8-bit sRGB."""
LOG_CHROMA = np.array([[1 / 3, 1 / 3, 1 / 3], [1.0, -1.0, 0.0], [-0.5, -0.5, 1.0]])
"""[3, 3] from log RGB: mean, red against green, blue against both."""
NODES = 64
"""Of the grid of materials along an axis."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Evidence:
    """What n patches show; the letters are those of objective.py."""

    level: Floats
    """[n] y."""
    chroma: Floats
    """[n, 2] q."""
    precision: Floats
    """[n] 1 / S_p^2 of y."""
    is_clipped: NDArray[np.bool_]
    rows: Ints
    """[n] of the patches, region by region."""
    regions: Ints
    """[n] from 0, ascending; those of surface 0, then of 1 and so on."""
    surfaces: Ints
    """[n] from 0."""

    @property
    def mean(self) -> float:
        """Mean radiance that is shown; 1 where all is clipped."""
        usable = self.level[~self.is_clipped]
        return float(np.exp(usable).mean()) if len(usable) else 1.0

    def with_noise(self, variance: Floats) -> Evidence:
        """The same where y has this `variance` [n] besides."""
        return replace(self, precision=self.precision / (1 + self.precision * variance))


def evidence_of(patches: Patches, rows: Ints, switches: Switches) -> Evidence:
    """What the patches in `rows` [n] show; in another order."""
    surfaces = segments(patches.keys[rows], log_chroma(patches.logarithms[rows]))
    regions = _nested(patches.regions[rows], surfaces)
    order = np.argsort(regions, kind="stable")
    rows, regions, surfaces = rows[order], regions[order], surfaces[order]
    logs = log_chroma(patches.logarithms[rows])
    age = patches.weights[rows]
    noise = PATCH_NOISE**2 + patches.variances[rows] / np.maximum(np.minimum(age, MOST_WEIGHT), 1.0)
    precision = np.minimum(age, 1.0) / noise
    return Evidence(
        level=logs[:, 0],
        chroma=logs[:, 1:],
        precision=precision * normal_weights(patches.normals[rows], precision, switches.normals),
        is_clipped=patches.clipped[rows] > 0.5,
        rows=rows,
        regions=regions,
        surfaces=surfaces,
    )


def log_chroma(logarithms: Floats) -> Floats:
    """[n, 3] mean logarithm and two coordinates of chroma of log RGB [n, 3]."""
    return np.asarray(logarithms @ LOG_CHROMA.T)


def _nested(regions: Ints, surfaces: Ints) -> Ints:
    """[n] from 0: parts of `regions` on one surface each, in the order of `surfaces`."""
    numbers = np.unique(regions, return_inverse=True)[1].ravel()
    return np.asarray(np.unique(surfaces * (numbers.max() + 1) + numbers, return_inverse=True)[1].ravel())


def materials_of(chroma: Floats) -> tuple[Ints, Floats]:
    """Nodes [g] of the grid of materials that are near `chroma` [n, 2] of albedo, and their bilinear weights [n, g]."""
    place = np.clip(chroma / MATERIAL_CHROMA + NODES / 2, 0.0, NODES - 1.001)
    low = place.astype(np.int64)
    share = place - low
    columns, weights = [], []
    for right in (0, 1):
        for above in (0, 1):
            columns.append((low[:, 0] + right) * NODES + low[:, 1] + above)
            weights.append(np.abs(1 - right - share[:, 0]) * np.abs(1 - above - share[:, 1]))
    found = np.stack(columns, axis=1)
    is_used = np.bincount(found.ravel(), minlength=NODES * NODES) > 0
    nodes, number = np.flatnonzero(is_used), np.cumsum(is_used) - 1
    entries = np.arange(len(chroma))[:, None] * len(nodes) + number[found]
    sums = np.bincount(entries.ravel(), np.stack(weights, axis=1).ravel(), len(chroma) * len(nodes))
    return nodes, np.asarray(sums.reshape(len(chroma), len(nodes)), np.float64)
