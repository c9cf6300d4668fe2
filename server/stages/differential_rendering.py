"""Differential rendering (thesis 7.1-7.2): shading with and without virtual objects.

Kernel: differential_rendering.cl.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.engine import Engine, KernelArgument, float4, float16, int4
from server.stages.continuation import NO_PLANES, PlaneArrays, plane_arguments
from server.stages.indirect import Indirect, no_hits
from server.stages.measure import intrinsics
from server.stages.object_glow import Glow, no_glow, place_points
from server.stages.radiance_transfer import Directions, Transfer, own_sets
from server.stages.rasterize import Placed, VirtualSurface
from server.stages.raycast import Surface
from server.stages.volume import Volume
from server.stages.voxelize import ObjectTable

VIRTUAL_STRIDE = 2
"""Occlusion of virtual surfaces is traced at every second pixel; the unoccluded part is exact at every pixel."""
BOUNCE_EVERY = 4
"""Of how many hidden directions a sample follows one, for what its surroundings send it less; its neighbours others."""


@dataclass(frozen=True)
class DeviceLight:
    """The light on the device."""

    coefficients: cl_array.Array
    """[bands^2] float4: RGB radiance coefficients."""
    arriving: cl_array.Array
    """[SETS, count] float4: RGB radiance from each direction that visibility is tested along; not below 0, as that of
    few harmonics may be: to hide darkness would light up."""
    continued: tuple[KernelArgument, ...]
    """Planes that hide it where the volume is empty, as Continued of include/continued.clh takes them."""
    unseen: NDArray[np.float64]
    """[3] radiance that hidden directions bring where no picture shows what hides them; 0 without indirect light."""
    surface_gain: float
    """Radiance in the picture's units over that of the volume's colours; 0: surfaces send nothing."""


@dataclass(frozen=True)
class SampleGrid:
    """Values at samples every `stride` pixels, [rows, cols] float4; w = 1 valid."""

    stride: int
    values: cl_array.Array

    @property
    def rows(self) -> int:
        """Samples down."""
        return int(self.values.shape[0])

    @property
    def cols(self) -> int:
        """Samples across."""
        return int(self.values.shape[1])


@dataclass(frozen=True)
class RealShadow(SampleGrid):
    """Ratios R' / R (eq. 7.1) at samples of real surface."""

    shaded: cl_array.Array
    """[rows, cols] float4: R, what reaches white surface without objects, w = 1 valid."""


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
        engine.workspace.upload("arriving", _float4(np.maximum(rays.basis @ sh.astype(np.float32), 0.0))),
        plane_arguments(engine, "light_planes", planes),
        exposure * indirect.mean if indirect else np.zeros(3),
        exposure if indirect else 0.0,
    )


def shadow_real(
    engine: Engine,
    camera: CameraModel,
    surface: Surface,
    transfer: Transfer,
    volume: Volume,
    light: DeviceLight,
    rays: Directions,
    reach_m: float,
    objects: Sequence[Placed],
    table: ObjectTable,
    indirect: Indirect | None = None,
    glow: Glow | None = None,
) -> RealShadow:
    """Ratio R' / R of real surface shaded with and without the objects, at the transfer's samples (eq. 7.1).

    indirect: at the same samples.
    """
    shape, space = (transfer.rows, transfer.cols), engine.workspace
    ratio = space.array("shadow_ratio", shape, cl_types.float4)
    shaded = space.array("shadow_shaded", shape, cl_types.float4)
    defines = {"BANDS": transfer.bands, "MASK_WORDS": transfer.free_mask.shape[2], "LANES": engine.lanes}
    defines["INTERLEAVE"] = transfer.interleave
    engine.launch(
        engine.kernel("differential_rendering.cl", "shadow_real", **defines),
        (transfer.cols, transfer.rows),
        transfer.cols,
        transfer.rows,
        transfer.stride,
        camera.width,
        surface.positions,
        surface.normals,
        transfer.coefficients,
        transfer.openness,
        transfer.free_mask,
        transfer.sets if transfer.sets is not None else own_sets(engine, transfer.rows, transfer.cols),
        indirect.hits if indirect else no_hits(engine, transfer),
        light.coefficients,
        *volume.arguments(),
        *light_arguments(engine, light, rays, reach_m, volume),
        *object_arguments(engine, table, glow),
        ball_around(objects),
        ratio,
        shaded,
    )
    return RealShadow(transfer.stride, ratio, shaded)


def bounce_real(
    engine: Engine,
    camera: CameraModel,
    surface: Surface,
    transfer: Transfer,
    volume: Volume,
    light: DeviceLight,
    rays: Directions,
    reach_m: float,
    camera_from_volume: NDArray[np.float64],
    shadow: RealShadow,
) -> RealShadow:
    """`shadow` with what real surfaces then send one another less or more (eq. 7.6: R'_ID - R_ID)."""
    bounced = engine.workspace.array("shadow_bounced", (transfer.rows, transfer.cols), cl_types.float4)
    defines = {"BANDS": transfer.bands, "MASK_WORDS": transfer.free_mask.shape[2], "LANES": engine.lanes}
    defines["INTERLEAVE"] = transfer.interleave
    changed = Changed(camera, camera_from_volume, surface.positions, shadow)
    engine.launch(
        engine.kernel("differential_rendering.cl", "bounce_real", **defines),
        (transfer.cols, transfer.rows),
        transfer.cols,
        transfer.rows,
        transfer.stride,
        camera.width,
        surface.positions,
        surface.normals,
        transfer.openness,
        transfer.free_mask,
        transfer.sets if transfer.sets is not None else own_sets(engine, transfer.rows, transfer.cols),
        light.coefficients,
        *volume.arguments(),
        *light_arguments(engine, light, rays, reach_m, volume, changed),
        BOUNCE_EVERY,
        shadow.shaded,
        bounced,
    )
    return replace(shadow, values=bounced)


