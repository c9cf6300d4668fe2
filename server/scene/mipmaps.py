"""Builds the tables that include/textures.clh reads: materials, and textures with all mip levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from server.scene.colors import linear_from_srgb
from server.scene.materials import Material, Texture

_SRGB, _LINEAR = 0, 256
"""Offsets of the sRGB and of the linear values in CHANNEL_VALUES."""

_LINEAR_OF_SRGB_BYTE = linear_from_srgb(np.arange(256) / 255.0)
CHANNEL_VALUES: NDArray[np.float32] = np.concatenate([_LINEAR_OF_SRGB_BYTE, np.arange(256, dtype=np.float32) / 255])
"""[512] linear values of texel bytes."""


@dataclass(frozen=True)
class MaterialTables:
    """Material tables for shade_surface of rasterize.cl."""

    materials: NDArray[np.float32]
    """[m, 4] roughness, metalness, texture indices of base colour and of surface; -1 for none."""
    textures: NDArray[np.int32]
    """[n, 4] first level, levels, Beyond in u and in v."""
    levels: NDArray[np.int32]
    """[l, 4] first texel, width, height, offset of its values in CHANNEL_VALUES."""
    texels: NDArray[np.uint8]
    """[texels, 4] RGB and padding, each level's rows from the top."""


def material_tables(materials: Sequence[Material]) -> MaterialTables:
    """Tables of `materials`; a shared texture is stored once."""
    rows: list[tuple[float, ...]] = []
    textures: list[tuple[int, ...]] = []
    levels: list[tuple[int, ...]] = []
    texels: list[NDArray[np.uint8]] = []
    found: dict[tuple[int, int], int] = {}

    def number_of(texture: Texture | None, values: int) -> int:
        if texture is None:
            return -1
        key = (id(texture), values)
        if key not in found:
            chain = mip_chain(texture.image, is_srgb=values == _SRGB)
            textures.append((len(levels), len(chain), *texture.beyond))
            for level in chain:
                height, width = level.shape[:2]
                levels.append((sum(map(len, texels)), width, height, values))
                texels.append(np.pad(level.reshape(-1, 3), ((0, 0), (0, 1))))
            found[key] = len(found)
        return found[key]

    for material in materials:
        numbers = number_of(material.color_texture, _SRGB), number_of(material.surface_texture, _LINEAR)
        rows.append((material.roughness, material.metalness, *numbers))
    return MaterialTables(
        np.array(rows, np.float32).reshape(-1, 4),
        np.array(textures, np.int32).reshape(-1, 4),
        np.array(levels, np.int32).reshape(-1, 4),
        np.concatenate([np.zeros((0, 4), np.uint8), *texels]),
    )


def mip_chain(image: NDArray[np.uint8], *, is_srgb: bool) -> list[NDArray[np.uint8]]:
    """Mip levels of `image` [h, w, 3] down to 1 x 1; each texel is the mean of its area in linear light.

    Odd sides are halved and rounded down; a texel then covers more than two.
    """
    chain = [image]
    values = decoded(image, is_srgb=is_srgb)
    while max(values.shape[:2]) > 1:
        height, width = (max(side // 2, 1) for side in values.shape[:2])
        values = _resized(values, width, height)
        chain.append(encoded(values, is_srgb=is_srgb))
    return chain


def shrunk(image: NDArray[np.uint8], most: int, *, is_srgb: bool) -> NDArray[np.uint8]:
    """`image` [h, w, 3] scaled down to sides of at most `most`, keeping proportions; in bands, to limit memory."""
    height, width = image.shape[:2]
    step = -(-max(height, width) // most)
    if step == 1:
        return image
    rows = max(height // step, 1)
    edges = np.linspace(0, height, -(-rows // 64) + 1)
    bands = [(int(a), int(b)) for a, b in zip(np.rint(edges[:-1]), np.rint(edges[1:]), strict=True)]
    small = []
    for begin, end in bands:
        size = max(width // step, 1), max(round((end - begin) / step), 1)
        small.append(encoded(_resized(decoded(image[begin:end], is_srgb=is_srgb), *size), is_srgb=is_srgb))
    return np.concatenate(small)


def decoded(image: NDArray[np.uint8], *, is_srgb: bool) -> NDArray[np.float32]:
    """Linear values of bytes, any shape."""
    start = _SRGB if is_srgb else _LINEAR
    values: NDArray[np.float32] = CHANNEL_VALUES[start : start + 256][image]
    return values


def encoded(values: NDArray[np.float32], *, is_srgb: bool) -> NDArray[np.uint8]:
    """Bytes of linear values, rounded to the nearest code."""
    if is_srgb:
        values = np.where(values <= 0.0031308, 12.92 * values, 1.055 * np.maximum(values, 1e-9) ** (1 / 2.4) - 0.055)
    return np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)


def _resized(values: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Area average: the mean over the area of each new texel, with partial coverage weighted."""
    return np.asarray(cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA), np.float32)
