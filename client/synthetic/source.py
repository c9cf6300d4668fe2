"""`synthetic:NAME[?key=value&...]`: scenes with exact poses, depth, colour and light."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from client.synthetic.cache import cached
from client.synthetic.camera_exposure import EXPOSURE_CURVES, FIRST_EXPOSURE
from client.synthetic.lighting.bake import bake
from client.synthetic.lighting.bounced import STEP_M, bounced
from client.synthetic.lighting.harmonics import sphere_directions
from client.synthetic.lighting.lamps import Lamp, room_lamps
from client.synthetic.lighting.lights import RING_SIZE, DistantLight, ring_light
from client.synthetic.render import LitSolid, Rendering, camera_rays, look_at, render
from client.synthetic.scenes import hand
from client.synthetic.scenes.guests import GUESTS, bake_guests, guest_grids
from client.synthetic.sensor_noise import kinect_like
from client.synthetic.solids.charts import Grid, atlas
from client.synthetic.spec import Options, parse_spec, scene_of
from protocol.frames import CameraModel, RgbdFrame

FPS = 30.0
LIGHT_TURN_FRAMES = 240
"""Frames of one turn of the moving light."""
FOCAL_OF_WIDTH = 525 / 640

_UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class Truth:
    """Exact ground truth of one frame."""

    sh: NDArray[np.float64]
    """[16, 3] radiance in units of the linear picture: picture = albedo * (transfer . sh)."""
    depth_m: NDArray[np.float32]
    """[h, w] along the camera's z, 0: no surface."""
    normals: NDArray[np.float32]
    """[h, w, 3] world, 0: no surface."""
    albedo: NDArray[np.float32]
    """[h, w, 3] linear, 0: no surface."""
    visible: NDArray[np.bool_]
    """[h, w] pixels with surface."""
    dynamic: NDArray[np.bool_]
    """[h, w] pixels of moving surfaces."""
    guest: NDArray[np.bool_]
    """[h, w] pixels of objects inserted by `with=`."""
    radiance: NDArray[np.float64]
    """[h, w, 3] linear picture before encoding as 8-bit sRGB."""
    light_direction: NDArray[np.float64]
    """[3] unit, world: dominant direction towards the light."""
    lamps: tuple[Lamp, ...]
    """Lights inside the scene, in addition to `sh`, in the same units."""
    lamplight: NDArray[np.float64]
    """[h, w, 3] part of `radiance` that is reflected light of lamps."""


