"""`synthetic:gallery/NAME`: a gallery scene as a source of frames; see client.laptop.source.Source."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from client.laptop.errors import SourceError
from client.laptop.gallery.scenes import GALLERY, GalleryScene, Part
from client.laptop.source import GALLERY_PREFIX as PREFIX
from client.laptop.synthetic.bake import bake
from client.laptop.synthetic.charts import atlas
from client.laptop.synthetic.harmonics import sphere_directions
from client.laptop.synthetic.lights import DistantLight
from client.laptop.synthetic.render import Lit, camera_rays, look_at, render
from client.laptop.synthetic.source import FOCAL_OF_WIDTH, FPS, to_srgb8
from client.laptop.synthetic.textures import Texture
from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Rgb

WIDTH, HEIGHT = 160, 120
_STEP_M, _DIRECTIONS = 0.05, 512  # of shadows
_UP = np.array([0.0, 1.0, 0.0])


class GallerySource:
    """A scene of the gallery, 160 x 120."""

    fps = FPS
    has_poses = True
    up: tuple[float, float, float] | None = (0.0, 1.0, 0.0)

    def __init__(self, name: str) -> None:
        """Raises SourceError if there is none of that name."""
        if name not in GALLERY:
            raise SourceError(f"{PREFIX}{name}: there is no such scene; there are {', '.join(GALLERY)}")
        self.name = f"{PREFIX}{name}"
        self.scene: GalleryScene = GALLERY[name]
        focal = FOCAL_OF_WIDTH * WIDTH
        self.camera = CameraModel(
            width=WIDTH, height=HEIGHT, fx=focal, fy=focal, cx=(WIDTH - 1) / 2, cy=(HEIGHT - 1) / 2
        )
        self._rays = camera_rays(self.camera)

    def __len__(self) -> int:
        return self.scene.frames

    def __getitem__(self, index: int) -> RgbdFrame:
        index = range(len(self))[index]
        rendering = render(self._lit(index), self.camera, self._rays, self.pose(index), self._light)
        picture = to_srgb8(rendering.radiance)
        if self.scene.noise_codes:
            noise = np.random.default_rng(index).normal(0.0, self.scene.noise_codes, picture.shape)
            picture = np.clip(np.rint(picture + noise), 0, 255).astype(np.uint8)
        depth = np.rint(rendering.depth_m / self.camera.depth_scale_m).clip(0, 65534).astype(np.uint16)
        return RgbdFrame(index, index / FPS, picture, depth, self.pose(index), 1.0)

    @property
    def light(self) -> tuple[Rgb, ...] | None:
        """What a session is told of the light; None: it is to be found."""
        rows = self.scene.sh if self.scene.is_light_given else ()
        return tuple((float(r), float(g), float(b)) for r, g, b in rows) or None

    def pose(self, index: int) -> NDArray[np.float64]:
        """world_from_camera [4, 4]."""
        aside = np.array([index * self.scene.walk_m, 0.0, 0.0])
        return look_at(np.array(self.scene.eye) + aside, np.array(self.scene.target), _UP)

    @property
    def _light(self) -> DistantLight:
        return DistantLight(_UP, self.scene.sh)

    @cached_property
    def _still(self) -> list[Lit]:
        return self._baked(0)

    def _lit(self, index: int) -> list[Lit]:
        moves = any(any(part.step_m) for part in self.scene.parts)
        return self._baked(index) if moves else self._still

    def _baked(self, index: int) -> list[Lit]:
        solids = [part.at(index) for part in self.scene.parts]
        grids = atlas([solid.charts for solid in solids], _STEP_M)
        directions = sphere_directions(_DIRECTIONS).astype(np.float32)
        taken = bake(solids, grids, directions) @ self.scene.sh.astype(np.float32)
        return [
            Lit(solid, _plain(part), own, ((own, taken),))
            for solid, part, own in zip(solids, self.scene.parts, grids, strict=True)
        ]


def _plain(part: Part) -> Texture:
    color = np.array(part.albedo)
    return lambda points: np.broadcast_to(color, points.shape)
