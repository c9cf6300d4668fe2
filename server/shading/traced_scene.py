"""The scene that rendering traces rays through: the room's volume, its light and the virtual objects (thesis 7.2).

Device side: include/shadows.clh.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.input.measure import intrinsics
from server.maths.direct_lights import DirectLight, SplitLight
from server.maths.light_places import EVERYWHERE, LightPlaces
from server.objects.object_table import ObjectTable, object_table
from server.objects.rasterize import Placed
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine, KernelArgument, float4, float16, int4
from server.opencl.parts import Parts
from server.opencl.structs import CHANGED_PARAMETERS, LIGHT_PARAMETERS, OBJECT_PARAMETERS, SCENE_PARAMETERS
from server.shading.depth_views import DepthViews
from server.shading.light_table import table_layout, tabulate_light
from server.shading.virtual_point_lights import VirtualPointLights, no_point_lights
from server.transfer.indirect import Indirect
from server.transfer.radiance_transfer import Directions
from server.transfer.sample_grid import SampleGrid
from server.volume.volume import Volume


class _Buffers(StageBuffers):
    table = BufferDescription(np.uint8)
    """DeviceLight.table of all of the light."""
    rest_table = BufferDescription(np.uint8)
    """The same without discs."""


@dataclass(frozen=True)
class DeviceLight:
    """The light on the device, as it is seen from each of some places."""

    mean: NDArray[np.float64]
    """[3] radiance, over all directions and places."""
    table: Parts
    """Arrays of include/light_table.clh. `arriving` [places, SETS, count] float4 is clamped to 0: harmonics can ring
    below 0, and blocking negative light would brighten."""
    sh: NDArray[np.float64]
    """[places, bands^2, 3]: coefficients of the whole light."""
    rest: NDArray[np.float64]
    """The same without discs."""
    places: LightPlaces
    unseen: NDArray[np.float64]
    """[3] radiance from blocked directions whose blocker no picture shows; 0 without indirect light."""
    surface_gain: float
    """Radiance in the picture's units per unit of the volume's colours; 0: surfaces send nothing."""
    discs: tuple[DirectLight, ...] = ()
    """Sharp lights that the table leaves to shadow maps (shadow_map.py), but for its `whole`; volume axes."""

    @property
    def bands(self) -> int:
        """Number of SH bands of the coefficients."""
        return math.isqrt(self.sh.shape[1])

    @cached_property
    def layout(self) -> np.void:
        """LightTable of structs.py."""
        return table_layout(self.table)


@dataclass(frozen=True)
class Changed:
    """R' / R of real surface in this picture; the radiance that it sends to other surfaces changes likewise."""

    camera: CameraModel
    camera_from_volume: NDArray[np.float64]
    positions: cl_array.Array
    """[h, w] float4 of the real surface."""
    ratio: SampleGrid


