"""The scan as the page of results shows it: a coloured point cloud of bounded size, gathered while frames arrive.

Frames add grids of their depth pixels to cells of equal size; a cell shows the mean of its points. Where cells become
too many, they are enlarged.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from client.results.frame_output import Captured
from protocol.frames import CameraModel

Floats = NDArray[np.float64]
MOST_CELLS = 250_000
"""Most cells of the cloud. Each takes nine bytes, together 3 MB of base64."""
ENLARGED = 2**0.5
"""Factor by which cells are enlarged at a time: it halves the number of cells on a surface."""
FIRST_CELL_M = 0.008
"""Size of the first cells: finer than a pixel of a depth camera at 4 m."""
LARGEST_CELL_M = 0.05
"""Size of the largest cells, for clouds with few points; still larger ones show no shapes."""
SAMPLES = 12_000
"""Depth pixels of a frame that are used."""
DENSE_FRAMES, DENSER = 6, 2
"""The first frames, and the factor by which their grid is finer, so that the scan of a short run can be recognised."""
ALL_FRAMES, EVERY = 30, 4
"""So many frames all add points, of later ones every fourth: at 30 frames a second hardly anything is in less than
four, and one takes 6 ms of a processor that may be busy with the next ones."""
GRIDS = 5
"""Number of pixel grids that frames use in turn, so that frames of a still camera differ. Few, since they are kept."""
_PENDING = 200_000
"""Points that are gathered before they are sorted into cells."""
FARTHEST_M = 10.0
"""Depth beyond it is mostly noise, and would make the scan small on the page."""
_CERTAIN_FRAMES = 5
"""From this many frames on, cells that were met in one frame only are left out: noise, and things that moved."""
_MOST_LEFT_OUT = 0.3
"""If more than this share of the cells was met in one frame only, there are too few points for cells of this size."""
_HALF = 1 << 20
"""Cells to each side of the world's origin: 21 bits an axis."""


@dataclass(frozen=True)
class _Cells:
    keys: NDArray[np.int64]
    """[n] distinct."""
    sums: Floats
    """[n, 8] of x, y, z (world, metres), r, g, b (sRGB codes), number of points and number of frames."""


@dataclass(frozen=True)
class ColoredPoints:
    """A point cloud."""

    places_m: Floats
    """[n, 3] world."""
    colors: NDArray[np.uint8]
    """[n, 3] sRGB codes."""
    cell_m: float
    """Distance of neighbours."""

    def packed(self) -> dict[str, Any]:
        """As the page reads it: `count`, `cell_m`, the box `least` and `most` (world, m), and base64 of [count, 3]:
        `places`, little-endian uint16 where 0 and 65535 are the sides of the box, and `colors`, uint8 sRGB.
        """
        least, most = self.places_m.min(0), self.places_m.max(0)
        steps = (self.places_m - least) / np.maximum(most - least, 1e-6) * 65535
        return {
            "count": len(steps),
            "cell_m": round(self.cell_m, 5),
            "least": [round(x, 4) for x in least.tolist()],
            "most": [round(x, 4) for x in most.tolist()],
            "places": _base64(steps.round().astype("<u2")),
            "colors": _base64(self.colors),
        }


