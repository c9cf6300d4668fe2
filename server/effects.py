"""The table of effects: pure functions of what the spine made, each with the scenes that do not call for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.direct_lights import split_light
from server.maths.rigid import inverse_rigid
from server.opencl.engine import Engine
from server.plan import Effect, Omission
from server.stages import adaptive
from server.stages import composite as composite_stage
from server.stages import differential_rendering as differential
from server.stages import shadow_map as shadow_maps
from server.stages.differential_rendering import RealShadow
from server.stages.image_space_rendering import Looks, RealLooks
from server.stages.image_space_rendering import look_around as look_around_stage
from server.stages.indirect import Indirect
from server.stages.measure import Measurement
from server.stages.object_glow import Glow, place_points
from server.stages.radiance_transfer import Directions, Transfer
from server.stages.rasterize import Placed, VirtualSurface, boxes_in_view, nearest_depths
from server.stages.rasterize import rasterize as rasterize_stage
from server.stages.raycast import Surface
from server.stages.reflect import is_glossy, reflect_surroundings
from server.stages.sample_grid import SampleGrid
from server.stages.sampling import PRESETS, Sampling
from server.stages.shadow_map import ShadowMaps
from server.stages.tone_mapping import Averages
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
    image_space: bool = False
    """Whether visibility is looked up in depth pictures."""
    glossy: bool = False
    """Whether any virtual surface is not matt."""
    sharp_lights: int = 0
    """That shadow maps are for."""
    averages: Averages | None = None
    """Of the picture and its shading, None where they are not to be matched."""


def gather_facts(
    view: View,
    objects: Sequence[Placed],
    light: NDArray[np.float64],
    indirect: Indirect | None,
    averages: Averages | None = None,
) -> SceneFacts:
    """Facts of a frame. light: SH radiance [bands^2, 3]; averages: to be matched, None: none are."""
    camera_from_volume = inverse_rigid(view.volume_from_camera)
    boxes = boxes_in_view(view.camera, camera_from_volume, objects)
    return SceneFacts(
        len(objects),
        sum(box is not None for box in boxes),
        has_light=bool(light.any()),
        adaptive=view.sampling.adaptive,
        image_space=view.sampling.image_space,
        indirect=indirect is not None,
        smooth_edges=view.smooth_edges,
        glossy=any(is_glossy(thing.tables.materials) for thing, _ in objects),
        sharp_lights=len(split_light(light).discs),
        averages=averages,
    )


def rasterize(view: View, objects: Sequence[Placed]) -> VirtualSurface:
    """Draw the virtual objects into their geometry buffer."""
    return rasterize_stage(view.engine, view.camera, inverse_rigid(view.volume_from_camera), objects)


def cover(view: View, objects: Sequence[Placed]) -> cl_array.Array:
    """How much of each pixel the virtual objects cover."""
    return nearest_depths(view.engine, view.camera, inverse_rigid(view.volume_from_camera), objects)


def look_around(view: View, objects: Sequence[Placed], real_looks: RealLooks) -> Looks:
    """Depth pictures that visibility is looked up in, of real surface and of each object."""
    return look_around_stage(view.engine, real_looks, objects)


def prepare_rays(
    view: View,
    objects: Sequence[Placed],
    volume: Volume,
    rays: Directions,
    light: DeviceLight,
    looks: Looks | None = None,
) -> TracedScene:
    """Bring together what rays are traced through: the volume, the objects' distance grids, the light beyond."""
    return replace(trace_scene(view.engine, volume, light, rays, view.reach_m, objects), looks=looks)


def shadow_map(view: View, objects: Sequence[Placed], volume: Volume, light: DeviceLight) -> ShadowMaps:
    """Pictures of what stands in the light's sharp parts."""
    return shadow_maps.draw_shadow_maps(view.engine, volume, light, objects, view.reach_m)


def light_objects(view: View, scene: TracedScene, maps: ShadowMaps | None = None) -> Glow:
    """What virtual objects send to real surface and to one another."""
    placed = place_points(view.engine, scene.objects)
    glow = differential.light_points(view.engine, scene, placed)
    if maps is not None:
        shadow_maps.light_glow(view.engine, placed, glow, maps)
    return glow


def shadow_real(
    view: View,
    surface: Surface,
    transfer: Transfer,
    scene: TracedScene,
    indirect: Indirect | None,
    glow: Glow | None = None,
    maps: ShadowMaps | None = None,
) -> RealShadow:
    """What virtual things take from real ones, less what they send them, and what those then send one another."""
    lit = replace(scene, glow=glow)
    shadow = differential.shadow_real(view.engine, view.camera, surface, transfer, lit, indirect)
    if indirect is None:
        return shadow
    camera_from_volume = inverse_rigid(view.volume_from_camera)
    if maps is None:
        return differential.bounce_real(view.engine, view.camera, camera_from_volume, surface, transfer, lit, shadow)
    parts = shadow_maps.trace_real(view.engine, view.camera, surface, shadow, maps)
    samples = shadow_maps.light_samples(view.engine, view.camera, surface, parts, maps)
    whole = shadow_maps.with_direct(view.engine, shadow, samples, maps)
    whole = differential.bounce_real(view.engine, view.camera, camera_from_volume, surface, transfer, lit, whole)
    return shadow_maps.without_direct(view.engine, whole, shadow, samples, maps)


