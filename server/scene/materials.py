"""What a surface is made of: base colour, roughness and metalness, constant or from textures (glTF 2.0's model)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class Beyond(IntEnum):
    """What a texture shows beyond its edges; the numbers of include/textures.clh."""

    REPEAT = 0
    CLAMP = 1
    MIRROR = 2


@dataclass(frozen=True, eq=False)
class Texture:
    """A picture and how it goes on beyond its edges."""

    image: NDArray[np.uint8]
    """[h, w, 3] RGB, rows from the top: sRGB where it is a base colour, linear where it is roughness and metalness."""
    beyond: tuple[Beyond, Beyond] = (Beyond.REPEAT, Beyond.REPEAT)
    """In u and in v."""
    alpha: NDArray[np.uint8] | None = None
    """[h, w] opacity; None: opaque, or not asked for."""


@dataclass(frozen=True, eq=False)
class Material:
    """A material less its base colour's factor, which the mesh's vertex colours carry."""

    roughness: float = 1.0
    """Perceptual roughness, 0 to 1: the microfacets' alpha is its square."""
    metalness: float = 0.0
    color_texture: Texture | None = None
    """Multiplies the vertex colours."""
    surface_texture: Texture | None = None
    """Its green multiplies the roughness, its blue the metalness."""
    cutoff: float | None = None
    """What is less opaque is left out; None: all is opaque."""
    opacity: float = 1.0
    """Multiplies the alpha of the base colour's texture."""


MATTE = Material()
"""Of what says nothing of its material."""