def ball_around(objects: Sequence[Placed]) -> np.generic:
    """Centre (volume space) and radius in metres of a ball that holds all objects, as a float4."""
    boxes = [np.array(list(product(*zip(*thing.bounds, strict=True)))) for thing, _ in objects]
    corners = np.concatenate([b @ m[:3, :3].T + m[:3, 3] for b, (_, m) in zip(boxes, objects, strict=True)])
    center = (corners.min(axis=0) + corners.max(axis=0)) / 2
    return float4(*center, float(np.linalg.norm(corners - center, axis=1).max()) * 1.02)


def shadow_virtual(
    engine: Engine,
    camera: CameraModel,
    virtual: VirtualSurface,
    volume: Volume,
    bands: int,
    light: DeviceLight,
    rays: Directions,
    reach_m: float,
    table: ObjectTable,
    glow: Glow | None = None,
    changed: Changed | None = None,
) -> SampleGrid:
    """Radiance that real and virtual occluders take from the virtual surface, at every VIRTUAL_STRIDE-th pixel."""
    shape = (camera.height // VIRTUAL_STRIDE, camera.width // VIRTUAL_STRIDE)
    occluded = SampleGrid(VIRTUAL_STRIDE, engine.workspace.array("virtual_occluded", shape, cl_types.float4))
    defines = {"BANDS": bands, "MASK_WORDS": -(-rays.count // 32), "LANES": engine.lanes}
    engine.launch(
        engine.kernel("differential_rendering.cl", "shadow_virtual", **defines),
        (occluded.cols, occluded.rows),
        occluded.cols,
        occluded.rows,
        VIRTUAL_STRIDE,
        camera.width,
        virtual.position,
        virtual.normal,
        *volume.arguments(),
        *light_arguments(engine, light, rays, reach_m, volume, changed),
        *object_arguments(engine, table, glow),
        max(table.cell_m, default=0.0),
        occluded.values,
    )
    return occluded


def light_points(
    engine: Engine,
    objects: Sequence[Placed],
    volume: Volume,
    light: DeviceLight,
    rays: Directions,
    reach_m: float,
    table: ObjectTable,
) -> Glow:
    """What the objects send: their points lit as their pixels are (eq. 7.3), but not by one another."""
    placed, bands = place_points(engine, objects), round(light.coefficients.shape[0] ** 0.5)
    radiances = engine.workspace.array("glow_radiances", (placed.count,), cl_types.float4)
    defines = {"BANDS": bands, "MASK_WORDS": -(-rays.count // 32), "LANES": engine.lanes}
    engine.launch(
        engine.kernel("differential_rendering.cl", "light_points", **defines),
        (placed.count,),
        placed.count,
        placed.points,
        placed.normals,
        placed.albedos,
        placed.offsets_m,
        light.coefficients,
        *volume.arguments(),
        *light_arguments(engine, light, rays, reach_m, volume),
        *object_arguments(engine, table, placed.glow),
        radiances,
    )
    return replace(placed.glow, radiances=radiances)


@dataclass(frozen=True)
class Changed:
    """How this picture shows real surface to change: what it then sends to others changes alike."""

    camera: CameraModel
    camera_from_volume: NDArray[np.float64]
    positions: cl_array.Array
    """[h, w] float4 of the real surface."""
    ratio: SampleGrid


def light_arguments(
    engine: Engine,
    light: DeviceLight,
    rays: Directions,
    reach_m: float,
    volume: Volume,
    changed: Changed | None = None,
) -> tuple[KernelArgument, ...]:
    """LIGHT_PARAMETERS of include/shadows.clh."""
    unseen = float4(*light.unseen, light.surface_gain)
    sent = (volume.colors, unseen, *_changed_arguments(engine, changed))
    return (rays.count, rays.on_device(engine), light.arriving, reach_m, *light.continued, *sent)


def _changed_arguments(engine: Engine, changed: Changed | None) -> tuple[KernelArgument, ...]:
    """CHANGED_PARAMETERS of include/changed.clh."""
    if changed is None:
        unused = engine.workspace.array("unused", (1,), cl_types.float4)
        return float16(np.eye(4)), float4(1, 1, 0, 0), int4(0, 0, 1, 0), unused, unused
    ratio, camera = changed.ratio, changed.camera
    grid = int4(ratio.cols, ratio.rows, ratio.stride, camera.width)
    return float16(changed.camera_from_volume), intrinsics(camera), grid, changed.positions, ratio.values


def object_arguments(engine: Engine, table: ObjectTable, glow: Glow | None) -> tuple[KernelArgument, ...]:
    """OBJECT_PARAMETERS of include/shadows.clh."""
    sent = glow or no_glow(engine)
    return (table.count, table.grid_from_volume, table.dims, table.distances, *sent.arguments())


def _float4(rgb: NDArray[np.floating]) -> NDArray[np.float32]:
    """[..., 3] -> [...] float4 with w = 0."""
    padded = np.zeros((*rgb.shape[:-1], 4), np.float32)
    padded[..., :3] = rgb
    return padded.view(cl_types.float4)[..., 0]
