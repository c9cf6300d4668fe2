"""What effects do: pure functions of the frame and of resources. Which of them a frame runs, table.py says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from server.effects.resources import (
    BouncedShadow,
    ChangedScene,
    ChangeMask,
    DirectReal,
    DirectVirtual,
    FaintShadows,
    FirstShadow,
    Gain,
    KnownLight,
    RefinedReal,
    RefinedVirtual,
    Reflected,
    ReturnedRadiance,
    SharpLight,
    VirtualObjects,
    VirtualOcclusion,
)
from server.frame_context import FrameContext
from server.objects import rasterize as raster
from server.objects.rasterize import VirtualSurface
from server.shading import adaptive, change_mask, depth_views
from server.shading import differential_rendering as differential
from server.shading import shadow_map as shadow_maps
from server.shading.depth_views import DepthViews
from server.shading.differential_rendering import DirectSamples, RealShadow
from server.shading.reflect import reflect_surroundings
from server.shading.shadow_map import ShadowMaps
from server.shading.tone_mapping import Averages
from server.shading.traced_scene import Changed, TracedScene, trace_scene
from server.shading.virtual_point_lights import VirtualPointLights, place_points
from server.transfer.indirect import Indirect
from server.transfer.radiance_transfer import Transfer
from server.transfer.real_depth_views import RealDepthViews
from server.transfer.sample_grid import SampleGrid


def rasterize(context: FrameContext, objects: VirtualObjects) -> VirtualSurface:
    """Draw the virtual objects into their geometry buffer (fig. 7.5), and how much of each pixel they cover."""
    parts = raster.subpixels(context.camera) if context.smooth_edges else 1
    return raster.rasterize(context.engine, context.camera, context.camera_from_volume, objects, parts=parts)


def draw_depth_views(context: FrameContext, objects: VirtualObjects, real: RealDepthViews) -> DepthViews:
    """Depth pictures that visibility is looked up in, of real surface and of each object (7.3)."""
    return depth_views.draw_depth_views(context.engine, real, objects)


def prepare_rays(
    context: FrameContext, objects: VirtualObjects, light: KnownLight, views: DepthViews | None
) -> TracedScene:
    """Bring together what rays are traced through: the volume, the objects' distance grids, the light beyond."""
    scene = trace_scene(context.engine, context.volume, light, context.rays, context.ray_length_m, objects)
    return replace(scene, depth_views=views)


def shadow_map(context: FrameContext, objects: VirtualObjects, light: SharpLight) -> ShadowMaps:
    """Shadow maps along the discs of the light (7.2.3)."""
    return shadow_maps.draw_shadow_maps(
        context.engine,
        context.volume,
        light,
        objects,
        context.ray_length_m,
        follows_discs=context.follows_light,
    )


def first_shadow(
    context: FrameContext,
    transfer: Transfer,
    scene: TracedScene,
    indirect: Indirect | None,
    samples: DirectSamples | None,
) -> FirstShadow:
    """What virtual things take from real ones, for the light that they send: an object's underside sees its shadow.

    At every fourth sample: a point of an object sees the shadows of many. Where shadow_real kept what it found, that is
    used, which has what the objects sent.
    """
    engine, camera, surface, eye = context.engine, context.camera, context.surface, _eye(context)
    found = differential.shadow_real(engine, camera, surface, transfer, scene, indirect, samples, step=2, eye=eye)
    return FirstShadow(found)


def light_objects(
    context: FrameContext, scene: TracedScene, maps: ShadowMaps | None, shadow: FirstShadow | None
) -> VirtualPointLights:
    """What virtual objects send to real surface and to one another (7.3.3)."""
    placed = place_points(context.engine, scene.objects)
    lights = differential.light_points(context.engine, _changed_by(context, scene, shadow), placed)
    if maps is not None:
        shadow_maps.light_points_by_discs(context.engine, placed, lights, maps)
    return lights


def light_samples(context: FrameContext, transfer: Transfer, maps: ShadowMaps) -> DirectSamples:
    """What the discs bring to the samples of real surface, with objects and without."""
    samples = SampleGrid(transfer.stride, transfer.openness)
    parts = shadow_maps.trace_real(context.engine, context.camera, context.surface, samples, maps, transfer.cells)
    return shadow_maps.light_samples(context.engine, context.camera, context.surface, parts, maps, transfer.cells)


def shadow_real(
    context: FrameContext,
    transfer: Transfer,
    scene: TracedScene,
    indirect: Indirect | None,
    lights: VirtualPointLights | None,
    samples: DirectSamples | None,
) -> RealShadow:
    """What virtual things take from real ones, less what they send to them (eq. 7.1)."""
    lit = replace(scene, point_lights=lights)
    engine, camera, surface, eye = context.engine, context.camera, context.surface, _eye(context)
    return differential.shadow_real(engine, camera, surface, transfer, lit, indirect, samples, eye=eye)


