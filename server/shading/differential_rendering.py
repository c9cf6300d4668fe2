"""Differential rendering (thesis 7.1-7.2): shading with and without virtual objects.

Kernel: differential_rendering.cl.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.objects.dirty_region import DirtyRegion, box_around
from server.objects.rasterize import VirtualSurface
from server.opencl.buffers import BufferDescription, StageBuffers, Workspace
from server.opencl.engine import Engine, KernelArgument, float4, int4
from server.shading.shadow_cells import RealShadows, VirtualOcclusions, no_cells, shadow_cells
from server.shading.traced_scene import Changed, TracedScene
from server.shading.virtual_point_lights import PlacedPoints, VirtualPointLights, place_points
from server.transfer.indirect import Indirect, no_hits
from server.transfer.radiance_transfer import Transfer, sample_arguments, sample_grid
from server.transfer.sample_grid import NO_GRID, SampleGrid, grid_of
from server.volume.raycast import Surface

VIRTUAL_STRIDE = 2
"""Occlusion of virtual surfaces is traced at every second pixel; the unoccluded part is exact at every pixel."""
SHARED_ITEMS = 64
"""Work-items of a group, as in include/sharers.clh."""
MOST_POINTS = 8192
"""At most this many points on objects are lit one by one; the others see an even light."""


class _Buffers(StageBuffers):
    ratio = BufferDescription(cl_types.float4)
    """[rows, cols] R' / R of real surface (eq. 7.1), w = 1 valid."""
    shaded = BufferDescription(cl_types.float4)
    """[rows, cols] R."""
    whole_ratio = BufferDescription(cl_types.float4)
    whole_shaded = BufferDescription(cl_types.float4)
    """[rows, cols] `ratio` and `shaded` under the whole light."""
    bounced = BufferDescription(cl_types.float4)
    """[rows, cols] the ratio with the change of what real surfaces send to each other, under the whole light."""
    bounced_rest = BufferDescription(cl_types.float4)
    """[rows, cols] that ratio under the light without its discs."""
    occluded = BufferDescription(cl_types.float4)
    """[rows, cols] radiance that occluders take from virtual surface."""
    point_radiances = BufferDescription(cl_types.float4)
    """[points] what points on objects send."""

    def __init__(self, workspace: Workspace) -> None:
        super().__init__(workspace)
        self.drawn: DirtyRegion = DirtyRegion()
        """Of `occluded`, in samples."""


@dataclass(frozen=True)
class RealShadow(SampleGrid):
    """Ratios R' / R (eq. 7.1) at samples of real surface."""

    shaded: cl_array.Array
    """[rows, cols] float4: R, shading of white surface without objects, w = 1 valid."""
    whole: RealShadow | None = None
    """Both under the light with its discs (shadow_map.py); None where the light has none."""


@dataclass(frozen=True)
class DirectSamples:
    """Radiance of white surface from the discs of the light (shadow_map.py), at the samples of a RealShadow:
    [rows, cols] float4 each."""

    without: cl_array.Array
    with_objects: cl_array.Array
    least: NDArray[np.float64]
    """[3] the least shading that counts, see include/direct_mix.clh."""


