"""What effects do: pure functions of what the spine made. Which of them a frame runs, effects.py says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.culling.rules import spared, spared_bounces
from server.input.measure import Measurement
from server.maths.rigid import inverse_rigid
from server.objects.rasterize import Placed, VirtualSurface, nearest_depths
from server.objects.rasterize import rasterize as rasterize_stage
from server.opencl.engine import Engine
from server.shading import adaptive
from server.shading import composite as composite_stage
from server.shading import differential_rendering as differential
from server.shading import layer as layer_stage
from server.shading import shadow_map as shadow_maps
from server.shading.change_mask import mark_changes
from server.shading.composite import CompositeInputs
from server.shading.depth_views import DepthViews
from server.shading.depth_views import look_around as look_around_stage
from server.shading.differential_rendering import RealShadow
from server.shading.layer import Layer
from server.shading.reflect import reflect_surroundings
from server.shading.shadow_map import DirectSamples, ShadowMaps
from server.shading.tone_mapping import Averages
from server.shading.traced_scene import Changed, DeviceLight, TracedScene, trace_scene
from server.shading.virtual_point_lights import VirtualPointLights, place_points
from server.transfer.indirect import Indirect
from server.transfer.radiance_transfer import Directions, Transfer
from server.transfer.real_depth_views import RealDepthViews
from server.transfer.sample_grid import SampleGrid
from server.transfer.sampling import PRESETS, Sampling
from server.volume.raycast import Surface
from server.volume.volume import Volume


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


def rasterize(view: View, objects: Sequence[Placed]) -> VirtualSurface:
    """Draw the virtual objects into their geometry buffer."""
    return rasterize_stage(view.engine, view.camera, inverse_rigid(view.volume_from_camera), objects)


def cover(view: View, objects: Sequence[Placed]) -> cl_array.Array:
    """How much of each pixel the virtual objects cover."""
    return nearest_depths(view.engine, view.camera, inverse_rigid(view.volume_from_camera), objects)


def look_around(view: View, objects: Sequence[Placed], real_looks: RealDepthViews) -> DepthViews:
    """Depth pictures that visibility is looked up in, of real surface and of each object."""
    return look_around_stage(view.engine, real_looks, objects)


def prepare_rays(
    view: View,
    objects: Sequence[Placed],
    volume: Volume,
    rays: Directions,
    light: DeviceLight,
    looks: DepthViews | None = None,
) -> TracedScene:
    """Bring together what rays are traced through: the volume, the objects' distance grids, the light beyond."""
    return replace(trace_scene(view.engine, volume, light, rays, view.reach_m, objects), looks=looks)


def shadow_map(view: View, objects: Sequence[Placed], volume: Volume, light: DeviceLight) -> ShadowMaps:
    """Pictures of what stands in the light's sharp parts."""
    return shadow_maps.draw_shadow_maps(view.engine, volume, light, objects, view.reach_m)


def light_objects(view: View, scene: TracedScene, maps: ShadowMaps | None = None) -> VirtualPointLights:
    """What virtual objects send to real surface and to one another."""
    placed = place_points(view.engine, scene.objects)
    glow = differential.light_points(view.engine, scene, placed)
    if maps is not None:
        shadow_maps.light_glow(view.engine, placed, glow, maps)
    return glow


def light_samples(view: View, surface: Surface, transfer: Transfer, maps: ShadowMaps) -> DirectSamples:
    """What the light's sharp parts bring to the samples of real surface, with objects and without."""
    samples = SampleGrid(transfer.stride, transfer.openness)
    parts = shadow_maps.trace_real(view.engine, view.camera, surface, samples, maps)
    return shadow_maps.light_samples(view.engine, view.camera, surface, parts, maps)


def shadow_real(
    view: View,
    surface: Surface,
    transfer: Transfer,
    scene: TracedScene,
    indirect: Indirect | None,
    glow: VirtualPointLights | None = None,
    maps: ShadowMaps | None = None,
    samples: DirectSamples | None = None,
) -> RealShadow:
    """What virtual things take from real ones, less what they send them."""
    lit = replace(scene, glow=glow)
    shadow = differential.shadow_real(view.engine, view.camera, surface, transfer, lit, indirect)
    if maps is None or samples is None:
        return shadow
    return replace(shadow, whole=shadow_maps.with_direct(view.engine, shadow, samples, maps))


def bounce_real(
    view: View,
    surface: Surface,
    transfer: Transfer,
    scene: TracedScene,
    ratio: RealShadow,
    returned: float,
    glow: VirtualPointLights | None = None,
    maps: ShadowMaps | None = None,
    samples: DirectSamples | None = None,
    everywhere: bool = False,
) -> RealShadow:
    """`ratio` with what real things then send one another less or more."""
    engine, lit = view.engine, replace(scene, glow=glow)
    camera_from_volume, spare = inverse_rigid(view.volume_from_camera), 0.0 if everywhere else spared_bounces()

    def bounced(shadow: RealShadow) -> RealShadow:
        return differential.bounce_real(
            engine, view.camera, camera_from_volume, surface, transfer, lit, shadow, returned, spare, ratio
        )

    if maps is None or samples is None or not isinstance(ratio.whole, RealShadow):
        return bounced(ratio)
    return shadow_maps.without_direct(engine, bounced(ratio.whole), ratio, samples, maps)


