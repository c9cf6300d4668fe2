"""Float64 twin of cl_kernels/depth_views.cl and include/view_visibility.clh (thesis 6.2.1, 7.3.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]


def octahedral_cells(directions: Floats, cells: int) -> Ints:
    """[n, 2] column and row of unit directions [n, 3] with z >= 0 in an octahedral map of the upper half."""
    on_octahedron = directions / np.abs(directions).sum(-1, keepdims=True)
    u, v = on_octahedron[:, 0] + on_octahedron[:, 1], on_octahedron[:, 0] - on_octahedron[:, 1]
    at = (np.stack([u, v], -1) + 1) / 2 * cells
    return np.clip(np.floor(at).astype(int), 0, cells - 1)


def axes_of(cells_at: Ints, cells: int) -> Floats:
    """[n, 3, 3] rows right, down and ahead of the views of cells [n, 2]: x, y and z turned the shortest way."""
    u, v = ((cells_at + 0.5) * 2 / cells - 1).T
    ahead = np.stack([(u + v) / 2, (u - v) / 2, 1 - np.maximum(np.abs(u), np.abs(v))], -1)
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    axis = np.cross((0.0, 0.0, 1.0), ahead)
    skew = np.zeros((len(ahead), 3, 3))
    skew[:, [0, 1, 2], [1, 2, 0]] = -axis[:, [2, 0, 1]]
    skew -= skew.transpose(0, 2, 1)
    turn = np.eye(3) + skew + skew @ skew / (1 + ahead[:, 2, None, None])  # Rodrigues
    return turn.transpose(0, 2, 1)


@dataclass(frozen=True)
class ObjectViews:
    """One object's."""

    first: Floats
    """[cells, cells, px, px] (row, column of the map; row, column of the picture): where lines along `ahead` first meet
    the object, in cells of its grid from the plane through the middle of it; NaN where they pass."""
    last: Floats
    half_box: Floats
    """[3] half the sides of the grid, cells."""

    @classmethod
    def unpack(cls, texels: NDArray[np.uint32], dims: tuple[int, int, int], cells: int, px: int) -> ObjectViews:
        """From the device's."""
        half_box = np.array(dims) / 2
        diagonal = 2 * np.linalg.norm(half_box)
        halves = np.stack([texels & 0xFFFF, texels >> 16]).reshape(2, cells, cells, px, px)
        along = np.where(halves > 0, (halves - 1.0) / 65534 * diagonal - diagonal / 2, np.nan)
        return cls(along[0], along[1], half_box)

    def lines(self, row: int, col: int) -> tuple[Floats, Floats]:
        """Points [px, px, 3], in cells, where a view's lines pass the plane through the middle, and their direction."""
        cells, px = self.first.shape[0], self.first.shape[2]
        axes = axes_of(np.array([[col, row]]), cells)[0]
        at = (np.arange(px) + 0.5) * 2 / px - 1
        width, height = np.abs(axes[:2]) @ self.half_box
        u, v = at[None, :, None] * width, at[:, None, None] * height
        return self.half_box + u * axes[0] + v * axes[1], axes[2]

    def look(self, points: Floats, normals: Floats, directions: Floats, lift: float) -> tuple[Bools, Floats, Floats]:
        """Whether lines from `points` meet the object above the planes through them by `lift`, after how many cells,
        and how far the answer is from another one, in pixels or cells; all [n, 3], in cells."""
        cells, px = self.first.shape[0], self.first.shape[2]
        sign = np.where(directions[:, 2] < 0, -1.0, 1.0)
        at = octahedral_cells(directions * sign[:, None], cells)
        axes = axes_of(at, cells)
        from_middle = points - self.half_box
        begin = np.maximum(-(directions * from_middle).sum(-1), 0)
        place = np.einsum("nij,nj->ni", axes, from_middle + begin[:, None] * directions)
        half = np.abs(axes[:, :2]) @ self.half_box
        pixel = (place[:, :2] / half + 1) / 2 * px
        inside = ((pixel >= 0) & (pixel < px)).all(-1)
        col, row = np.clip(np.floor(pixel).astype(int), 0, px - 1).T
        low, high = (ends[at[:, 1], at[:, 0], row, col] for ends in (self.first, self.last))
        first, last = (np.where(sign < 0, -b, a) - sign * place[:, 2] + begin for a, b in ((low, high), (high, low)))
        seen = np.stack([(col + 0.5) * 2 / px - 1, (row + 0.5) * 2 / px - 1], -1) * half
        surface = np.concatenate([seen, np.where(sign < 0, low, high)[:, None]], -1)
        height = np.einsum("ni,nij,nj->n", surface, axes, normals) - (normals * from_middle).sum(-1)
        with np.errstate(invalid="ignore"):
            meets = inside & ~np.isnan(low) & (last > 0) & (height > lift)
            sure = np.minimum(np.abs(last), np.abs(height - lift))
        brink = np.minimum(np.abs(pixel - np.round(pixel)).min(-1), np.where(np.isnan(sure), 1, sure))
        return meets, np.where(first > 0, first, last), brink


@dataclass(frozen=True)
class Picture:
    """The camera's, of real surface."""

    camera_from_volume: Floats
    lens: tuple[float, float, float, float]
    depths: Floats
    """[h, w] metres, 0 = none."""

    def march(
        self, origin: Floats, normal: Floats, direction: Floats, first_m: float, ratio: float, ray_length_m: float,
        bias_m: float, most_apart: float,
    ) -> tuple[int, int] | None:  # fmt: skip
        """Row and column of the first surface that a sample lies behind, near the direction and above the plane."""
        fx, fy, cx, cy = self.lens
        turn = self.camera_from_volume[:3, :3]
        eye = turn @ origin + self.camera_from_volume[:3, 3]
        r = first_m
        while r < ray_length_m:
            x, y, z = eye + r * (turn @ direction)
            col, row = int(np.floor(fx * x / z + cx + 0.5)), int(np.floor(fy * y / z + cy + 0.5))
            if z < 1e-3 or not (0 <= col < self.depths.shape[1] and 0 <= row < self.depths.shape[0]):
                return None
            depth = self.depths[row, col]
            if depth > 0 and z - depth > bias_m:
                offset = np.array([(col - cx) / fx * depth, (row - cy) / fy * depth, depth]) - eye
                cosine = offset @ (turn @ direction) / np.linalg.norm(offset)
                if cosine > 1 - most_apart and offset @ (turn @ normal) > 0:
                    return row, col
            r *= ratio
        return None
