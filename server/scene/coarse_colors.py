"""Base colour at a few points of a mesh, computed on the host from a coarse mip level of its textures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from server.scene.materials import Beyond, Texture
from server.scene.mesh import Mesh
from server.scene.mipmaps import decoded, shrunk

COARSE_SIDE = 32
"""Longest side of the mip level that is read."""

Floats = NDArray[np.float64]


def colors_at(mesh: Mesh, triangles: NDArray[np.int64], shares: Floats) -> Floats:
    """[n, 3] linear base colour in `triangles` [n] at barycentric coordinates `shares` [n, 3]."""
    corners = mesh.triangles[triangles]
    colors: Floats = (mesh.vertex_colors[corners].astype(np.float64) * shares[..., None]).sum(axis=1)
    uv = (mesh.texture_uv[corners, :2].astype(np.float64) * shares[..., None]).sum(axis=1)
    number = mesh.material_of[triangles]
    for k, material in enumerate(mesh.materials):
        own = number == k
        if material.color_texture is not None and own.any():
            colors[own] *= _nearest_texels(material.color_texture, uv[own])
    return colors


def _nearest_texels(texture: Texture, uv: Floats) -> NDArray[np.float32]:
    """[n, 3] linear."""
    image = decoded(shrunk(texture.image, COARSE_SIDE, is_srgb=True), is_srgb=True)
    height, width = image.shape[:2]
    x, y = (_texel(uv[:, k], size, texture.beyond[k]) for k, size in ((0, width), (1, height)))
    texels: NDArray[np.float32] = image[y, x]
    return texels


def _texel(at: Floats, size: int, beyond: Beyond) -> NDArray[np.int64]:
    if beyond is Beyond.CLAMP:
        inside = at
    elif beyond is Beyond.REPEAT:
        inside = at - np.floor(at)
    else:
        inside = 1 - np.abs(at - 2 * np.floor(at / 2) - 1)
    return np.clip(np.floor(inside * size), 0, size - 1).astype(np.int64)