def _eye(context: FrameContext) -> NDArray[np.float64] | None:
    """Where the camera is, for what is kept; None in frames that are drawn as their very light has it."""
    return None if context.follows_light else context.volume_from_camera[:3, 3]


def bounce_real(
    context: FrameContext,
    transfer: Transfer,
    scene: TracedScene,
    indirect: Indirect,
    ratio: RealShadow,
    returned: ReturnedRadiance,
    faint: FaintShadows,
    lights: VirtualPointLights | None,
    samples: DirectSamples | None,
) -> BouncedShadow:
    """`ratio` with what real things then send to one another, less or more (eq. 7.6)."""
    assert indirect.met is not None
    shadow = differential.bounce_real(
        context.engine,
        context.camera,
        context.camera_from_volume,
        context.surface,
        transfer,
        replace(scene, point_lights=lights),
        ratio,
        indirect.met,
        returned,
        faint.sample_share,
        samples,
    )
    return BouncedShadow(shadow)


def add_objects(
    context: FrameContext,
    scene: TracedScene,
    lights: VirtualPointLights | None,
    ratio: RealShadow | None,
    bounced: BouncedShadow | None,
) -> ChangedScene:
    """The scene as virtual objects have changed it: what they send, and what real surface sends besides them."""
    return ChangedScene(_changed_by(context, replace(scene, point_lights=lights), bounced or ratio))


def _changed_by(context: FrameContext, scene: TracedScene, shadow: RealShadow | None) -> TracedScene:
    """`scene` with what real surface sends under `shadow`."""
    if shadow is None:
        return scene
    change = shadow.whole or shadow
    changed = Changed(context.camera, context.camera_from_volume, context.surface.positions, change)
    return replace(scene, changed=changed)


def shade_virtual(context: FrameContext, virtual: VirtualSurface, scene: ChangedScene) -> VirtualOcclusion:
    """What real and virtual things take from virtual ones, less what they send to them."""
    return VirtualOcclusion(differential.shadow_virtual(context.engine, context.camera, virtual, scene, _eye(context)))


def reflect(context: FrameContext, virtual: VirtualSurface, scene: ChangedScene) -> Reflected:
    """What glossy virtual things reflect (fig. 8.4); traced by rays in both families."""
    pose = context.volume_from_camera
    return Reflected(reflect_surroundings(context.engine, context.camera, pose, virtual, scene.by_rays()))


def refine_virtual(context: FrameContext, virtual: VirtualSurface, scene: ChangedScene) -> RefinedVirtual:
    """Shadows on virtual things at every pixel near their edges (6.1.1)."""
    return RefinedVirtual(adaptive.refine_virtual(context.engine, context.camera, virtual, scene.by_rays()))


def refine_real(
    context: FrameContext,
    scene: TracedScene,
    ratio: RealShadow,
    bounced: BouncedShadow | None,
    lights: VirtualPointLights | None,
    virtual: VirtualSurface | None,
) -> RefinedReal:
    """Shadows on real things at every pixel of their rims (6.1.1)."""
    lit, eye = replace(scene.by_rays(), point_lights=lights), context.volume_from_camera[:3, 3]
    engine, camera, surface = context.engine, context.camera, context.surface
    return RefinedReal(adaptive.refine_real(engine, camera, surface, lit, bounced or ratio, virtual, eye))


def mark_changes(
    context: FrameContext,
    ratio: RealShadow,
    bounced: BouncedShadow | None,
    refined: RefinedReal | None,
    faint: FaintShadows,
) -> ChangeMask:
    """Cells of the picture in which virtual things change real ones by more than may be left out."""
    mask = change_mask.mark_changes(
        context.engine,
        context.camera,
        context.surface,
        bounced or ratio,
        refined,
        context.volume.voxel_m,
        faint.pixel_share,
        context.sampling.upsampling,
    )
    return ChangeMask(mask)


def match_average(averages: Averages) -> Gain:
    """How much brighter than the light's own scale virtual things are, to match the picture (7.1, H)."""
    return Gain(averages.gain)


def direct_virtual(context: FrameContext, virtual: VirtualSurface, maps: ShadowMaps) -> DirectVirtual:
    """What the discs of the light bring to virtual surface."""
    return DirectVirtual(shadow_maps.light_virtual(context.engine, context.camera, virtual, maps))


def direct_real(
    context: FrameContext,
    transfer: Transfer,
    ratio: RealShadow,
    maps: ShadowMaps,
    bounced: BouncedShadow | None,
    refined: RefinedReal | None,
    changed: ChangeMask | None,
) -> DirectReal:
    """What virtual things take from real ones of the whole light, its discs at every pixel (7.2.3)."""
    engine, camera, surface, shadow = context.engine, context.camera, context.surface, bounced or ratio
    parts = shadow_maps.trace_real(engine, camera, surface, shadow, maps, transfer.cells, keeps=True)
    upsampling = context.sampling.upsampling
    return DirectReal(
        shadow_maps.light_real(engine, camera, surface, shadow, parts, maps, refined, upsampling, changed)
    )
