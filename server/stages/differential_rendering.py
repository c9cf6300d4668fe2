"""Differential rendering (thesis 7.1-7.2): shading with and without virtual objects.

Kernel: differential_rendering.cl.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.engine import Engine, KernelArgument, float4
from server.stages.continuation import NO_PLANES, PlaneArrays, plane_arguments
from server.stages.radiance_transfer import Directions, Transfer, own_sets
from server.stages.rasterize import Placed, VirtualSurface
from server.stages.raycast import Surface
from server.stages.volume import Volume
from server.stages.voxelize import ObjectTable

VIRTUAL_STRIDE = 2
"""Occlusion of virtual surfaces is traced at every second pixel; the unoccluded part is exact at every pixel."""


@dataclass(frozen=True)
class DeviceLight:
    """The light on the device."""

    coefficients: cl_array.Array
    """[bands^2] float4: RGB radiance coefficients."""
    arriving: cl_array.Array
    """[SETS, count] float4: RGB radiance from each direction that visibility is tested along."""
    continued: tuple[KernelArgument, ...]
    """Planes that hide it where the volume is empty, as Continued of include/continued.clh takes them."""


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


def upload_light(
    engine: Engine, sh: NDArray[np.float64], rays: Directions, planes: PlaneArrays = NO_PLANES
) -> DeviceLight:
    """Bring radiance coefficients [bands^2, 3], what they send along `rays`, and what hides it, to the device."""
    arriving = rays.basis @ sh.astype(np.float32)
    return DeviceLight(
        engine.workspace.upload("light", _float4(sh)),
        engine.workspace.upload("arriving", _float4(arriving)),
        plane_arguments(engine, "light_planes", planes),
    )


def shadow_real(
    engine: Engine,
    camera: CameraModel,
    surface: Surface,
    transfer: Transfer,
    light: DeviceLight,
    rays: Directions,
    reach_m: float,
    objects: Sequence[Placed],
    table: ObjectTable,
    voxel_m: float,
) -> SampleGrid:
    """Ratio R' / R of real surface shaded with and without the objects, at the transfer's samples (eq. 7.1)."""
    shape = (transfer.rows, transfer.cols)
    ratio = SampleGrid(transfer.stride, engine.workspace.array("shadow_ratio", shape, cl_types.float4))
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
        transfer.free_mask,
        transfer.sets if transfer.sets is not None else own_sets(engine, transfer.rows, transfer.cols),
        light.coefficients,
        rays.count,
        rays.on_device(engine),
        light.arriving,
        reach_m,
        *object_arguments(table),
        ball_around(objects),
        voxel_m,
        ratio.values,
    )
    return ratio


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
        rays.count,
        rays.on_device(engine),
        light.arriving,
        reach_m,
        *light.continued,
        *object_arguments(table),
        max(table.cell_m, default=0.0),
        occluded.values,
    )
    return occluded


def object_arguments(table: ObjectTable) -> tuple[KernelArgument, ...]:
    """What trace_objects of include/virtual_objects.clh takes, in its order."""
    return table.count, table.grid_from_volume, table.dims, table.distances


def _float4(rgb: NDArray[np.floating]) -> NDArray[np.float32]:
    """[..., 3] -> [...] float4 with w = 0."""
    padded = np.zeros((*rgb.shape[:-1], 4), np.float32)
    padded[..., :3] = rgb
    return padded.view(cl_types.float4)[..., 0]