def add_objects(
    view: View,
    surface: Surface,
    scene: TracedScene,
    glow: VirtualPointLights | None = None,
    ratio: RealShadow | None = None,
    bounced: RealShadow | None = None,
) -> TracedScene:
    """The scene as virtual objects have changed it: what they send, and what real surface sends besides them."""
    settled = bounced or ratio
    if settled is None:
        return replace(scene, glow=glow)
    change = settled.whole or settled
    changed = Changed(view.camera, inverse_rigid(view.volume_from_camera), surface.positions, change)
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
    bounced: RealShadow | None = None,
    glow: VirtualPointLights | None = None,
    virtual: VirtualSurface | None = None,
) -> cl_array.Array:
    """Shadows on real things at every pixel of their rims."""
    lit, eye = replace(scene.by_rays(), glow=glow), view.volume_from_camera[:3, 3]
    return adaptive.refine_real(view.engine, view.camera, surface, lit, bounced or ratio, virtual, eye)


def shadow_everywhere() -> bool:
    """Shadow real things where that is hardly seen, too."""
    return True


def find_reach(
    view: View,
    surface: Surface,
    volume: Volume,
    ratio: RealShadow,
    bounced: RealShadow | None = None,
    refined_ratio: cl_array.Array | None = None,
    everywhere: bool = False,
) -> cl_array.Array:
    """Cells of the picture in which virtual things are seen to change real ones, or `everywhere` in which they do."""
    spare = 0.0 if everywhere else spared()
    upsampling, settled = view.sampling.upsampling, bounced or ratio
    return mark_changes(view.engine, view.camera, surface, settled, refined_ratio, volume.voxel_m, spare, upsampling)


def direct_virtual(view: View, virtual: VirtualSurface, maps: ShadowMaps) -> cl_array.Array:
    """What the light's sharp parts bring to virtual surface."""
    return shadow_maps.light_virtual(view.engine, view.camera, virtual, maps)


def direct_real(
    view: View,
    surface: Surface,
    ratio: RealShadow,
    maps: ShadowMaps,
    bounced: RealShadow | None = None,
    refined_ratio: cl_array.Array | None = None,
    reached: cl_array.Array | None = None,
) -> cl_array.Array:
    """What virtual things take from real ones of the whole light, its sharp parts at every pixel."""
    engine, camera, upsampling, ratio = view.engine, view.camera, view.sampling.upsampling, bounced or ratio
    parts = shadow_maps.trace_real(engine, camera, surface, ratio, maps)
    return shadow_maps.light_real(engine, camera, surface, ratio, parts, maps, refined_ratio, upsampling, reached)


def match_average(averages: Averages) -> float:
    """How much brighter than the light's own scale virtual things are (7.1, H)."""
    return averages.gain


def mixture(
    view: View,
    measurement: Measurement,
    surface: Surface,
    volume: Volume,
    light: DeviceLight,
    virtual: VirtualSurface | None = None,
    occluded: SampleGrid | None = None,
    ratio: SampleGrid | None = None,
    bounced: SampleGrid | None = None,
    refined_occluded: cl_array.Array | None = None,
    refined_ratio: cl_array.Array | None = None,
    coverage: cl_array.Array | None = None,
    reflected: cl_array.Array | None = None,
    gain: float = 1.0,
    lit_virtual: cl_array.Array | None = None,
    whole_ratio: cl_array.Array | None = None,
    reached: cl_array.Array | None = None,
) -> CompositeInputs:
    """What is virtual in the picture, and what it changes of the rest. No effect: what the next two read."""
    if lit_virtual is None and virtual is not None and light.discs:
        lit_virtual = view.engine.workspace.constant("unlit", np.zeros(surface.positions.shape, cl_types.float4))
    return CompositeInputs(
        view.camera,
        view.volume_from_camera,
        measurement.radiance,
        surface,
        volume.voxel_m,
        light,
        virtual,
        occluded,
        bounced or ratio,
        refined_occluded,
        refined_ratio,
        view.sampling.upsampling,
        coverage,
        reflected,
        gain,
        lit_virtual,
        whole_ratio,
        reached,
    )


def composite(view: View, shown: NDArray[np.uint8], **mixed: Any) -> NDArray[np.uint8]:
    """The finished picture; with nothing virtual it is the camera's, byte for byte."""
    return composite_stage.composite(view.engine, shown, mixture(view, **mixed))


def compose_layer(view: View, **mixed: Any) -> Layer:
    """What is virtual, apart from the camera's picture."""
    return layer_stage.compose_layer(view.engine, mixture(view, **mixed))