@dataclass(frozen=True)
class TracedScene:
    """The scene of one frame. Its arrays are the engine's buffers, valid until the next frame."""

    volume: Volume
    light: DeviceLight
    rays: Directions
    ray_length_m: float
    """Length of rays."""
    objects: Sequence[Placed]
    table: ObjectTable
    ball: np.generic
    """Around all objects, as ball_around returns it."""
    point_lights: VirtualPointLights | None = None
    """Radiance that the objects send; None: none."""
    changed: Changed | None = None
    """Change of the radiance that real surface sends; None: none."""
    depth_views: DepthViews | None = None
    """Depth pictures in which visibility is looked up; None: rays are traced."""

    @property
    def bands(self) -> int:
        """Number of SH bands of the light."""
        return self.light.bands

    def defines(self, engine: Engine) -> dict[str, int]:
        """Preprocessor definitions of the kernels."""
        shapes = {"BANDS": self.bands, "MASK_WORDS": -(-self.rays.count // 32), "LANES": engine.lanes}
        return shapes | (self.depth_views.defines() if self.depth_views else {})

    def by_rays(self) -> TracedScene:
        """The same scene, with visibility traced through the volume."""
        return replace(self, depth_views=None)

    def parameters(self, engine: Engine, samples: np.void, every: int = 1) -> np.void:
        """SceneParameters for a kernel that shades at `samples`, a GRID."""
        return SCENE_PARAMETERS(
            volume=self.volume.shape,
            light=light_parameters(self.light, self.rays.count, self.ray_length_m),
            changed=_changed_parameters(self.changed),
            objects=object_parameters(self.table, self._sent(engine), self.ball),
            samples=samples,
            every=every,
        )

    def arguments(self, engine: Engine) -> tuple[KernelArgument, ...]:
        """SCENE_BUFFERS of include/scene.clh."""
        slots, solid, octets, voxels = self.volume.arguments()[1:]
        return (
            *(slots, solid, octets, voxels),
            *(self.rays.on_device(engine), self.light.table.memory, self.volume.colors),
            *_changed_buffers(engine, self.changed),
            *self._object_buffers(engine),
            *self._view_arguments(engine),
        )

    def real_arguments(self, engine: Engine) -> tuple[KernelArgument, ...]:
        """REAL_SCENE_PARAMETERS of include/scene.clh after the struct."""
        return (*self._solid_arguments(engine), *self._object_buffers(engine), *self._view_arguments(engine))

    def surroundings_arguments(self, engine: Engine) -> tuple[KernelArgument, ...]:
        """SURROUNDINGS_PARAMETERS of include/scene.clh after the struct."""
        changed = _changed_buffers(engine, self.changed)
        return (*self._solid_arguments(engine), *changed, *self._view_arguments(engine))

    def _sent(self, engine: Engine) -> VirtualPointLights:
        return self.point_lights or no_point_lights(engine, self.table.count)

    def _solid_arguments(self, engine: Engine) -> tuple[KernelArgument, ...]:
        slots, solid, octets, _ = self.volume.arguments()[1:]
        return slots, solid, octets, self.rays.on_device(engine), self.light.table.memory, self.volume.colors

    def _object_buffers(self, engine: Engine) -> tuple[KernelArgument, ...]:
        sent = self._sent(engine)
        return self.table.rows.memory, self.table.distances, sent.table.memory, sent.radiances

    def _view_arguments(self, engine: Engine) -> tuple[KernelArgument, ...]:
        return self.depth_views.arguments(engine) if self.depth_views else ()


def light_parameters(light: DeviceLight, count: int, ray_length_m: float) -> np.void:
    """LightParameters of structs.py. count: directions of one set."""
    unseen = float4(*light.unseen, light.surface_gain)
    return LIGHT_PARAMETERS(unseen=unseen, table=light.layout, count=count, ray_length_m=ray_length_m)


def light_arguments(
    engine: Engine, light: DeviceLight, rays: Directions, ray_length_m: float
) -> tuple[KernelArgument, ...]:
    """LightParameters and LIGHT_BUFFERS of include/scene.clh."""
    return light_parameters(light, rays.count, ray_length_m), rays.on_device(engine), light.table.memory


def object_parameters(table: ObjectTable, sent: VirtualPointLights, ball: np.generic) -> np.void:
    """ObjectParameters of structs.py."""
    starts = sent.table.starts
    return OBJECT_PARAMETERS(
        ball=ball,
        count=table.count,
        dims_at=table.rows.starts["dims"],
        **{f"{part}_at": starts[part] for part in ("normals", "cells", "nearest")},
    )


def middles_of(objects: Sequence[Placed]) -> NDArray[np.float64]:
    """[objects, 3] volume metres: the middle of each one's box."""
    middles = [matrix[:3, :3] @ np.mean(thing.bounds, axis=0) + matrix[:3, 3] for thing, matrix in objects]
    return np.array(middles, np.float64).reshape(-1, 3)


def ball_around(objects: Sequence[Placed]) -> np.generic:
    """Centre (volume space) and radius in metres of a ball that holds all objects, as a float4; 0 without any."""
    if not objects:
        return float4(0, 0, 0, 0)
    matrices = np.array([matrix for _, matrix in objects])
    bounds = np.array([thing.bounds for thing, _ in objects])
    in_model = bounds[:, _CORNERS, np.arange(3)]  # [n, 8, 3]
    corners = (in_model @ matrices[:, :3, :3].swapaxes(1, 2) + matrices[:, None, :3, 3]).reshape(-1, 3)
    center = (corners.min(axis=0) + corners.max(axis=0)) / 2
    return float4(*center, float(np.linalg.norm(corners - center, axis=1).max()) * 1.02)


_CORNERS = np.indices((2, 2, 2)).reshape(3, 8).T
"""[8, 3] of a box: 0 for its low side, 1 for its high one."""


def trace_scene(
    engine: Engine, volume: Volume, light: DeviceLight, rays: Directions, ray_length_m: float, objects: Sequence[Placed]
) -> TracedScene:
    """The scene of one frame. Its objects send no light yet."""
    ball = ball_around(objects)
    return TracedScene(volume, light, rays, ray_length_m, objects, object_table(engine, objects), ball)


def upload_light(
    engine: Engine,
    sh: NDArray[np.float64],
    rays: Directions,
    indirect: Indirect | None = None,
    exposure: float = 1.0,
    places: LightPlaces = EVERYWHERE,
    split: SplitLight | None = None,
) -> DeviceLight:
    """Upload the light: radiance coefficients [bands^2, 3], or [places, bands^2, 3], and the radiance along `rays`.

    indirect: radiance from surfaces, None for none. exposure: radiance in the picture over that in `sh` and volume.
    split: of `sh`; its discs are left out of the table.
    """
    sh = exposure * sh.reshape(len(places.positions), -1, 3)
    discs = split.discs if split else ()
    rest = exposure * split.rest.reshape(sh.shape) if split and discs else sh
    buffers = engine.buffers(_Buffers)
    return DeviceLight(
        np.maximum(0.5 / np.sqrt(np.pi) * sh[:, 0], 0.0).mean(axis=0),
        tabulate_light(engine, buffers.rest_table if discs else buffers.table, rays, rest, sh, places),
        sh,
        rest,
        places,
        exposure * indirect.mean if indirect else np.zeros(3),
        exposure if indirect else 0.0,
        tuple(replace(disc, irradiance=exposure * disc.irradiance) for disc in discs),
    )


def _changed_parameters(changed: Changed | None) -> np.void:
    """ChangedParameters of structs.py."""
    if changed is None:
        return CHANGED_PARAMETERS(
            camera_from_volume=float16(np.eye(4)), intrinsics=float4(1, 1, 0, 0), grid=int4(0, 0, 1, 0)
        )
    ratio, camera = changed.ratio, changed.camera
    return CHANGED_PARAMETERS(
        camera_from_volume=float16(changed.camera_from_volume),
        intrinsics=intrinsics(camera),
        grid=int4(ratio.cols, ratio.rows, ratio.stride, camera.width),
    )


def _changed_buffers(engine: Engine, changed: Changed | None) -> tuple[cl_array.Array, cl_array.Array]:
    """CHANGED_BUFFERS of include/scene.clh."""
    return (changed.positions, changed.ratio.values) if changed else (engine.unused, engine.unused)