def shadow_real(
    engine: Engine,
    camera: CameraModel,
    surface: Surface,
    transfer: Transfer,
    scene: TracedScene,
    indirect: Indirect | None = None,
    samples: DirectSamples | None = None,
    step: int = 1,
    eye: NDArray[np.float64] | None = None,
) -> RealShadow:
    """Ratio R' / R of real surface shaded with and without the objects, at the transfer's samples (eq. 7.1).

    indirect: radiance from surfaces at the same samples; samples: what the discs of the light bring there. step: blocks
    of step x step samples are shaded as the first of them. eye: [3] where the camera is, volume metres: ratios that are
    kept at places of the world (shadow_cells.py) are used, and, unless in blocks, kept. None: all are found anew.
    """
    shape, buffers = (transfer.rows, transfer.cols), engine.buffers(_Buffers)
    ratio, shaded = buffers.ratio.array(shape), buffers.shaded.array(shape)
    whole: RealShadow | None = None
    if samples is not None:
        whole = RealShadow(transfer.stride, buffers.whole_ratio.array(shape), buffers.whole_shaded.array(shape))
    found, cells = RealShadow(transfer.stride, ratio, shaded, whole), None
    if eye is not None:
        cells = shadow_cells(engine, RealShadows, camera, eye, scene, found, fills=step == 1)
    engine.launch(
        engine.kernel("differential_rendering.cl", "shadow_real", **_sample_defines(engine, transfer, scene)),
        (engine.sharers * -(-transfer.cols // step), -(-transfer.rows // step)),
        scene.parameters(engine, sample_grid(camera, transfer)),
        *scene.real_arguments(engine),
        *sample_arguments(engine, surface, transfer),
        step,
        transfer.coefficients,
        indirect.hits if indirect else no_hits(engine, transfer),
        *_direct_arguments(engine, samples),
        *(cells.arguments() if cells else no_cells(engine)),
        cells is not None and step == 1,
        transfer.cells is not None,
        transfer.cells.ways if transfer.cells else engine.unused,
        *((cells.asked, cells.found, cells.changes) if cells else (engine.unused,) * 3),
        ratio,
        shaded,
        *((whole.values, whole.shaded) if whole else (engine.unused, engine.unused)),
        local=_local(engine),
        steps=-(-scene.rays.count // engine.sharers),
    )
    if cells and step == 1:
        cells.keep(engine, camera, found, found.all)
    return found


def bounce_real(
    engine: Engine,
    camera: CameraModel,
    camera_from_volume: NDArray[np.float64],
    surface: Surface,
    transfer: Transfer,
    scene: TracedScene,
    shadow: RealShadow,
    met: cl_array.Array,
    returned: float = math.inf,
    spare: float = 0.0,
    samples: DirectSamples | None = None,
) -> RealShadow:
    """`shadow` with the change of the light between real surfaces (eq. 7.6: R'_ID - R_ID).

    met: of Indirect. returned: bound on the change of the radiance that any real surface sends. Where it is at most
    `spare` times R under the light without its discs, a sample gains nothing. samples: those that `shadow` was made
    with.
    """
    shape, buffers = (transfer.rows, transfer.cols), engine.buffers(_Buffers)
    before, bounced = shadow.whole or shadow, buffers.bounced.array(shape)
    rest = buffers.bounced_rest.array(shape) if samples else engine.unused
    shadowed = replace(scene, changed=Changed(camera, camera_from_volume, surface.positions, before))
    engine.launch(
        engine.kernel("differential_rendering.cl", "bounce_real", **_sample_defines(engine, transfer, scene)),
        (transfer.cols, transfer.rows),
        shadowed.parameters(engine, sample_grid(camera, transfer)),
        *shadowed.surroundings_arguments(engine),
        *sample_arguments(engine, surface, transfer),
        met.shape[2],
        met,
        before.shaded,
        shadow.shaded,
        returned,
        spare,
        *_direct_arguments(engine, samples),
        bounced,
        rest,
        steps=scene.rays.count,
    )
    changed = replace(before, values=bounced)
    return replace(shadow, values=rest, whole=changed) if samples else changed


def _direct_arguments(engine: Engine, samples: DirectSamples | None) -> tuple[KernelArgument, ...]:
    """DISC_SAMPLES of differential_rendering.cl."""
    if samples is None:
        return 0, float4(0, 0, 0, 0), engine.unused, engine.unused
    return 1, float4(*samples.least, 0.0), samples.without, samples.with_objects


def _sample_defines(engine: Engine, transfer: Transfer, scene: TracedScene) -> dict[str, int]:
    return _defines(engine, scene) | {"MASK_WORDS": transfer.free_mask.shape[2], "INTERLEAVE": transfer.interleave}


def _defines(engine: Engine, scene: TracedScene) -> dict[str, int]:
    return scene.defines(engine) | {"SHARERS": engine.sharers}


def _local(engine: Engine) -> tuple[int, int]:
    """Of samples that `Engine.sharers` work-items do; see include/sharers.clh."""
    return (16, 4) if engine.sharers == 1 else (engine.sharers, SHARED_ITEMS // engine.sharers)


def shadow_virtual(
    engine: Engine,
    camera: CameraModel,
    virtual: VirtualSurface,
    scene: TracedScene,
    eye: NDArray[np.float64] | None = None,
) -> SampleGrid:
    """Radiance that real and virtual occluders take from the virtual surface, at every VIRTUAL_STRIDE-th pixel.

    eye: as in shadow_real.
    """
    shape = (camera.height // VIRTUAL_STRIDE, camera.width // VIRTUAL_STRIDE)
    buffers = engine.buffers(_Buffers)
    occluded = SampleGrid(VIRTUAL_STRIDE, buffers.occluded.array(shape))
    covered, cells = occluded.inside(box_around(virtual.boxes)), None
    if eye is not None:
        level = float(scene.light.mean.mean())
        cells = shadow_cells(engine, VirtualOcclusions, camera, eye, scene, occluded, level)
    with buffers.drawn.redraw(occluded.values, covered, occluded.all) as (x0, y0, x1, y1):
        engine.launch(
            engine.kernel("differential_rendering.cl", "shadow_virtual", **_defines(engine, scene)),
            (engine.sharers * (x1 - x0), y1 - y0),
            scene.parameters(engine, grid_of(occluded, camera), scene.rays.interleave),
            *scene.arguments(engine),
            int4(x0, y0, x1, y1),
            virtual.position,
            virtual.normal,
            virtual.object_index,
            *(cells.arguments() if cells else no_cells(engine)),
            *((cells.asked, cells.found, cells.changes) if cells else (engine.unused,) * 3),
            occluded.values,
            local=_local(engine),
            steps=-(-scene.rays.count // (scene.rays.interleave * engine.sharers)),
        )
        if cells:
            cells.keep(engine, camera, occluded, (x0, y0, x1, y1))
    return occluded


def light_points(engine: Engine, scene: TracedScene, placed: PlacedPoints | None = None) -> VirtualPointLights:
    """Light the points of the objects as their pixels are lit (eq. 7.3), but not by each other.

    placed: of place_points for the scene's objects; None: they are placed here.
    """
    placed = placed or place_points(engine, scene.objects)
    lit, traced = min(placed.count, MOST_POINTS), replace(scene, point_lights=placed.point_lights)
    buffer = engine.buffers(_Buffers).point_radiances
    is_rest_even = lit < placed.count
    radiances = buffer.upload(placed.under_even_light(scene.light.mean)) if is_rest_even else buffer.array((lit,))
    engine.launch(
        engine.kernel("differential_rendering.cl", "light_points", **_defines(engine, scene)),
        (engine.sharers * lit,),
        traced.parameters(engine, NO_GRID),
        *traced.arguments(engine),
        lit,
        placed.points,
        placed.normals,
        placed.albedos,
        placed.offsets_m,
        radiances,
        steps=-(-scene.rays.count // engine.sharers),
    )
    return replace(placed.point_lights, radiances=radiances)
