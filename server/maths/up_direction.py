"""The up direction of a scan from the normals of its surface (Gupta, Arbelaez, Malik, CVPR 2013, sec. 3.1).

Floors and tables face up, walls face across it. From the best of many directions near the cameras' up, the direction
is refined so that it lies along the normals of horizontal surface and across those of walls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from server.maths.sh import spherical_fibonacci

Floats = NDArray[np.float64]

BINS = 64
"""Side of the octahedral map in which normals are counted: bins of about 3 degrees; their means are kept."""
MOST_TILT_DEG = 60.0
"""Greatest angle between up and the cameras' up. Floors are farther off only where a camera looks straight down."""
CANDIDATES = 4096
"""Directions over the sphere from which the search starts: 4 degrees apart."""
WIDTHS_DEG = (10.0, 7.0, 5.0, 5.0, 5.0, 5.0)
"""Angle within which a normal counts as horizontal surface or wall, by step of the refinement. The last are three
times the deviation of normals in a fused scan (1 to 2 degrees)."""
WALLS, CEILINGS = 0.5, 0.5
"""What a wall, or surface that faces down, counts in the choice of the start, beside surface that faces up."""
WALLS_REFINED = 0.25
"""The same in the refinement, where both are seen: doors and fronts hang less true than floors and tables, on which
objects stand, and a depth camera bends large walls by up to 3 degrees."""
LEAST_SHARE = 0.25
"""Least share of all normals that horizontal surface and walls must have. Of evenly distributed normals, 9 % do."""
LEAST_FIXED = 0.09
"""Least share of all normals that must fix the less certain tilt: horizontal surface, or the smaller of two walls.
Evenly distributed normals give 0.045."""
_TOGETHER = 64
"""Directions that are tried together: their cosines with 2 000 normals fit into a processor's cache."""
_RARE = 5e-5  # share of all normals below which a bin is noise of the measurement


@dataclass(frozen=True)
class UpFit:
    """An up direction that the scan fixes."""

    up: Floats
    """[3] unit, world."""
    horizontal: float
    """Share of all normals that face up or down, within the last of WIDTHS_DEG."""
    vertical: float
    """Share of all normals across `up`."""


class NormalHistogram:
    """Counts unit normals by direction; the memory does not grow with the number of frames."""

    def __init__(self) -> None:
        self._sums = np.zeros((BINS * BINS, 3))
        self._counts = np.zeros(BINS * BINS)

    def add(self, normals: Floats) -> None:
        """Count `normals` [n, 3], unit, world."""
        bins = _octahedral_bins(normals)
        self._counts += np.bincount(bins, minlength=BINS * BINS)
        for axis in range(3):
            self._sums[:, axis] += np.bincount(bins, normals[:, axis], minlength=BINS * BINS)

    def directions(self) -> tuple[Floats, Floats]:
        """[k, 3] unit means of the bins that are not rare, and their shares [k] of all normals."""
        total = self._counts.sum()
        kept = self._counts > max(_RARE * total, 0)
        sums = self._sums[kept]
        return sums / np.linalg.norm(sums, axis=1, keepdims=True), self._counts[kept] / max(total, 1)


def find_up(histogram: NormalHistogram, camera_up: Floats) -> UpFit | None:
    """The up direction within MOST_TILT_DEG of `camera_up` [3], unit, world; None if the normals do not fix one."""
    normals, shares = histogram.directions()
    if not len(normals):
        return None
    up = _best_start(normals, shares, camera_up)
    for width_deg in WIDTHS_DEG:
        is_level, is_wall = _level_and_wall(normals, up, width_deg)
        _, vectors = _scatter(normals, shares * (WALLS_REFINED * is_wall - 1.0 * is_level))
        up = vectors[:, 0] * (1.0 if vectors[:, 0] @ up > 0 else -1.0)
    values, _ = _scatter(normals, shares * (1.0 * is_wall - is_level))
    horizontal, vertical = float(shares @ is_level), float(shares @ is_wall)
    is_fixed = values[1] - values[0] >= LEAST_FIXED and horizontal + vertical >= LEAST_SHARE
    if not is_fixed or up @ camera_up < np.cos(np.radians(MOST_TILT_DEG)):
        return None
    return UpFit(up, horizontal, vertical)


def _level_and_wall(normals: Floats, up: Floats, width_deg: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """[k] which normals lie along `up`, either way, and which across it, within an angle."""
    sine, cosines = np.sin(np.radians(width_deg)), normals @ up
    return cosines**2 > 1 - sine**2, cosines**2 < sine**2


def _scatter(normals: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Eigenvalues [3], ascending, and eigenvectors in columns [3, 3] of the sum of weighted n n^T.

    With walls positive and horizontal surface negative, the first vector minimises the sum of cos^2 over walls plus
    sin^2 over horizontal surface (Gupta et al.); the step to the second value says how well the scan fixes it.
    """
    values, vectors = np.linalg.eigh((normals * weights[:, None]).T @ normals)
    return values, vectors


def _best_start(normals: Floats, shares: Floats, camera_up: Floats) -> Floats:
    """[3] of directions near `camera_up`, the one that most normals lie along or across."""
    starts = spherical_fibonacci(CANDIDATES)
    starts = starts[starts @ camera_up > np.cos(np.radians(MOST_TILT_DEG))]
    parts = np.array_split(starts, max(len(starts) // _TOGETHER, 1))
    counted = np.concatenate([_counted(part, normals, shares) for part in parts])
    # Cameras are held about level: a wall that one looks up at is else taken for the floor that another looks down at.
    levelness = (starts @ camera_up) ** 2
    best: Floats = starts[np.argmax(counted * levelness)]
    return best


def _counted(starts: Floats, normals: Floats, shares: Floats) -> Floats:
    """[n] what lies along or across each of these directions [n, 3]."""
    cosines = (starts @ normals.T).astype(np.float32)
    shares_single = shares.astype(np.float32)
    sine = np.sin(np.radians(WIDTHS_DEG[0]))
    level = np.sqrt(1 - sine**2)
    above, below, across = cosines > level, cosines < -level, np.abs(cosines) < sine
    return np.asarray(above @ shares_single + CEILINGS * (below @ shares_single) + WALLS * (across @ shares_single))


def _octahedral_bins(normals: Floats) -> NDArray[np.int64]:
    """[n] bins of the octahedral map (Meyer et al. 2010)."""
    flat = normals / np.abs(normals).sum(axis=1, keepdims=True)
    x, y = flat[:, 0], flat[:, 1]
    below = flat[:, 2] < 0
    u = np.where(below, (1 - np.abs(y)) * np.where(x < 0, -1.0, 1.0), x)
    v = np.where(below, (1 - np.abs(x)) * np.where(y < 0, -1.0, 1.0), y)
    places = [np.clip(((axis + 1) / 2 * BINS).astype(np.int64), 0, BINS - 1) for axis in (u, v)]
    return np.asarray(places[1] * BINS + places[0])
