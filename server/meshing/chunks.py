"""Arranges sparse bricks as small dense blocks of voxels that overlap by one voxel."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from server.volume.volume import BRICK, Bricks

CHUNK_BRICKS = 4
SIDE = CHUNK_BRICKS * BRICK + 1
"""Voxels along an axis; the last one is the far corner of the last cells."""


@dataclass(frozen=True)
class Chunk:
    """A block of SIDE^3 voxels."""

    first_voxel: NDArray[np.int64]
    """[3] x, y, z of element [0, 0, 0] in the volume's voxels."""
    tsdf: NDArray[np.float32]
    """[SIDE z, SIDE y, SIDE x] truncation units, positive in front."""
    seen: NDArray[np.bool_]
    """[SIDE, SIDE, SIDE] whether tsdf is valid."""
    colors: NDArray[np.float32]
    """[SIDE, SIDE, SIDE, 3] linear RGB."""
    colored: NDArray[np.bool_]
    """[SIDE, SIDE, SIDE] whether colors is valid."""


class ChunkedBricks:
    """Bricks in chunks, in a fixed order."""

    def __init__(self, bricks: Bricks) -> None:
        self._bricks = bricks
        indices = bricks.indices.astype(np.int64)
        self._size = indices.max(axis=0, initial=0) + 1
        keys = self._keys(indices)
        self._order = np.argsort(keys, kind="stable")
        self._sorted_keys = keys[self._order]
        self._chunks = np.unique(indices[:, ::-1] // CHUNK_BRICKS, axis=0)[:, ::-1]

    def __len__(self) -> int:
        return len(self._chunks)

    def __iter__(self) -> Iterator[Chunk]:
        return (self._assemble(chunk * CHUNK_BRICKS) for chunk in self._chunks)

    def _keys(self, indices: NDArray[np.int64]) -> NDArray[np.int64]:
        keys: NDArray[np.int64] = (indices[..., 2] * self._size[1] + indices[..., 1]) * self._size[0] + indices[..., 0]
        return keys

    def _rows(self, indices: NDArray[np.int64]) -> NDArray[np.int64]:
        """Row of each brick index [..., 3]; -1 if there is none."""
        inside = ((indices >= 0) & (indices < self._size)).all(axis=-1)
        keys = self._keys(indices)
        place = np.minimum(np.searchsorted(self._sorted_keys, keys), len(self._sorted_keys) - 1)
        return np.where(inside & (self._sorted_keys[place] == keys), self._order[place], -1)

    def _assemble(self, first_brick: NDArray[np.int64]) -> Chunk:
        bricks = self._bricks
        shape = (SIDE,) * 3
        chunk = Chunk(
            first_brick * BRICK,
            np.zeros(shape, np.float32),
            np.zeros(shape, np.bool_),
            np.zeros((*shape, 3), np.float32),
            np.zeros(shape, np.bool_),
        )
        offsets = np.array(list(product(range(CHUNK_BRICKS + 1), repeat=3)), np.int64)
        for offset, row in zip(offsets, self._rows(first_brick + offsets), strict=True):
            if row >= 0:
                to, of = zip(*(_overlap(BRICK * int(o)) for o in offset[::-1]), strict=True)
                chunk.tsdf[to] = bricks.tsdf[row][of]
                chunk.seen[to] = bricks.weight[row][of] > 0
                chunk.colors[to] = bricks.colors[row][of]
                chunk.colored[to] = bricks.color_weight[row][of] > 0
        return chunk


def _overlap(start: int) -> tuple[slice, slice]:
    """Slices of the chunk and of a brick that overlap, for a brick that begins at `start` on the chunk's axis."""
    last = min(start + BRICK, SIDE)
    return slice(start, last), slice(0, last - start)
