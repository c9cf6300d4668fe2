"""Materials: base colour, roughness and metalness, constant or from textures (glTF 2.0's model)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class Beyond(IntEnum):
    """Wrap mode of a texture; the numbers of include/textures.clh."""

    REPEAT = 0
    CLAMP = 1
    MIRROR = 2


@dataclass(frozen=True, eq=False)
class Texture:
    """An image with its wrap modes."""

    image: NDArray[np.uint8]
    """[h, w, 3] RGB, rows from the top: sRGB for base colour, linear for roughness and metalness."""
    beyond: tuple[Beyond, Beyond] = (Beyond.REPEAT, Beyond.REPEAT)
    """Wrap mode in u and in v."""
    alpha: NDArray[np.uint8] | None = None
    """[h, w] opacity; None: opaque or not needed."""


@dataclass(frozen=True, eq=False)
class Material:
    """A material without the factor of its base colour, which is in the mesh's vertex colours."""

    roughness: float = 1.0
    """Perceptual roughness, 0 to 1: the microfacets' alpha is its square."""
    metalness: float = 0.0
    color_texture: Texture | None = None
    """Multiplies the vertex colours."""
    surface_texture: Texture | None = None
    """Green multiplies the roughness, blue the metalness."""
    cutoff: float | None = None
    """Alpha cutoff: less opaque parts are removed; None: opaque."""
    opacity: float = 1.0
    """Multiplies the alpha of the base colour's texture."""


MATTE = Material()
"""Default material."""
