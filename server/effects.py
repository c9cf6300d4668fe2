"""The table of effects: pure functions of what the spine made, each with the scenes that do not call for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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
from server.stages.differential_rendering import RealShadow
from server.stages.indirect import Indirect
from server.stages.measure import Measurement
from server.stages.object_glow import Glow
from server.stages.radiance_transfer import Directions, Transfer
from server.stages.rasterize import Placed, VirtualSurface, boxes_in_view, nearest_depths
from server.stages.rasterize import rasterize as rasterize_stage
from server.stages.raycast import Surface
from server.stages.reflect import is_glossy, reflect_surroundings
from server.stages.sample_grid import SampleGrid
from server.stages.sampling import PRESETS, Sampling
from server.stages.traced_scene import Changed, DeviceLight, TracedScene, trace_scene
from server.stages.volume import Volume


@dataclass(frozen=True)
class View:
    """What one frame's effects share: the device, the camera and where it is."""

    engine: Engine
    camera: CameraModel
    volume_from_camera: NDArray[np.float64]
    reach_m: float
    """Length of visibility rays."""
    sampling: Sampling = PRESETS["reg4"]
    smooth_edges: bool = True
    """Whether virtual things cover parts of pixels."""


@dataclass(frozen=True)
class SceneFacts:
    """Cheap facts about a frame that decide which effects it calls for."""

    objects: int
    objects_in_view: int
    has_light: bool
    adaptive: bool = False
    indirect: bool = False
    """Whether surfaces send light."""
    smooth_edges: bool = True
    glossy: bool = False
    """Whether any virtual surface is not matt."""


def gather_facts(
    view: View, objects: Sequence[Placed], light: NDArray[np.float64], indirect: Indirect | None
) -> SceneFacts:
    """Facts of a frame. light: SH radiance [bands^2, 3]."""
    camera_from_volume = inverse_rigid(view.volume_from_camera)
    boxes = boxes_in_view(view.camera, camera_from_volume, objects)
    return SceneFacts(
        len(objects),
        sum(box is not None for box in boxes),
        has_light=bool(light.any()),
        adaptive=view.sampling.adaptive,
        indirect=indirect is not None,
        smooth_edges=view.smooth_edges,
        glossy=any(is_glossy(thing.tables.materials) for thing, _ in objects),
    )


def rasterize(view: View, objects: Sequence[Placed]) -> VirtualSurface:
    """Draw the virtual objects into their geometry buffer."""
    return rasterize_stage(view.engine, view.camera, inverse_rigid(view.volume_from_camera), objects)


def cover(view: View, objects: Sequence[Placed]) -> cl_array.Array:
    """How much of each pixel the virtual objects cover."""
    return nearest_depths(view.engine, view.camera, inverse_rigid(view.volume_from_camera), objects)


def prepare_rays(
    view: View, objects: Sequence[Placed], volume: Volume, rays: Directions, light: DeviceLight
) -> TracedScene:
    """Bring together what rays are traced through: the volume, the objects' distance grids, the light beyond."""
    return trace_scene(view.engine, volume, light, rays, view.reach_m, objects)


def light_objects(view: View, scene: TracedScene) -> Glow:
    """What virtual objects send to real surface and to one another."""
    return differential.light_points(view.engine, scene)


def shadow_real(
    view: View,
    surface: Surface,
    transfer: Transfer,
    scene: TracedScene,
    indirect: Indirect | None,
    glow: Glow | None = None,
) -> RealShadow:
    """What virtual things take from real ones, less what they send them, and what those then send one another."""
    lit = replace(scene, glow=glow)
    shadow = differential.shadow_real(view.engine, view.camera, surface, transfer, lit, indirect)
    if indirect is None:
        return shadow
    camera_from_volume = inverse_rigid(view.volume_from_camera)
    return differential.bounce_real(view.engine, view.camera, camera_from_volume, surface, transfer, lit, shadow)


def add_objects(
    view: View, surface: Surface, scene: TracedScene, glow: Glow | None = None, ratio: RealShadow | None = None
) -> TracedScene:
    """The scene as virtual objects have changed it: what they send, and what real surface sends besides them."""
    if ratio is None:
        return replace(scene, glow=glow)
    changed = Changed(view.camera, inverse_rigid(view.volume_from_camera), surface.positions, ratio)
    return replace(scene, glow=glow, changed=changed)


def shade_virtual(view: View, virtual: VirtualSurface, changed_scene: TracedScene) -> SampleGrid:
    """What real and virtual things take from virtual ones, less what they send them."""
    return differential.shadow_virtual(view.engine, view.camera, virtual, changed_scene)


def reflect(view: View, virtual: VirtualSurface, changed_scene: TracedScene) -> cl_array.Array:
    """What glossy virtual things reflect."""
    return reflect_surroundings(view.engine, view.camera, view.volume_from_camera, virtual, changed_scene)


def refine_virtual(view: View, virtual: VirtualSurface, changed_scene: TracedScene) -> cl_array.Array:
    """Shadows on virtual things at every pixel near their edges."""
    return adaptive.refine_virtual(view.engine, view.camera, virtual, changed_scene)


def refine_real(
    view: View, surface: Surface, scene: TracedScene, ratio: RealShadow, glow: Glow | None = None
) -> cl_array.Array:
    """Shadows on real things at every pixel of their rims."""
    return adaptive.refine_real(view.engine, view.camera, surface, replace(scene, glow=glow), ratio)


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
    coverage: cl_array.Array | None = None,
    reflected: cl_array.Array | None = None,
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
        coverage,
        reflected,
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


def _nothing_sent(facts: SceneFacts) -> Omission | None:
    return None if facts.indirect else Omission("indirect light is left out", 255.0)


def _matt(facts: SceneFacts) -> Omission | None:
    return None if facts.glossy else Omission("no virtual object is glossy", 0.0)


def _hard_edges(facts: SceneFacts) -> Omission | None:
    return None if facts.smooth_edges else Omission("hard edges are asked for", 255.0)


def _not_refined(facts: SceneFacts) -> Omission | None:
    return None if facts.adaptive else Omission("the preset does not refine", 255.0)


EFFECTS: tuple[Effect[SceneFacts], ...] = (
    Effect(rasterize, writes="virtual", omitted=_nothing_in_view),
    Effect(cover, writes="coverage", omitted=lambda f: _nothing_in_view(f) or _hard_edges(f)),
    Effect(prepare_rays, writes="scene", omitted=_nothing_casts),
    Effect(light_objects, writes="glow", omitted=lambda f: _nothing_casts(f) or _nothing_sent(f)),
    Effect(add_objects, writes="changed_scene", omitted=_nothing_casts),
    Effect(reflect, writes="reflected", omitted=lambda f: _nothing_to_shade(f) or _matt(f)),
    Effect(shade_virtual, writes="occluded", omitted=_nothing_to_shade),
    Effect(shadow_real, writes="ratio", omitted=_nothing_casts),
    Effect(refine_virtual, writes="refined_occluded", omitted=lambda f: _nothing_to_shade(f) or _not_refined(f)),
    Effect(refine_real, writes="refined_ratio", omitted=lambda f: _nothing_casts(f) or _not_refined(f)),
    Effect(composite, writes="picture"),
)
"""One writer a resource; `composite` is what a frame wants."""