def add_objects(
    view: View, surface: Surface, scene: TracedScene, glow: Glow | None = None, ratio: RealShadow | None = None
) -> TracedScene:
    """The scene as virtual objects have changed it: what they send, and what real surface sends besides them."""
    if ratio is None:
        return replace(scene, glow=glow)
    changed = Changed(view.camera, inverse_rigid(view.volume_from_camera), surface.positions, ratio.whole or ratio)
    return replace(scene, glow=glow, changed=changed)


def shade_virtual(view: View, virtual: VirtualSurface, changed_scene: TracedScene) -> SampleGrid:
    """What real and virtual things take from virtual ones, less what they send them."""
    return differential.shadow_virtual(view.engine, view.camera, virtual, changed_scene)


def reflect(view: View, virtual: VirtualSurface, changed_scene: TracedScene) -> cl_array.Array:
    """What glossy virtual things reflect; traced in both families."""
    return reflect_surroundings(view.engine, view.camera, view.volume_from_camera, virtual, changed_scene.by_rays())


def refine_virtual(view: View, virtual: VirtualSurface, changed_scene: TracedScene) -> cl_array.Array:
    """Shadows on virtual things at every pixel near their edges."""
    return adaptive.refine_virtual(view.engine, view.camera, virtual, changed_scene.by_rays())


def refine_real(
    view: View,
    surface: Surface,
    scene: TracedScene,
    ratio: RealShadow,
    glow: Glow | None = None,
    virtual: VirtualSurface | None = None,
) -> cl_array.Array:
    """Shadows on real things at every pixel of their rims."""
    lit, eye = replace(scene.by_rays(), glow=glow), view.volume_from_camera[:3, 3]
    return adaptive.refine_real(view.engine, view.camera, surface, lit, ratio, virtual, eye)


def direct_virtual(view: View, virtual: VirtualSurface, maps: ShadowMaps) -> cl_array.Array:
    """What the light's sharp parts bring to virtual surface."""
    return shadow_maps.light_virtual(view.engine, view.camera, virtual, maps)


def direct_real(
    view: View,
    surface: Surface,
    ratio: RealShadow,
    maps: ShadowMaps,
    refined_ratio: cl_array.Array | None = None,
) -> cl_array.Array:
    """What virtual things take from real ones of the whole light, its sharp parts at every pixel."""
    parts = shadow_maps.trace_real(view.engine, view.camera, surface, ratio, maps)
    upsampling = view.sampling.upsampling
    return shadow_maps.light_real(view.engine, view.camera, surface, ratio, parts, maps, refined_ratio, upsampling)


def match_average(averages: Averages) -> float:
    """How much brighter than the light's own scale virtual things are (7.1, H)."""
    return averages.gain


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
    gain: float = 1.0,
    lit_virtual: cl_array.Array | None = None,
    whole_ratio: cl_array.Array | None = None,
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
        gain,
        lit_virtual,
        whole_ratio,
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


def _traced(facts: SceneFacts) -> Omission | None:
    return None if facts.image_space else Omission("the preset traces rays through the volume", 0.0)


def _matt(facts: SceneFacts) -> Omission | None:
    return None if facts.glossy else Omission("no virtual object is glossy", 0.0)


def _soft(facts: SceneFacts) -> Omission | None:
    return None if facts.sharp_lights else Omission("the light is soft", 0.0)


def _not_matched(facts: SceneFacts) -> Omission | None:
    if facts.averages is None:
        return Omission("virtual things keep the light's own scale", 255.0)
    if not facts.averages.are_known:
        return Omission("the picture or its shading is empty or black: the light's own scale holds", 255.0)
    return None


def _hard_edges(facts: SceneFacts) -> Omission | None:
    return None if facts.smooth_edges else Omission("hard edges are asked for", 255.0)


def _not_refined(facts: SceneFacts) -> Omission | None:
    return None if facts.adaptive else Omission("the preset does not refine", 255.0)


EFFECTS: tuple[Effect[SceneFacts], ...] = (
    Effect(rasterize, writes="virtual", omitted=_nothing_in_view),
    Effect(cover, writes="coverage", omitted=lambda f: _nothing_in_view(f) or _hard_edges(f)),
    Effect(look_around, writes="looks", omitted=lambda f: _nothing_casts(f) or _traced(f)),
    Effect(prepare_rays, writes="scene", omitted=_nothing_casts),
    Effect(shadow_map, writes="maps", omitted=lambda f: _nothing_casts(f) or _soft(f)),
    Effect(light_objects, writes="glow", omitted=lambda f: _nothing_casts(f) or _nothing_sent(f)),
    Effect(add_objects, writes="changed_scene", omitted=_nothing_casts),
    Effect(reflect, writes="reflected", omitted=lambda f: _nothing_to_shade(f) or _matt(f)),
    Effect(shade_virtual, writes="occluded", omitted=_nothing_to_shade),
    Effect(shadow_real, writes="ratio", omitted=_nothing_casts),
    Effect(refine_virtual, writes="refined_occluded", omitted=lambda f: _nothing_to_shade(f) or _not_refined(f)),
    Effect(refine_real, writes="refined_ratio", omitted=lambda f: _nothing_casts(f) or _not_refined(f)),
    Effect(direct_virtual, writes="lit_virtual", omitted=lambda f: _nothing_to_shade(f) or _soft(f)),
    Effect(direct_real, writes="whole_ratio", omitted=lambda f: _nothing_casts(f) or _soft(f)),
    Effect(match_average, writes="gain", omitted=lambda f: _nothing_to_shade(f) or _not_matched(f)),
    Effect(composite, writes="picture"),
)
"""One writer a resource; `composite` is what a frame wants."""