class SyntheticSource:
    """A scene with a moving camera, as a `Source`."""

    fps = FPS
    has_poses = True
    up: tuple[float, float, float] | None = (0.0, 1.0, 0.0)

    def __init__(self, options: Options) -> None:
        """Shadows are computed, or read from the cache, at the first frame."""
        self.name = f"synthetic:{options.name}"
        self.options = options
        width, height = options.size
        focal = FOCAL_OF_WIDTH * width
        self.camera = CameraModel(
            width=width, height=height, fx=focal, fy=focal, cx=(width - 1) / 2, cy=(height - 1) / 2
        )
        self.scene = scene_of(options)
        self.guests = GUESTS[options.guest]
        self.lamps = self.scene.lamps or room_lamps(options.lamps, options.place)
        self._rays = camera_rays(self.camera)
        self._grids = atlas([solid.charts for solid in self.scene.solids], self.scene.step_m)
        self._texel_light = lru_cache(maxsize=1)(self._shadowed_light)
        self._rendering = lru_cache(maxsize=2)(self._render)

    def __len__(self) -> int:
        return self.options.frames

    def __getitem__(self, index: int) -> RgbdFrame:
        index = range(len(self))[index]
        rendering = self._rendering(index)
        pose = self.pose(index)
        depth_m = rendering.depth_m
        if self.options.noise:
            depth_m = kinect_like(depth_m, self._slant(rendering, pose), self.camera.fx, index)
        depth = (depth_m / self.camera.depth_scale_m).round().clip(0, 65535).astype(np.uint16)
        exposure = self.exposure(index)
        picture = to_srgb8(exposure * rendering.radiance)
        reported = (FIRST_EXPOSURE if self.options.exposure != "constant" else 1.0) * exposure
        return RgbdFrame(index, index / FPS, picture, depth, pose, reported if self.options.exposure_given else None)

    def exposure(self, index: int) -> float:
        """Exposure of a frame relative to the first."""
        return EXPOSURE_CURVES[self.options.exposure](index)

    def pose(self, index: int) -> NDArray[np.float64]:
        """world_from_camera [4, 4], exact."""
        position, target = self.scene.camera_path(index / FPS)
        return look_at(position, target, _UP)

    def light(self, index: int) -> DistantLight:
        """The light of one frame."""
        moved = index * RING_SIZE / LIGHT_TURN_FRAMES if self.options.name == "light" else 0.0
        return ring_light(self.options.light + moved, self.scene.brightness)

    def truth(self, index: int) -> Truth:
        """Ground truth of frame `index`."""
        rendering, light, exposure = self._rendering(index), self.light(index), self.exposure(index)
        return Truth(
            sh=exposure * light.sh,
            depth_m=rendering.depth_m.astype(np.float32),
            normals=rendering.normals.astype(np.float32),
            albedo=rendering.albedo.astype(np.float32),
            visible=rendering.owner >= 0,
            dynamic=(rendering.owner >= len(self.scene.bodies)) & (self.options.name == "hand"),
            guest=(rendering.owner >= len(self.scene.bodies)) & bool(self.guests),
            radiance=exposure * rendering.radiance,
            light_direction=light.direction,
            lamps=tuple(replace(lamp, intensity=exposure * lamp.intensity) for lamp in self.lamps),
            lamplight=exposure * rendering.lamplight,
        )

    def _bake(self) -> dict[str, NDArray[np.float32]]:
        directions = sphere_directions(self.scene.directions).astype(np.float32)
        return {"occluded": bake(self.scene.solids, self._grids, directions)}

    @cached_property
    def _transfer(self) -> NDArray[np.float32]:
        """[total, 16] occluded transfer on the grids."""
        return cached(self.scene.name, self._bake)["occluded"]

    @cached_property
    def _guest_transfer(self) -> dict[str, NDArray[np.float32]]:
        """Occluded transfer on the set and on the guests, see bake_guests."""
        directions = sphere_directions(self.scene.directions).astype(np.float32)
        return cached(
            f"{self.scene.name}_{self.options.guest}",
            lambda: bake_guests(self.guests, self.scene.solids, self._grids, directions),
        )

    @cached_property
    def _bounced(self) -> NDArray[np.float32]:
        """[total, 3] light that surfaces send to each other, on grids of their own."""
        light, baked = self.light(0), self._texel_light(0)
        bodies = [
            LitSolid(body.solid, body.texture, grids, ((grids, baked),))
            for body, grids in zip(self.scene.bodies, self._grids, strict=True)
        ]
        name = f"{self.scene.name}_{self.options.light}_bounced"
        return cached(name, lambda: {"bounced": bounced(bodies, self._coarse, self.lamps, light)})["bounced"]

    @cached_property
    def _coarse(self) -> list[list[Grid]]:
        return atlas([solid.charts for solid in self.scene.solids], STEP_M)

    @cached_property
    def _static(self) -> hand.StaticVisibility:
        solids = self.scene.solids
        bits = cached("hand", lambda: {"open": hand.StaticVisibility(solids).open_bits})["open"]
        return hand.StaticVisibility(solids, bits)

    def _shadowed_light(self, index: int) -> NDArray[np.float32]:
        """[total, 3] light that static shadows remove."""
        return self._transfer @ self.light(index).sh.astype(np.float32)

    def lit_bodies(self, index: int) -> list[LitSolid]:
        """Solids of a frame with the light that reaches them."""
        light = self.light(index)
        baked = self._texel_light(index if self.options.name == "light" else 0)
        bodies = [
            LitSolid(body.solid, body.texture if self.options.texture else None, grids, ((grids, baked),))
            for body, grids in zip(self.scene.bodies, self._grids, strict=True)
        ]
        if self.scene.lamps:
            bodies = [
                replace(body, bounced=(grids, self._bounced)) for body, grids in zip(bodies, self._coarse, strict=True)
            ]
        if self.options.name == "hand":
            bodies = self._with_hand(bodies, index, light)
        if self.guests:
            bodies = self._with_guests(bodies, light)
        return bodies

    def _render(self, index: int) -> Rendering:
        light, bodies = self.light(index), self.lit_bodies(index)
        return render(bodies, self.camera, self._rays, self.pose(index), light, self.lamps)

    def _with_hand(self, bodies: list[LitSolid], index: int, light: DistantLight) -> list[LitSolid]:
        """The static solids with the shadow of the hand, and the parts of the hand."""
        parts = hand.capsules(index / max(len(self) - 1, 1))
        if not parts:
            return bodies
        shadow = self._static.shadow(parts, light)
        shadowed = [
            replace(body, occluded=(*body.occluded, (grids, shadow)))
            for body, grids in zip(bodies, self._static.grids, strict=True)
        ]
        grids, occluded = hand.skin_shadows(parts, self.scene.solids)
        occluded_light = occluded @ light.sh.astype(np.float32)
        texture = hand.SKIN if self.options.texture else None
        skin = [LitSolid(part, texture, own, ((own, occluded_light),)) for part, own in zip(parts, grids, strict=True)]
        return [*shadowed, *skin]

    def _with_guests(self, bodies: list[LitSolid], light: DistantLight) -> list[LitSolid]:
        """The static solids with the shadows of the guests, and the guests."""
        sh = light.sh.astype(np.float32)
        occluded_on_set, occluded_light = self._guest_transfer["on_set"] @ sh, self._guest_transfer["on_guests"] @ sh
        shadowed = [
            replace(body, occluded=(*body.occluded, (grids, occluded_on_set)))
            for body, grids in zip(bodies, self._grids, strict=True)
        ]
        lit = zip(self.guests, guest_grids(self.guests), strict=True)
        return [*shadowed, *(LitSolid(guest.solid, guest.texture, own, ((own, occluded_light),)) for guest, own in lit)]

    def _slant(self, rendering: Rendering, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """[h, w] cosine between the surface and the ray."""
        rays = self._rays @ pose[:3, :3].T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        cosines: NDArray[np.float64] = -(rays.reshape(rendering.normals.shape) * rendering.normals).sum(axis=-1)
        return cosines


def to_srgb8(radiance: NDArray[np.float64]) -> NDArray[np.uint8]:
    """The 8-bit picture of linear radiance."""
    linear = np.clip(radiance, 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return (encoded * 255).round().astype(np.uint8)


def open_synthetic(spec: str) -> SyntheticSource:
    """The scene that `synthetic:NAME[?key=value&...]` names. Raises SourceError."""
    return SyntheticSource(parse_spec(spec))
