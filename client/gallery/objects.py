"""The gallery's virtual objects, made by code."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from trimesh.visual.material import PBRMaterial

Rgb = tuple[float, float, float]
Place = tuple[float, float, float]

CLAY: Rgb = (0.75, 0.55, 0.4)


@dataclass(frozen=True)
class GalleryObject:
    """A ball or a box of one material."""

    size_m: float
    """Diameter, or side."""
    place_m: Place
    """World, of its bottom's middle, in frame 0."""
    step_m: Place = (0.0, 0.0, 0.0)
    """From frame to frame."""
    start_frame: int = 0
    """Frames before it begins to move."""
    is_box: bool = False
    color: Rgb = CLAY
    """sRGB."""
    roughness: float = 1.0
    metalness: float = 0.0

    def place(self, index: int) -> Place:
        """Where it stands in a frame."""
        moved = max(index - self.start_frame, 0)
        x, y, z = (a + moved * b for a, b in zip(self.place_m, self.step_m, strict=True))
        return x, y, z

    def glb(self) -> bytes:
        """As a mesh file, +y up."""
        if self.is_box:
            mesh = trimesh.creation.box([self.size_m] * 3)
        else:
            mesh = trimesh.creation.icosphere(3, self.size_m / 2)
        material = PBRMaterial(
            baseColorFactor=[*self.color, 1.0], roughnessFactor=self.roughness, metallicFactor=self.metalness
        )
        mesh.visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(mesh.vertices), 2)), material=material)
        return bytes(mesh.export(file_type="glb"))