class PointCloud:
    """Gathers the points of frames."""

    def __init__(self, camera: CameraModel) -> None:
        self._camera = camera
        self._rays: dict[tuple[int, int, int], tuple[NDArray[np.intp], NDArray[np.intp], Floats]] = {}
        lens = camera.depth_lens
        self._usual_stride = max(1, round((lens.width * lens.height / SAMPLES) ** 0.5))
        self._cell_m = FIRST_CELL_M
        self._cells = _Cells(np.zeros(0, np.int64), np.zeros((0, 8)))
        self._pending: list[Floats] = []
        self._frames = self._seen = 0

    def add(self, captured: Captured, world_from_camera: Floats) -> None:
        """Add a frame; [4, 4] metres. One without depth adds nothing, nor do most after the first ALL_FRAMES."""
        if captured.depth is None:
            return
        self._seen += 1
        if self._seen > ALL_FRAMES and self._seen % EVERY:
            return
        points = self._points(captured, captured.depth, world_from_camera)
        self._pending.append(np.column_stack([points, np.ones((len(points), 2))]))
        self._frames += 1
        if sum(map(len, self._pending)) > _PENDING:
            self._merge()

    def points(self) -> ColoredPoints | None:
        """The cloud so far; None: there are no points."""
        self._merge()
        sums, cell_m = self._certain()
        if len(sums) == 0:
            return None
        means = sums[:, :6] / sums[:, 6:7]
        return ColoredPoints(means[:, :3], means[:, 3:].round().astype(np.uint8), cell_m)

    def _certain(self) -> tuple[Floats, float]:
        """Sums of the cells that are shown, and their size."""
        cells, cell_m = self._cells, self._cell_m
        if self._frames < _CERTAIN_FRAMES:
            return cells.sums, cell_m
        while np.mean(cells.sums[:, 7] < 2) > _MOST_LEFT_OUT and cell_m < LARGEST_CELL_M:
            cell_m *= ENLARGED
            cells = _gathered(cells.sums, cell_m)
        return cells.sums[cells.sums[:, 7] > 1], cell_m

    def _points(self, captured: Captured, depth: NDArray[np.uint16], world_from_camera: Floats) -> Floats:
        """[n, 6] world x, y, z and r, g, b of a grid of pixels, another one for each frame."""
        stride = max(1, self._usual_stride // DENSER) if self._frames < DENSE_FRAMES else self._usual_stride
        shift = self._frames % GRIDS
        rows, columns, rays = self._grid((2 * shift % stride, shift % stride), stride)
        z = depth[rows, columns] * self._camera.depth_scale_m
        used = (z > 0) & (z < FARTHEST_M) & (depth[rows, columns] < 65535)
        in_depth = rays[used] * z[used, None]
        color_from_depth = self._camera.color_from_depth
        in_color = in_depth @ color_from_depth[:3, :3].T + color_from_depth[:3, 3]
        codes, is_seen = self._colors(captured.color, in_color)
        in_world = in_color[is_seen] @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
        return np.hstack([in_world, codes])

    def _colors(self, color: NDArray[np.uint8], points: Floats) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Colours of those points (colour camera, metres) that the picture shows, and which these are."""
        camera = self._camera
        z = np.maximum(points[:, 2], 1e-6)
        u = np.rint(camera.fx * points[:, 0] / z + camera.cx).astype(np.intp)
        v = np.rint(camera.fy * points[:, 1] / z + camera.cy).astype(np.intp)
        is_seen = (points[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < color.shape[1]) & (v < color.shape[0])
        return color[v[is_seen], u[is_seen]], is_seen

    def _grid(self, first: tuple[int, int], stride: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
        """Rows, columns [n] and rays [n, 3] with z = 1 (depth camera) of every `stride`-th pixel from `first` on."""
        if (*first, stride) not in self._rays:
            lens = self._camera.depth_lens
            grid = np.mgrid[first[0] : lens.height : stride, first[1] : lens.width : stride]
            rows, columns = grid.reshape(2, -1)
            matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
            pixels = np.stack([columns, rows], 1).astype(np.float64)[:, None]
            flat = cv2.undistortPoints(pixels, matrix, np.array(lens.distortion))[:, 0]
            self._rays[*first, stride] = rows, columns, np.column_stack([flat, np.ones(len(flat))])
        return self._rays[*first, stride]

    def _merge(self) -> None:
        """Sort what is pending into cells, larger ones if they are too many."""
        if not self._pending:
            return
        parts = [self._cells.sums, *self._pending]
        parts_of_rows = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
        self._cells = _gathered(np.vstack(parts), self._cell_m, parts_of_rows)
        self._pending.clear()
        while len(self._cells.keys) > MOST_CELLS:
            self._cell_m *= ENLARGED
            self._cells = _gathered(self._cells.sums, self._cell_m)


def _gathered(sums: Floats, cell_m: float, parts: NDArray[np.intp] | None = None) -> _Cells:
    """Sums [n, 8] of points whose means lie in one cell, added.

    `parts` [n], ascending: what one frame adds has one number, and counts as one frame in each of its cells.
    """
    steps = np.floor(sums[:, :3] / sums[:, 6:7] / cell_m).clip(-_HALF, _HALF - 1).astype(np.int64) + _HALF
    keys = (steps[:, 0] << 42) | (steps[:, 1] << 21) | steps[:, 2]
    order = np.argsort(keys, kind="stable")  # in a cell, parts stay in their order
    keys, sums = keys[order], sums[order]
    is_first = np.concatenate([[True], keys[1:] != keys[:-1]])[: len(keys)]
    if parts is not None:
        of = parts[order]
        sums[1:][~is_first[1:] & (of[1:] == of[:-1]), 7] = 0
    starts = np.flatnonzero(is_first)
    return _Cells(keys[starts], np.add.reduceat(sums, starts, 0) if len(starts) else sums)


def _base64(values: NDArray[Any]) -> str:
    return base64.b64encode(values.tobytes()).decode("ascii")
