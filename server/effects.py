"""The table of effects: pure functions of what the spine made, each with the scenes that do not call for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.rigid import inverse_rigid
from server.opencl.engine import Engine
from server.plan import Effect, Omission
from server.stages import adaptive
from server.stages import composite as composite_stage
from server.stages import differential_rendering as differential
from server.stages.differential_rendering import DeviceLight, SampleGrid
from server.stages.measure import Measurement
from server.stages.radiance_transfer import Directions, Transfer
from server.stages.rasterize import Placed, VirtualSurface, pixel_box
from server.stages.rasterize import rasterize as rasterize_stage
from server.stages.raycast import Surface
from server.stages.sampling import PRESETS, Sampling
from server.stages.volume import Volume
from server.stages.voxelize import ObjectTable, object_table


@dataclass(frozen=True)
class View:
    """What one frame's effects share: the device, the camera and where it is."""

    engine: Engine
    camera: CameraModel
    volume_from_camera: NDArray[np.float64]
    reach_m: float
    """Length of visibility rays."""
    sampling: Sampling = PRESETS["reg4"]


@dataclass(frozen=True)
class SceneFacts:
    """Cheap facts about a frame that decide which effects it calls for."""

    objects: int
    objects_in_view: int
    has_light: bool
    adaptive: bool = False


def gather_facts(view: View, objects: Sequence[Placed], light: NDArray[np.float64]) -> SceneFacts:
    """Facts of a frame. light: SH radiance [bands^2, 3]."""
    camera_from_volume = inverse_rigid(view.volume_from_camera)
    boxes = [pixel_box(view.camera, camera_from_volume @ placed, *thing.bounds) for thing, placed in objects]
    return SceneFacts(
        len(objects),
        sum(box is not None for box in boxes),
        has_light=bool(light.any()),
        adaptive=view.sampling.adaptive,
    )


def rasterize(view: View, objects: Sequence[Placed]) -> VirtualSurface:
    """Draw the virtual objects into their geometry buffer."""
    return rasterize_stage(view.engine, view.camera, inverse_rigid(view.volume_from_camera), objects)


def tabulate(view: View, objects: Sequence[Placed]) -> ObjectTable:
    """Bring the objects' distance grids into one table that rays are traced through."""
    return object_table(view.engine, objects)


def shade_virtual(
    view: View, virtual: VirtualSurface, volume: Volume, rays: Directions, light: DeviceLight, table: ObjectTable
) -> SampleGrid:
    """Shadows of real and virtual things on virtual ones."""
    bands = round(light.coefficients.shape[0] ** 0.5)
    return differential.shadow_virtual(
        view.engine, view.camera, virtual, volume, bands, light, rays, view.reach_m, table
    )


def shadow_real(
    view: View,
    surface: Surface,
    transfer: Transfer,
    volume: Volume,
    rays: Directions,
    light: DeviceLight,
    objects: Sequence[Placed],
    table: ObjectTable,
) -> SampleGrid:
    """Shadows of virtual things on real ones."""
    return differential.shadow_real(
        view.engine, view.camera, surface, transfer, light, rays, view.reach_m, objects, table, volume.voxel_m
    )


def refine_virtual(
    view: View, virtual: VirtualSurface, volume: Volume, rays: Directions, light: DeviceLight, table: ObjectTable
) -> cl_array.Array:
    """Shadows on virtual things at every pixel near their edges."""
    bands = round(light.coefficients.shape[0] ** 0.5)
    return adaptive.refine_virtual(view.engine, view.camera, virtual, volume, bands, light, rays, view.reach_m, table)


def refine_real(
    view: View,
    surface: Surface,
    transfer: Transfer,
    volume: Volume,
    rays: Directions,
    light: DeviceLight,
    objects: Sequence[Placed],
    table: ObjectTable,
    ratio: SampleGrid,
) -> cl_array.Array:
    """Shadows on real things at every pixel of their rims."""
    return adaptive.refine_real(
        view.engine, view.camera, surface, transfer, volume, light, rays, view.reach_m, objects, table, ratio
    )


def composite(
    view: View,
    shown: NDArray[np.uint8],
    measurement: Measurement,
    surface: Surface,
    volume: Volume,
    light: DeviceLight,
    virtual: VirtualSurface | None = None,
    occluded: SampleGrid | None = None,
    ratio: SampleGrid | None = None,
    refined_occluded: cl_array.Array | None = None,
    refined_ratio: cl_array.Array | None = None,
) -> NDArray[np.uint8]:
    """The finished picture; with nothing virtual it is the camera's, byte for byte."""
    return composite_stage.composite(
        view.engine,
        view.camera,
        view.volume_from_camera,
        shown,
        measurement.radiance,
        surface,
        volume.voxel_m,
        light,
        virtual,
        occluded,
        ratio,
        refined_occluded,
        refined_ratio,
        view.sampling.upsampling,
    )


def _nothing_in_view(facts: SceneFacts) -> Omission | None:
    if facts.objects == 0:
        return Omission("there is no virtual object", 0.0)
    if facts.objects_in_view == 0:
        return Omission("no virtual object is in view", 0.0)
    return None


def _nothing_to_shade(facts: SceneFacts) -> Omission | None:
    return _nothing_in_view(facts) or _no_light(facts)


def _nothing_casts(facts: SceneFacts) -> Omission | None:
    if facts.objects == 0:
        return Omission("there is no virtual object", 0.0)
    return _no_light(facts)


def _no_light(facts: SceneFacts) -> Omission | None:
    return None if facts.has_light else Omission("no light has been found yet", 255.0)


def _not_refined(facts: SceneFacts) -> Omission | None:
    return None if facts.adaptive else Omission("the preset does not refine", 255.0)


EFFECTS: tuple[Effect[SceneFacts], ...] = (
    Effect(rasterize, writes="virtual", omitted=_nothing_in_view),
    Effect(tabulate, writes="table", omitted=_nothing_casts),
    Effect(shade_virtual, writes="occluded", omitted=_nothing_to_shade),
    Effect(shadow_real, writes="ratio", omitted=_nothing_casts),
    Effect(refine_virtual, writes="refined_occluded", omitted=lambda f: _nothing_to_shade(f) or _not_refined(f)),
    Effect(refine_real, writes="refined_ratio", omitted=lambda f: _nothing_casts(f) or _not_refined(f)),
    Effect(composite, writes="picture"),
)
"""One writer a resource; `composite` is what a frame wants."""
