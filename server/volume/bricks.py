"""Voxels of bricks on the host, for meshing and saving."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

_SIDE = 8


@dataclass(frozen=True)
class Bricks:
    """Voxels of n bricks. Voxel i of the whole grid has its centre at (i + 0.5) voxel_m from the volume's origin."""

    indices: NDArray[np.int32]
    """[n, 3] brick coordinates x, y, z: its first voxel is 8 times that."""
    tsdf: NDArray[np.float32]
    """[n, 8 z, 8 y, 8 x] signed distance in truncations, in [-1, 1], positive in front; 0 where never seen."""
    weight: NDArray[np.float32]
    """[n, 8, 8, 8] 0 = never seen."""
    colors: NDArray[np.float32]
    """[n, 8, 8, 8, 3] linear RGB in [0, 1]; 0 where there is none."""
    color_weight: NDArray[np.uint8]
    """[n, 8, 8, 8] 1 + the weight of the mean, in pictures; 0 = no colour. 1: only seen under another light."""

    @classmethod
    def joined(cls, parts: Sequence[Bricks]) -> Bricks:
        """The bricks of all parts."""
        everything = [unpack_bricks(np.empty((0, 3), np.int32), *_no_voxels()), *parts]
        return cls(*(np.concatenate([getattr(part, field.name) for part in everything]) for field in fields(cls)))


def unpack_bricks(indices: NDArray[np.int32], voxels: NDArray[Any], packed: NDArray[np.uint32]) -> Bricks:
    """Bricks in the layout of the pool: voxels [n, 512] float2 (tsdf, weight) and colours [n, 512]."""
    shape = (len(indices), _SIDE, _SIDE, _SIDE)
    pairs = voxels.view(np.float32).reshape(*shape, 2)
    colors, color_weight = unpack_colors(packed.reshape(shape))
    return Bricks(indices, pairs[..., 0].copy(), pairs[..., 1].copy(), colors, color_weight)


def unpack_colors(packed: NDArray[np.uint32]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Linear RGB [..., 3] and color_weight [...] of packed voxel colours.

    Bits 31..23 r, 22..14 g, 13..6 b hold sqrt(c) times their greatest value; bits 5..0 color_weight of Bricks.
    """
    codes = np.stack([packed >> 23, (packed >> 14) & 511, (packed >> 6) & 255], axis=-1).astype(np.float32)
    return np.square(codes / np.array([511, 511, 255], np.float32)), (packed & 63).astype(np.uint8)


def less_weight(packed: NDArray[np.uint32], share: float) -> NDArray[np.uint32]:
    """Packed voxel colours [...] whose means have lost `share` of their weight, rounded. Twin of brick_pool.cl."""
    stored = packed & 63
    left = (np.maximum(stored, 1) - 1).astype(np.float32) * np.float32(1 - share) + np.float32(0.5)
    return np.asarray(packed - stored + np.where(stored > 0, left.astype(np.uint32) + 1, 0), np.uint32)


def _no_voxels() -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    return np.empty((0, 2 * _SIDE**3), np.float32), np.empty((0, _SIDE**3), np.uint32)
