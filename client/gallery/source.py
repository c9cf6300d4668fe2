"""`synthetic:gallery/NAME`: a gallery scene as a `Source`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from client.errors import SourceError
from client.gallery.scenes import GALLERY, GalleryScene, Part
from client.sources.frame_source import GALLERY_PREFIX as PREFIX
from client.synthetic.lighting.bake import bake
from client.synthetic.lighting.harmonics import sphere_directions
from client.synthetic.lighting.lights import DistantLight
from client.synthetic.render import LitSolid, camera_rays, look_at, render
from client.synthetic.scenes.textures import Texture
from client.synthetic.solids.charts import atlas
from client.synthetic.source import FOCAL_OF_WIDTH, FPS, to_srgb8
from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Rgb

WIDTH, HEIGHT = 160, 120
_STEP_M, _DIRECTIONS = 0.05, 512  # sampling of shadows
_UP = np.array([0.0, 1.0, 0.0])


class GallerySource:
    """A gallery scene, rendered at 4:3."""

    fps = FPS
    has_poses = True
    up: tuple[float, float, float] | None = (0.0, 1.0, 0.0)

    def __init__(self, name: str, width: int = WIDTH, frames: int | None = None) -> None:
        """frames: None: as many as the scene has. Raises SourceError for an unknown name."""
        if name not in GALLERY:
            raise SourceError(f"{PREFIX}{name}: there is no such scene; there are {', '.join(GALLERY)}")
        self.name = f"{PREFIX}{name}"
        scene = GALLERY[name]
        self.scene: GalleryScene = scene if frames is None else replace(scene, frames=frames)
        focal, height = FOCAL_OF_WIDTH * width, width * HEIGHT // WIDTH
        self.camera = CameraModel(
            width=width, height=height, fx=focal, fy=focal, cx=(width - 1) / 2, cy=(height - 1) / 2
        )
        self._rays = camera_rays(self.camera)
        self._frames: dict[int, RgbdFrame] = {}  # rendered once, as rendering is slower than processing
        self._bake: tuple[object, list[LitSolid]] | None = None
        self._last: tuple[object, NDArray[np.uint8], NDArray[np.float64]] | None = None

    def __len__(self) -> int:
        return self.scene.frames

    def __getitem__(self, index: int) -> RgbdFrame:
        index = range(self.scene.frames)[index]
        if index not in self._frames:
            self._frames[index] = self._frame(index)
        return self._frames[index]

    def _frame(self, index: int) -> RgbdFrame:
        picture, depth_m = self._clean_views(index)
        noise = np.random.default_rng(index)
        if self.scene.noise_codes:
            noisy = picture + noise.normal(0.0, self.scene.noise_codes, picture.shape)
            picture = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        if self.scene.depth_noise:
            deviation_m = self.scene.depth_noise * (0.0012 + 0.0019 * (depth_m - 0.4) ** 2)
            depth_m = np.where(depth_m > 0, depth_m + noise.normal(0.0, deviation_m), 0.0)
        depth = np.rint(depth_m / self.camera.depth_scale_m).clip(0, 65534).astype(np.uint16)
        return RgbdFrame(index, index / FPS, picture, depth, self.pose(index), 1.0)

    def _clean_views(self, index: int) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
        """sRGB picture and depth in metres without noise; rendered again only if scene, light or pose changed."""
        key = (self._state(index), self.pose(index).tobytes())
        if self._last is None or self._last[0] != key:
            light = DistantLight(_UP, self._sh(index))
            rendering = render(self._lit(index), self.camera, self._rays, self.pose(index), light)
            self._last = key, to_srgb8(rendering.radiance), rendering.depth_m
        return self._last[1], self._last[2]

    def _state(self, index: int) -> tuple[object, ...]:
        """Key of the geometry and light of a frame."""
        return tuple(part.steps(index) for part in self.scene.parts), self._sh(index).tobytes()

    def _sh(self, index: int) -> NDArray[np.float64]:
        """[16, 3] radiance of the light in a frame."""
        later = self.scene.later_light
        return later[1] if later and index >= later[0] else self.scene.sh

    @property
    def light(self) -> tuple[Rgb, ...] | None:
        """The light to give to a session; None: to be estimated."""
        rows = self.scene.sh if self.scene.is_light_given else ()
        return tuple((float(r), float(g), float(b)) for r, g, b in rows) or None

    def pose(self, index: int) -> NDArray[np.float64]:
        """world_from_camera [4, 4]."""
        aside = np.array([index * self.scene.camera_step_m, 0.0, 0.0])
        return look_at(np.array(self.scene.eye) + aside, np.array(self.scene.target), _UP)

    def _lit(self, index: int) -> list[LitSolid]:
        if self._bake is None or self._bake[0] != self._state(index):
            self._bake = self._state(index), self._baked(index)
        return self._bake[1]

    def _baked(self, index: int) -> list[LitSolid]:
        solids = [part.at(index) for part in self.scene.parts]
        grids = atlas([solid.charts for solid in solids], _STEP_M)
        directions = sphere_directions(_DIRECTIONS).astype(np.float32)
        occluded = bake(solids, grids, directions) @ self._sh(index).astype(np.float32)
        return [
            LitSolid(solid, _plain(part), own, ((own, occluded),))
            for solid, part, own in zip(solids, self.scene.parts, grids, strict=True)
        ]


def _plain(part: Part) -> Texture:
    color = np.array(part.albedo)
    return lambda points: np.broadcast_to(color, points.shape)
