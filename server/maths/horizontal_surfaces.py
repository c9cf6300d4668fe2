"""Horizontal surfaces of a scan: floors, tables, shelves, and where on them there is room.

Level points are grouped by height, then into connected areas on a horizontal grid. A cell is free if surface was seen
in it and nothing stands over it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

CELL_M = 0.03
"""Side of a grid cell: pixels of a level surface 3 m away, seen at 20 degrees, are 2 to 3 cm apart."""
MOST_TILT_DEG = 20.0
"""Greatest angle of a level point's normal to up: single normals deviate by 10 degrees in a new scan."""
BAND_M = 0.03
"""Heights within so much are one surface: noise of a depth camera at 3 m, a tilt of 1 degree over 2 m, magazines."""
LEAST_AREA_M2 = 0.03
"""A stool; less is a book or a step of clutter."""
OVER_M = 1.0
"""Height up to which things over a cell make it not free: below a table nothing is placed."""
FLOOR_BELOW_M = 0.9
"""Least height of a camera over the floor, where nothing lower was seen. Of a table it is mostly less."""
FLOOR_SHARE = 0.02
"""Greatest share of the points that may lie lower than the floor: stray depth."""
STEP_M = 0.1
"""What is lower than the floor by less is the floor's own unevenness; what is higher by less is no table."""
_BIN_M = 0.01
_MOST_SURFACES = 12


@dataclass(frozen=True)
class HorizontalSurface:
    """A connected level area that was seen."""

    height_m: float
    """Along up, from the world's origin."""
    area_m2: float
    points: int
    """How many of the points it has: its size in the picture."""
    centers: Floats
    """[k, 3] world: the middles of its free cells, each at the surface's height around it."""
    radii_m: Floats
    """[k] radius of the free disc around each of them."""


@dataclass(frozen=True)
class _Grid:
    """A horizontal grid over all points."""

    axes: Floats
    """[3, 3] rows: two horizontal directions and up."""
    low: Floats
    """[2]"""
    shape: tuple[int, int]

    def cells(self, along: Floats) -> NDArray[np.int64]:
        """[n, 2] cell of each point [n, 3], given along `axes`."""
        return ((along[:, :2] - self.low) / CELL_M).astype(np.int64)

    def mask(self, along: Floats) -> NDArray[np.uint8]:
        """[shape] 1 in cells with a point."""
        mask = np.zeros(self.shape, np.uint8)
        mask[tuple(self.cells(along).T)] = 1
        return mask


def find_horizontal_surfaces(points: Floats, normals: Floats, up: Floats) -> list[HorizontalSurface]:
    """All of at least LEAST_AREA_M2, the largest in the picture first.

    points, normals: [n, 3] world, of the pixels of one frame; up: [3] unit.
    """
    if not len(points):
        return []
    axes = _axes(up)
    along = points @ axes.T
    low = along[:, :2].min(axis=0) - 2 * CELL_M  # two empty cells around, for the closing of gaps
    rows, columns = (int(count) for count in np.ceil((along[:, :2].max(axis=0) - low) / CELL_M) + 3)
    grid = _Grid(axes, low, (rows, columns))
    level = along[normals @ up > np.cos(np.radians(MOST_TILT_DEG))]
    found: list[HorizontalSurface] = []
    for _ in range(_MOST_SURFACES):
        height_m = _commonest_height(level[:, 2])
        if height_m is None:
            break
        is_here = np.abs(level[:, 2] - height_m) < BAND_M
        above = along[(along[:, 2] > height_m + BAND_M) & (along[:, 2] < height_m + OVER_M)]
        found += _areas(grid, level[is_here], above)
        level = level[~is_here]
    return sorted(found, key=lambda surface: -surface.points)


def floor_of(surfaces: list[HorizontalSurface], heights_m: Floats, camera_m: float) -> HorizontalSurface | None:
    """The floor among `surfaces`, if it is in view.

    heights_m: [n] of all points of the frame, camera_m: of the camera, along up. The floor is the lowest surface with
    next to nothing below it, and far enough below the camera.
    """
    lowest = min(surfaces, key=lambda surface: surface.height_m, default=None)
    if lowest is None or lowest.height_m > camera_m - FLOOR_BELOW_M:
        return None
    level = [s for s in surfaces if s.height_m < lowest.height_m + STEP_M]
    floor = max(level, key=lambda surface: surface.area_m2)
    below = (heights_m < floor.height_m - STEP_M).mean()
    return floor if below < FLOOR_SHARE else None


def tables_of(surfaces: list[HorizontalSurface], floor: HorizontalSurface | None) -> list[HorizontalSurface]:
    """Those off the floor, in their order."""
    return [s for s in surfaces if floor is None or s.height_m > floor.height_m + STEP_M]


def _axes(up: Floats) -> Floats:
    across = np.eye(3)[int(np.argmin(np.abs(up)))]
    first = across - (across @ up) * up
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first), up])


def _commonest_height(heights_m: Floats) -> float | None:
    """Median height of the fullest band; None if there are too few points."""
    if len(heights_m) < LEAST_AREA_M2 / CELL_M**2:
        return None
    bins = ((heights_m - heights_m.min()) / _BIN_M).astype(np.int64)
    counts = np.convolve(np.bincount(bins), np.ones(3), mode="same")
    peak_m = float(heights_m.min() + (np.argmax(counts) + 0.5) * _BIN_M)
    return float(np.median(heights_m[np.abs(heights_m - peak_m) < BAND_M]))


def _areas(grid: _Grid, level: Floats, above: Floats) -> list[HorizontalSurface]:
    """The connected areas of points at one height, with what stands over them."""
    square = np.ones((3, 3), np.uint8)
    support = cv2.morphologyEx(grid.mask(level), cv2.MORPH_CLOSE, square).astype(np.uint8)
    free = support * (cv2.dilate(grid.mask(above), square) == 0).astype(np.uint8)
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(support, connectivity=4)
    radii = CELL_M * (cv2.distanceTransform(np.pad(free, 1), cv2.DIST_L2, 5)[1:-1, 1:-1] - 0.5)
    label_of_point = labels[tuple(grid.cells(level).T)]
    found = []
    for label in range(1, count):
        area_m2 = float(statistics[label, cv2.CC_STAT_AREA]) * CELL_M**2
        cells = np.argwhere((labels == label) & (free > 0))
        if area_m2 < LEAST_AREA_M2 or not len(cells):
            continue
        own = level[label_of_point == label]
        height_m, slope = _plane(own)
        middles = grid.low + (cells + 0.5) * CELL_M
        heights = height_m + (middles - own[:, :2].mean(axis=0)) @ slope
        centers = np.column_stack([middles, heights]) @ grid.axes
        found.append(HorizontalSurface(height_m, area_m2, len(own), centers, radii[tuple(cells.T)].astype(np.float64)))
    return found


def _plane(points: Floats) -> tuple[float, Floats]:
    """Height in the middle of `points` [n, 3] along the axes, and slope [2]: up may be a degree off."""
    offset = points - points.mean(axis=0)
    slope = np.linalg.lstsq(offset[:, :2], offset[:, 2], rcond=None)[0]
    residual = offset[:, 2] - offset[:, :2] @ slope
    return float(points[:, 2].mean() + np.median(residual)), np.asarray(slope)
