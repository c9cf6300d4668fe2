"""What rays of rendering are traced through, and what they bring: the room, its light, virtual objects (thesis 7.2).

Device side: include/shadows.clh.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.input.measure import intrinsics
from server.light.continuation import NO_PLANES, PlaneArrays, plane_arguments
from server.maths.direct_lights import DirectLight, SplitLight
from server.objects.object_table import ObjectTable, object_table
from server.objects.rasterize import Placed
from server.opencl.engine import Engine, KernelArgument, float4, float16, int4
from server.shading.depth_views import DepthViews
from server.shading.virtual_point_lights import VirtualPointLights, no_point_lights
from server.transfer.indirect import Indirect
from server.transfer.radiance_transfer import Directions
from server.transfer.sample_grid import SampleGrid
from server.volume.volume import Volume


@dataclass(frozen=True)
class DeviceLight:
    """The light on the device."""

    coefficients: cl_array.Array
    """[bands^2] float4: RGB radiance coefficients."""
    mean: NDArray[np.float64]
    """[3] radiance, over all directions."""
    arriving: cl_array.Array
    """[SETS, count] float4: RGB radiance from each direction that visibility is tested along; not below 0, as that of
    few harmonics may be: to hide darkness would light up."""
    continued: tuple[KernelArgument, ...]
    """Planes that hide it where the volume is empty, as Continued of include/continued.clh takes them."""
    unseen: NDArray[np.float64]
    """[3] radiance that hidden directions bring where no picture shows what hides them; 0 without indirect light."""
    surface_gain: float
    """Radiance in the picture's units over that of the volume's colours; 0: surfaces send nothing."""
    discs: tuple[DirectLight, ...] = ()
    """What is not in `coefficients` and `arriving`, for shadow maps to bring (shadow_map.py); volume axes."""
    with_discs: cl_array.Array | None = None
    """[bands^2] float4: coefficients of all of it, None where those are `coefficients`."""

    @property
    def bands(self) -> int:
        """Of the coefficients."""
        return math.isqrt(int(self.coefficients.shape[0]))

    @property
    def whole(self) -> cl_array.Array:
        """[bands^2] float4: coefficients of all of the light."""
        return self.coefficients if self.with_discs is None else self.with_discs


@dataclass(frozen=True)
class Changed:
    """How this picture shows real surface to change: what it then sends to others changes alike."""

    camera: CameraModel
    camera_from_volume: NDArray[np.float64]
    positions: cl_array.Array
    """[h, w] float4 of the real surface."""
    ratio: SampleGrid


@dataclass(frozen=True)
class TracedScene:
    """One frame's; arrays of the engine's workspace, valid until the next."""

    volume: Volume
    light: DeviceLight
    rays: Directions
    reach_m: float
    """Length of rays."""
    objects: Sequence[Placed]
    table: ObjectTable
    glow: VirtualPointLights | None = None
    """What the objects send; None: nothing."""
    changed: Changed | None = None
    """What they change of what real surface sends; None: nothing."""
    looks: DepthViews | None = None
    """Pictures that visibility is looked up in; None: rays are traced."""

    @property
    def bands(self) -> int:
        """Of the light."""
        return math.isqrt(int(self.light.coefficients.shape[0]))

    def defines(self, engine: Engine) -> dict[str, int]:
        """Shapes that kernels are compiled for."""
        shapes = {"BANDS": self.bands, "MASK_WORDS": -(-self.rays.count // 32), "LANES": engine.lanes}
        return shapes | (self.looks.defines() if self.looks else {})

    def by_rays(self) -> TracedScene:
        """The same, with visibility traced."""
        return replace(self, looks=None)

    def arguments(self, engine: Engine) -> tuple[KernelArgument, ...]:
        """SCENE_PARAMETERS of include/shadows.clh."""
        table, sent = self.table, self.glow or no_point_lights(engine, self.table.count)
        return (
            *self.volume.arguments(),
            *light_arguments(engine, self.light, self.volume, self.rays, self.reach_m, self.changed),
            table.count,
            table.grid_from_volume,
            table.dims,
            table.distances,
            *sent.arguments(),
            *(self.looks.arguments(engine) if self.looks else ()),
        )


def light_arguments(
    engine: Engine,
    light: DeviceLight,
    volume: Volume,
    rays: Directions,
    reach_m: float,
    changed: Changed | None = None,
) -> tuple[KernelArgument, ...]:
    """LIGHT_PARAMETERS of include/shadows.clh."""
    return (
        rays.count,
        rays.on_device(engine),
        light.arriving,
        reach_m,
        *light.continued,
        volume.colors,
        float4(*light.unseen, light.surface_gain),
        *_changed_arguments(engine, changed),
    )


def trace_scene(
    engine: Engine, volume: Volume, light: DeviceLight, rays: Directions, reach_m: float, objects: Sequence[Placed]
) -> TracedScene:
    """The scene of one frame, whose objects send nothing yet."""
    return TracedScene(volume, light, rays, reach_m, objects, object_table(engine, objects))


def upload_light(
    engine: Engine,
    sh: NDArray[np.float64],
    rays: Directions,
    planes: PlaneArrays = NO_PLANES,
    indirect: Indirect | None = None,
    exposure: float = 1.0,
) -> DeviceLight:
    """Bring the light to the device: radiance coefficients [bands^2, 3], what they send along `rays`, what hides it.

    indirect: what surfaces send, None to leave it out. exposure: radiance in the picture over that in `sh` and volume.
    """
    sh = exposure * sh
    return DeviceLight(
        engine.workspace.upload("light", _float4(sh)),
        np.maximum(0.5 / np.sqrt(np.pi) * sh[0], 0.0),
        engine.workspace.upload("arriving", _arriving(rays, sh)),
        plane_arguments(engine, "light_planes", planes),
        exposure * indirect.mean if indirect else np.zeros(3),
        exposure if indirect else 0.0,
    )


def take_discs(
    engine: Engine, light: DeviceLight, split: SplitLight, rays: Directions, exposure: float = 1.0
) -> DeviceLight:
    """`light`, of the same radiance and `exposure` as `split`, less its discs."""
    if not split.discs:
        return light
    rest = exposure * split.rest
    return replace(
        light,
        coefficients=engine.workspace.upload("light_rest", _float4(rest)),
        arriving=engine.workspace.upload("arriving_rest", _arriving(rays, rest)),
        discs=tuple(replace(disc, irradiance=exposure * disc.irradiance) for disc in split.discs),
        with_discs=light.coefficients,
    )


def _arriving(rays: Directions, sh: NDArray[np.float64]) -> NDArray[np.float32]:
    return _float4(np.maximum(rays.basis @ sh.astype(np.float32), 0.0))


def _changed_arguments(engine: Engine, changed: Changed | None) -> tuple[KernelArgument, ...]:
    """CHANGED_PARAMETERS of include/changed.clh."""
    if changed is None:
        unused = engine.workspace.array("unused", (1,), cl_types.float4)
        return float16(np.eye(4)), float4(1, 1, 0, 0), int4(0, 0, 1, 0), unused, unused
    ratio, camera = changed.ratio, changed.camera
    grid = int4(ratio.cols, ratio.rows, ratio.stride, camera.width)
    return float16(changed.camera_from_volume), intrinsics(camera), grid, changed.positions, ratio.values


def _float4(rgb: NDArray[np.floating]) -> NDArray[np.float32]:
    """[..., 3] -> [...] float4 with w = 0."""
    padded = np.zeros((*rgb.shape[:-1], 4), np.float32)
    padded[..., :3] = rgb
    return padded.view(cl_types.float4)[..., 0]
