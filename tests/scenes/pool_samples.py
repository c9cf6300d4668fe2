"""Random samples of two walls that sum up in pools."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cl_array

from protocol.frames import CameraModel
from server.light.cell_transfer import PoolGrid, Pools, PoolWindow, cells_of
from server.maths.lobes import CELL_SR, cell_directions
from server.opencl.engine import Engine
from server.transfer.indirect import Indirect
from server.transfer.radiance_transfer import Directions, Transfer
from server.volume.raycast import Surface
from tests.reference import cell_transfer as twin
from tests.scenes.analytic import Floats
from tests.scenes.solids import float4

VOXEL_M = 0.01
HALF_CELL = float(np.sqrt(CELL_SR / np.pi))
UNSEEN = np.array([0.3, 0.2, 0.1])
SLOTS = 3


@dataclass
class Samples:
    """Random samples of two walls, three colours and half their sky hidden, at every pixel of a small picture."""

    position: Floats
    normal: Floats
    observed: Floats
    hits: Floats
    free: Floats
    rays: Directions
    sets: Floats
    stride: int = 1

    @classmethod
    def random(cls, rows: int, cols: int, rays: Directions, step: int = 8, hidden: float = 0.5) -> Samples:
        rng = np.random.default_rng(rows * cols)
        row, col = np.mgrid[:rows, :cols].astype(float)
        left = col < cols / 2
        position = np.stack([np.where(left, 0.0, col * 0.01), row * 0.01, np.where(left, col * 0.01, 0.0)], axis=-1)
        normal = np.where(left[..., None], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]) + 0.02 * rng.normal(size=(rows, cols, 3))
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        usable = rng.random((rows, cols)) > 0.2
        usable[::step, ::step] = True  # middles of pools
        usable[step, 0] = False
        colors = np.array([[0.5, 0.4, 0.3], [0.5, 0.4, 0.2], [0.9, 0.7, 0.6]])  # far enough apart in some channel
        paint = colors[rng.integers(0, 3, (rows, cols))] * rng.uniform(0.98, 1.02, (rows, cols, 3))
        observed = np.concatenate([np.where(usable[..., None], paint, 0), usable[..., None]], -1)
        cosines = rng.uniform(0, 1.5, (rows, cols, 1)) * rays.count / 8
        hits = np.where(rng.random((rows, cols, 1)) < 0.5, 0, cosines * [0.4, 0.3, 0.2, 1.0])
        free = rng.random((rows, cols, rays.count)) > hidden
        sets = rng.integers(0, 64, (rows, cols, rays.interleave))
        position, normal, observed, hits = (
            a.astype(np.float32).astype(np.float64) for a in (position, normal, observed, hits)
        )
        return cls(position, normal, observed, hits, free, rays, sets)

    @property
    def of_set(self) -> tuple[Floats, Floats]:
        """[rows, cols, count] set and place in it of each sample's directions."""
        number = np.arange(self.rays.count)
        return self.sets[..., number % self.rays.interleave], number

    @property
    def directions(self) -> Floats:
        return self.rays.directions[self.of_set][..., :3].astype(float)

    @property
    def cells(self) -> Floats:
        return cells_of(self.rays.directions.tobytes(), self.rays.count)[self.of_set]

    def upload(
        self, engine: Engine, *, own: bool = False
    ) -> tuple[Surface, CameraModel, Transfer, cl_array.Array, cl_array.Array]:
        """Surface, camera, transfer, observed and hits; `own`: the transfer names no sets."""
        rows, cols = self.observed.shape[:2]
        words = -(-self.rays.count // 32)
        bits = np.zeros((rows, cols, words * 32), np.uint32)
        bits[..., : self.rays.count] = self.free
        mask = (bits.reshape(rows, cols, words, 32) << np.arange(32, dtype=np.uint32)).sum(-1).astype(np.uint32)
        space, stride = engine.workspace, self.stride
        height, width = rows * stride + 1, cols * stride + 2  # a picture's rest, where there is no sample
        pictures = []
        for name, values in (("p", self.position), ("n", self.normal)):
            picture = np.full((height, width, 3), np.nan)
            picture[stride // 2 : rows * stride : stride, stride // 2 : cols * stride : stride] = values
            pictures.append(space.upload(name, float4(picture)))
        unused = space.array("unused", (1,), np.float32)
        sets = None if own else space.upload("sets", self.sets.astype(np.uint8))
        observed, hits = (
            space.upload(name, float4(a[..., :3], a[..., 3])) for name, a in (("o", self.observed), ("h", self.hits))
        )
        return (
            Surface(*pictures, space.array("l", (height, width), np.uint8)),
            CameraModel(width=width, height=height, fx=50.0, fy=50.0, cx=1.0, cy=1.0),
            Transfer(stride, rows, cols, 4, unused, unused, unused, space.upload("mask", mask), sets),
            observed,
            hits,
        )

    def pool(self, engine: Engine, step: int, slot: int = 1, *, own: bool = False) -> tuple[Pools, PoolWindow]:
        """By the kernel, in a window that was full of something else."""
        rows, cols = self.observed.shape[:2]
        surface, camera, transfer, observed, hits = self.upload(engine, own=own)
        grid = PoolGrid(step, -(-rows // step), -(-cols // step))
        window = PoolWindow(engine, grid.count + 5, SLOTS)
        window.raw.fill(-1.0)
        pools = window.pool(slot, grid, surface, camera, transfer, self.rays, observed, Indirect(hits, UNSEEN), VOXEL_M)
        return pools, window

    def twin(self, step: int) -> twin.Pools:
        return twin.pool(
            self.position,
            self.normal,
            self.observed,
            self.hits,
            self.free.astype(bool),
            self.directions,
            self.cells,
            cell_directions(),
            HALF_CELL,
            UNSEEN,
            step,
            VOXEL_M,
        )
