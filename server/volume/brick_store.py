"""Bricks that were moved to the host until a camera needs them again."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from server.volume.bricks import less_weight

_BATCH = 1024


class BrickStore:
    """Exact voxels of bricks on the host, by brick index."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._bricks: dict[int, tuple[NDArray[Any], NDArray[np.uint32]]] = {}
        self._indices: NDArray[np.int32] | None = None

    def __len__(self) -> int:
        return len(self._bricks)

    @property
    def room(self) -> int:
        """Bricks for which the host's budget still has room."""
        return self._capacity - len(self._bricks)

    @property
    def bytes_held(self) -> int:
        """Host memory of the voxels."""
        return sum(voxels.nbytes + colors.nbytes for voxels, colors in self._bricks.values())

    def indices(self) -> NDArray[np.int32]:
        """[n] indices of all bricks."""
        if self._indices is None:
            self._indices = np.fromiter(self._bricks, np.int32, len(self._bricks))
        return self._indices

    def put(self, indices: NDArray[np.int32], voxels: NDArray[Any], colors: NDArray[np.uint32]) -> None:
        """Keep copies of [n, 512] voxels (float2) and colours."""
        for index, voxel, color in zip(indices.tolist(), voxels, colors, strict=True):
            self._bricks[index] = (voxel.copy(), color.copy())
        self._indices = None

    def batches(
        self, indices: NDArray[np.int32] | None = None
    ) -> Iterator[tuple[NDArray[np.int32], NDArray[Any], NDArray[np.uint32]]]:
        """All or the given bricks in batches: indices, voxels [k, 512] float2, colours [k, 512]."""
        indices = self.indices() if indices is None else indices
        for start in range(0, len(indices), _BATCH):
            chosen = indices[start : start + _BATCH]
            yield chosen, *_stacked([self._bricks[index] for index in chosen.tolist()])

    def forget(self, indices: NDArray[np.int32]) -> None:
        """Free bricks."""
        for index in indices.tolist():
            del self._bricks[index]
        self._indices = None

    def forget_colors(self, share: float) -> None:
        """Take `share` of their weight from all means of colour."""
        for index, (voxels, colors) in self._bricks.items():
            self._bricks[index] = voxels, less_weight(colors, share)

    def take(self, indices: NDArray[np.int32]) -> tuple[NDArray[Any], NDArray[np.uint32]]:
        """Remove bricks. Returns their voxels and colours [n, 512]."""
        self._indices = None
        return _stacked([self._bricks.pop(index) for index in indices.tolist()])


def _stacked(bricks: list[tuple[NDArray[Any], NDArray[np.uint32]]]) -> tuple[NDArray[Any], NDArray[np.uint32]]:
    return np.stack([voxels for voxels, _ in bricks]), np.stack([colors for _, colors in bricks])
