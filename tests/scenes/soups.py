"""Soups of random triangles, drawn by the rasteriser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.objects.rasterize import NEAR_M, VirtualSurface, rasterize
from server.objects.virtual_object import VirtualObject
from server.opencl.engine import Engine
from server.scene.mesh import Mesh
from tests.scenes.meshes import soup_of

CAMERA = CameraModel(width=157, height=101, fx=120.0, fy=118.0, cx=80.3, cy=49.1)
EYE = np.eye(4)
FLIPS = 2e-3
"""Share of pixels that may differ from a reference: centres within a subpixel (1/256) of an edge."""


@dataclass(frozen=True)
class Picture:
    """A VirtualSurface on the host; the fields have three channels."""

    covered: NDArray[np.bool_]
    position: NDArray[np.float32]
    normal: NDArray[np.float32]
    color: NDArray[np.float32]
    index: NDArray[np.int32]
    boxes: tuple[Any, ...]

    @property
    def triangle(self) -> NDArray[np.int64]:
        """Number of the triangle of a `soup_of`, -1 for none."""
        return np.where(self.covered, np.rint(self.color[..., 0] * 1024), -1).astype(np.int64)


def download(engine: Engine, surface: VirtualSurface) -> Picture:
    assert surface.material is not None
    fields = [surface.position, surface.normal, surface.base_color, surface.material]
    arrays = [engine.download(a).view(np.float32).reshape(*a.shape, 4) for a in fields]
    index = engine.download(surface.object_index)
    for array in arrays:
        assert np.isfinite(array).all()
        np.testing.assert_array_equal(array[..., 3], index >= 0)
        assert not array[index < 0].any()
    position, normal, color, _ = (array[..., :3] for array in arrays)
    return Picture(index >= 0, position, normal, color, index, surface.boxes)


def draw(
    engine: Engine,
    *placed: tuple[Mesh, NDArray[np.float64]],
    camera: CameraModel = CAMERA,
    view: Any = EYE,
    parts: int = 1,
) -> Picture:
    objects = [(VirtualObject.upload(engine, mesh, cells=8), matrix) for mesh, matrix in placed]
    return download(engine, rasterize(engine, camera, view, objects, parts=parts))


def random_soup(seed: int, count: int, size_m: float, center: tuple[float, float, float], spread_m: float) -> Mesh:
    rng = np.random.default_rng(seed)
    places = rng.uniform(-spread_m, spread_m, (count, 1, 3)) + center
    return soup_of(places + rng.normal(size=(count, 3, 3)) * size_m)


SOUPS = {
    "small, in front": (300, 0.05, (0.0, 0.0, 2.0), 0.8),
    "large, in front": (40, 0.8, (0.0, 0.0, 3.0), 1.0),
    "around the camera": (200, 0.3, (0.0, 0.0, 0.0), 1.0),
    "half through the near plane": (80, 0.1, (0.0, 0.0, NEAR_M), 0.15),
    "far larger than the picture": (20, 500.0, (0.0, 0.0, 3.0), 10.0),
    "farther out than the guard band": (20, 3e5, (0.0, 0.0, 1.0), 10.0),
    "smaller than a pixel": (3000, 0.004, (0.0, 0.0, 2.0), 0.5),
}


def at_pixels(camera: CameraModel, pixels: NDArray[np.float64], depth_m: float = 1.0) -> NDArray[np.float64]:
    """[..., 3] points that project exactly to `pixels` [..., 2]."""
    u, v = pixels[..., 0], pixels[..., 1]
    points = [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)]
    return depth_m * np.stack(points, axis=-1)


EXACT = CameraModel(width=41, height=37, fx=64.0, fy=64.0, cx=0.0, cy=0.0)
"""Whole pixels are exact numbers: edges through pixel centres really pass through them."""


def triangulated_grid(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """[t, 3] two triangles for each cell of points [rows, columns, n], their diagonals alternating."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (x.reshape(-1) for x in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    turn = (np.indices((rows - 1, columns - 1)).sum(axis=0).reshape(-1) % 2).astype(bool)[:, None]
    first = np.where(turn, np.stack([a, b, c], 1), np.stack([a, b, d], 1))
    second = np.where(turn, np.stack([b, d, c], 1), np.stack([a, d, c], 1))
    return np.concatenate([first, second])
