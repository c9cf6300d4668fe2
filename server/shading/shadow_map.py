"""Shadow maps along the sharp lights of a room (thesis 7.2.3, fig. 7.7). Kernels: shadow_map.cl.

direct_lights.py splits sharp lights, as discs, from the rest of the light. From each disc the virtual objects are drawn
into a depth map that just fits them, with a pyramid of coverage and mean depth. At every pixel, shading first searches
the map for occluders and their distance, then finds the visible part of the disc with a filter as wide as that distance
asks for (percentage-closer soft shadows). Real occluders are traced through the volume, from samples of the surface.
The light that they block is missing with and without virtual objects, so no shadow is drawn twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.direct_lights import DirectLight
from server.maths.disc_places import disc_places, ray_places, search_places
from server.maths.dominant import MOST_LIGHTS
from server.objects.dirty_region import DirtyRegion, box_around
from server.objects.pinhole import Pinhole
from server.objects.pixel_boxes import PixelBox
from server.objects.raster_lists import RasterBuffers
from server.objects.rasterize import NEAR_M, Placed, VirtualSurface, drawn_depths
from server.objects.virtual_object import VirtualObject
from server.opencl.buffers import BufferDescription, BufferGroup, StageBuffers, Workspace
from server.opencl.engine import Engine, KernelArgument, float4, int4
from server.opencl.program import Define
from server.opencl.structs import DIRECT_PARAMETERS
from server.shading.change_mask import mark_changes
from server.shading.differential_rendering import MOST_POINTS, VIRTUAL_STRIDE, DirectSamples, RealShadow
from server.shading.kept_discs import STEADY, KeptDiscs, are_near
from server.shading.traced_scene import DeviceLight, ball_around
from server.shading.virtual_point_lights import PlacedPoints, VirtualPointLights
from server.transfer.auxiliary_views import view_axes
from server.transfer.radiance_transfer import Cells
from server.transfer.sample_grid import SampleGrid, grid_of
from server.transfer.sampling import Upsampling
from server.volume.raycast import Surface
from server.volume.volume import Volume

MAP_SIDE = 256
"""Texels along a side of the objects' map."""
DISTANCE = 1024.0
"""Distance of the camera of a distant light's map, in radii of the ball around the objects: practically parallel."""
NEAREST = 1.25
"""Least distance of a near light, in radii of that ball: its map is as fine as 0.6 of a distant light's."""
LEAST_SHADING = 0.02
"""The least shading that counts, as in include/shadows.clh."""
_COARSEST_SIDE = 8
_MAP_ITEMS = 64

Floats = NDArray[np.float64]


class _Buffers(StageBuffers):
    rows = BufferDescription(cl_types.float4)
    """ShadowMaps.rows."""
    maps = BufferDescription(cl_types.float2)
    """ShadowMaps.objects."""
    disc_places = BufferDescription(cl_types.float2)
    """Places on a disc of radius 1 that shading looks at, first those that search for occluders."""
    ray_places = BufferDescription(cl_types.float2)
    """Places on a disc of radius 1 that rays are traced to."""
    virtual = BufferDescription(cl_types.float4)
    """[h, w] what the discs bring to virtual surface."""
    virtual_parts = BufferDescription(cl_types.float4)
    """[rows, cols] the part of each disc that real things leave to virtual surface."""
    real_parts = BufferDescription(cl_types.float4)
    """[rows, cols] the part of each disc that real things leave to real surface."""
    ratio = BufferDescription(cl_types.float4)
    """[h, w] R' / R under the whole light."""
    samples_without = BufferDescription(cl_types.float4)
    samples_with = BufferDescription(cl_types.float4)
    """[rows, cols] what the discs bring, without and with objects."""
    objects = BufferGroup(RasterBuffers)
    """Of the picture of all maps."""

    def __init__(self, workspace: Workspace) -> None:
        super().__init__(workspace)
        self.drawn: DirtyRegion = DirtyRegion()
        """Of `virtual`."""
        self.traced: DirtyRegion = DirtyRegion()
        """Of `virtual_parts`, in samples."""


@dataclass(frozen=True)
class ShadowMaps:
    """The shadow maps of one frame. Its arrays are the engine's buffers, valid until the next frame."""

    volume: Volume
    light: DeviceLight
    ray_length_m: float
    """Length of rays to real things."""
    rows: cl_array.Array
    """[MOST_LIGHTS, 4] float4: right (w: 1 / distance), down (w: half a side of the map), towards the light (w: tangent
    of half its angle), irradiance (w: _rows); as the light is at the ball's centre."""
    ball: Floats
    """Centre and radius of the ball around all objects, volume metres."""
    discs: tuple[DirectLight, ...]
    """Those of `light` as they are at the ball's centre."""
    objects: cl_array.Array
    """[MOST_LIGHTS, texels of the pyramid] float2: coverage, mean depth in metres from the ball's centre."""
    traced: list[tuple[Surface, SampleGrid]] = field(default_factory=list)
    """The last result of trace_real and its surface: several effects need it."""

    @property
    def least(self) -> Floats:
        """[3] the least shading that counts, see include/direct_mix.clh."""
        least: Floats = LEAST_SHADING * self.light.mean + 1e-9
        return least

    def arguments(self, engine: Engine) -> tuple[KernelArgument, ...]:
        """DIRECT_PARAMETERS of include/direct_lights.clh."""
        return (
            DIRECT_PARAMETERS(ball=float4(*self.ball), least=float4(*self.least, 0.0), count=len(self.light.discs)),
            self.rows,
            engine.buffers(_Buffers).disc_places.constant(_disc_places()),
            self.objects,
        )

    def trace_arguments(self, engine: Engine) -> tuple[KernelArgument, ...]:
        """TRACE_PARAMETERS of shadow_map.cl."""
        places = engine.buffers(_Buffers).ray_places.constant(_ray_places())
        return (*self.volume.arguments(), np.float32(self.ray_length_m), places)


def draw_shadow_maps(
    engine: Engine,
    volume: Volume,
    light: DeviceLight,
    objects: Sequence[Placed],
    ray_length_m: float,
    *,
    follows_discs: bool = True,
) -> ShadowMaps:
    """Depth maps of `objects`, each with its `volume_from_model`, from every disc of `light`. follows_discs: as in
    FrameContext."""
    ball = np.array(ball_around(objects).tolist(), np.float64)
    discs = [_seen_from(disc, ball) for disc in light.discs]
    last = engine.state(_LastMaps)
    shown = _Shown.of(objects)
    if not follows_discs and last.shown == shown and are_near(last.discs, discs, STEADY):
        discs = [replace(drawn, irradiance=disc.irradiance) for drawn, disc in zip(last.discs, discs, strict=True)]
    axes = view_axes(np.stack([disc.direction for disc in discs]))
    rows = _rows(discs, axes, float(ball[3]))
    uploaded = engine.buffers(_Buffers).rows.refresh(rows.view(cl_types.float4)[..., 0])
    drawn = engine.buffers(_Buffers).maps.array((MOST_LIGHTS, (4 * MAP_SIDE**2 - _COARSEST_SIDE**2) // 3))
    seen_from = rows[:, :3].tobytes()  # irradiance does not matter
    if (last.shown, last.seen_from) != (shown, seen_from):
        _draw_objects(engine, axes, rows, uploaded, ball, objects, drawn)
        last.shown, last.seen_from, last.discs = shown, seen_from, discs
        last.things = [thing for thing, _ in objects]
    return ShadowMaps(volume, light, ray_length_m, uploaded, ball, tuple(discs), drawn)


def most_irradiance(light: DeviceLight, objects: Sequence[Placed]) -> Floats:
    """[3] bound on the radiance of white surface of `objects` from the discs of `light`: of a near disc, on the side of
    the ball around them that is next to it."""
    ball, most = np.array(ball_around(objects).tolist(), np.float64), np.zeros(3)
    for disc in light.discs:
        seen = _seen_from(disc, ball)
        nearest = 1.0 if seen.center_m is None else 1 - ball[3] / seen.distance_m
        most = most + seen.irradiance / nearest**2
    return most


def _seen_from(disc: DirectLight, ball: Floats) -> DirectLight:
    """The disc as it is at the ball's centre; distant if it is nearly inside the ball, where no map can be drawn."""
    offset = None if disc.center_m is None else disc.center_m - ball[:3]
    if offset is None or not offset.any():
        return replace(disc, center_m=None)
    seen = disc.seen_from(ball[:3])
    is_clear = seen.distance_m > max(NEAREST * ball[3], ball[3] + 2 * NEAR_M)
    return seen if is_clear else replace(seen, center_m=None)


def light_virtual(engine: Engine, camera: CameraModel, virtual: VirtualSurface, maps: ShadowMaps) -> cl_array.Array:
    """[h, w] float4: radiance from the discs on virtual surface of albedo 1."""
    size, buffers = (camera.width, camera.height), engine.buffers(_Buffers)
    direct = buffers.virtual.array((camera.height, camera.width))
    shape = (camera.height // VIRTUAL_STRIDE, camera.width // VIRTUAL_STRIDE)
    parts = SampleGrid(VIRTUAL_STRIDE, buffers.virtual_parts.array(shape))
    covered = parts.inside(box_around(virtual.boxes))
    with buffers.traced.redraw(parts.values, covered, parts.all) as around:
        _trace_discs(engine, camera, virtual.position, virtual.normal, parts, around, maps, is_virtual=True)
    with buffers.drawn.redraw(direct, box_around(virtual.boxes), (0, 0, *size)) as (x0, y0, x1, y1):
        engine.launch(
            _kernel(engine, "light_virtual"),
            (-(-(x1 - x0) // engine.lanes), y1 - y0),
            grid_of(parts, camera),
            int4(x0, y0, x1, y1),
            virtual.position,
            virtual.normal,
            parts.values,
            maps.volume.voxel_m,
            *maps.arguments(engine),
            direct,
        )
    return direct


def trace_real(
    engine: Engine,
    camera: CameraModel,
    surface: Surface,
    ratio: SampleGrid,
    maps: ShadowMaps,
    cells: Cells | None = None,
    *,
    keeps: bool = False,
) -> SampleGrid:
    """The part of each disc that real surfaces do not block, at the samples of `ratio`: float4, w = 1 valid.

    cells: of these samples; parts that were kept there are used until the discs have moved (kept_discs.py). keeps: keep
    those that are new; else light_samples is called next and does.
    """
    for traced, parts in maps.traced:
        if traced is surface and (parts.stride, parts.values.shape) == (ratio.stride, ratio.values.shape):
            return parts
    parts = SampleGrid(ratio.stride, engine.buffers(_Buffers).real_parts.array(ratio.values.shape))
    _trace_discs(
        engine, camera, surface.positions, surface.normals, parts, parts.all, maps, is_virtual=False, cells=cells
    )
    if cells is not None and keeps:
        count = parts.rows * parts.cols
        kept = _kept(engine, cells)
        engine.launch(_kernel(engine, "keep_parts"), (count,), count, cells.now, parts.values, *kept)
    maps.traced[:] = [(surface, parts)]  # the next call writes the same array
    return parts


def light_real(
    engine: Engine,
    camera: CameraModel,
    surface: Surface,
    ratio: RealShadow,
    parts: SampleGrid,
    maps: ShadowMaps,
    refined: cl_array.Array | None = None,
    upsampling: Upsampling = "bilateral",
    reached: cl_array.Array | None = None,
) -> cl_array.Array:
    """[h, w] float4: R' / R of real surface under the whole light, w = 1 where it may be other than 1.

    ratio: under the rest of the light; parts: of trace_real; refined: replaces `ratio` where its w = 1; reached: of
    change_mask.py, the cells in which `ratio` counts, None: wherever it is not 1.
    """
    mixed = engine.buffers(_Buffers).ratio.array((camera.height, camera.width))
    engine.launch(
        _kernel(engine, "light_real", BICUBIC=upsampling == "bicubic"),
        (-(-camera.width // engine.lanes), camera.height),
        grid_of(parts, camera),
        camera.height,
        surface.positions,
        surface.normals,
        parts.values,
        maps.volume.voxel_m,
        ratio.values,
        refined is not None,
        ratio.values if refined is None else refined,
        ratio.shaded,
        mark_changes(engine, camera, surface, ratio) if reached is None else reached,
        *maps.arguments(engine),
        mixed,
    )
    return mixed


def light_points_by_discs(
    engine: Engine, placed: PlacedPoints, point_lights: VirtualPointLights, maps: ShadowMaps
) -> None:
    """Add the discs' light to what points on objects send. Points past MOST_POINTS see an even light and need none."""
    count = min(placed.count, MOST_POINTS)
    engine.launch(
        _kernel(engine, "light_points_by_discs"),
        (-(-count // engine.lanes),),
        count,
        placed.points,
        placed.normals,
        placed.albedos,
        *maps.arguments(engine),
        *maps.trace_arguments(engine),
        point_lights.radiances,
        local=(max(64 // engine.lanes, 1),),
    )


def light_samples(
    engine: Engine,
    camera: CameraModel,
    surface: Surface,
    parts: SampleGrid,
    maps: ShadowMaps,
    cells: Cells | None = None,
) -> DirectSamples:
    """Radiance from the discs at all samples of `parts`, of trace_real. cells: of that too; keeps the parts there."""
    shape, buffers = (parts.rows, parts.cols), engine.buffers(_Buffers)
    without, lit = buffers.samples_without.array(shape), buffers.samples_with.array(shape)
    engine.launch(
        _kernel(engine, "light_samples"),
        (-(-parts.cols // engine.lanes), parts.rows),
        grid_of(parts, camera),
        surface.positions,
        surface.normals,
        parts.values,
        *maps.arguments(engine),
        without,
        lit,
        cells is not None,
        cells.now if cells else 0,
        *_kept(engine, cells),
    )
    return DirectSamples(without, lit, maps.least)


def _draw_objects(
    engine: Engine,
    axes: Floats,
    rows: NDArray[np.float32],
    uploaded: cl_array.Array,
    ball: Floats,
    objects: Sequence[Placed],
    maps: cl_array.Array,
) -> None:
    """The pyramids of all maps. axes: [lights, 3, 3]; rows: of _rows, also on the device."""
    far_m = DISTANCE * float(ball[3])
    middle, focal_px = (MAP_SIDE - 1) / 2, DISTANCE * MAP_SIDE / 2
    camera = Pinhole(MAP_SIDE, MOST_LIGHTS * MAP_SIDE, focal_px, focal_px, middle, middle)
    drawn: list[Placed] = []
    for light, rotation in enumerate(axes):  # one picture, the maps below each other: one draw call
        inverse_m, half_m = float(rows[light, 0, 3]), float(rows[light, 1, 3])
        distance_m = 1 / inverse_m if inverse_m > 0 else far_m
        camera_from_volume = np.eye(4)
        camera_from_volume[:3, :3] = rotation
        camera_from_volume[:3, 3] = -rotation @ ball[:3] + [0.0, 0.0, distance_m]
        camera_from_volume[:2] *= distance_m / (half_m * DISTANCE)  # one focal length for all: 1 for a distant light
        camera_from_volume[1] += light * MAP_SIDE / focal_px * camera_from_volume[2]
        drawn += [(thing, camera_from_volume @ volume_from_model) for thing, volume_from_model in objects]
    nearest = drawn_depths(engine, camera, np.eye(4), drawn, engine.buffers(_Buffers).objects)
    items = (_MAP_ITEMS * _COARSEST_SIDE**2 * len(axes),)
    engine.launch(_kernel(engine, "build_maps"), items, far_m, uploaded, nearest, maps, local=(_MAP_ITEMS,))


@dataclass(frozen=True)
class _Shown:
    """What shadow maps show."""

    things: tuple[int, ...]
    """Identities of the objects."""
    places: bytes

    @staticmethod
    def of(objects: Sequence[Placed]) -> _Shown:
        return _Shown(tuple(id(thing) for thing, _ in objects), np.array([matrix for _, matrix in objects]).tobytes())


class _LastMaps:
    """What the engine's maps show: they are drawn anew where a disc or an object is another, or has moved."""

    shown: _Shown | None = None
    seen_from: bytes = b""
    """The discs, of _rows."""
    discs: Sequence[DirectLight] = ()
    """As they are at the centre of the ball around the objects."""
    things: Sequence[VirtualObject] = ()
    """Kept alive, so that no other object gets the identity of one of them."""


def _trace_discs(
    engine: Engine,
    camera: CameraModel,
    positions: cl_array.Array,
    normals: cl_array.Array,
    parts: SampleGrid,
    around: PixelBox,
    maps: ShadowMaps,
    is_virtual: bool,
    cells: Cells | None = None,
) -> None:
    since = engine.state(KeptDiscs).since(maps.discs, cells.now) if cells else 0
    engine.launch(
        _kernel(engine, "trace_discs"),
        (around[2] - around[0], around[3] - around[1]),
        grid_of(parts, camera),
        int4(*around),
        positions,
        normals,
        is_virtual,
        *maps.arguments(engine),
        *maps.trace_arguments(engine),
        parts.values,
        cells is not None,
        since,
        *_kept(engine, cells),
    )


def _kept(engine: Engine, cells: Cells | None) -> tuple[cl_array.Array, ...]:
    """Where parts are kept, for trace_discs, keep_parts and light_samples."""
    return (cells.places, cells.claims, cells.disc_parts, cells.disc_frames) if cells else (engine.unused,) * 4


def _rows(discs: Sequence[DirectLight], axes: Floats, radius_m: float) -> NDArray[np.float32]:
    """[MOST_LIGHTS, 4, 4] as ShadowMaps.rows says; the irradiance with what surface that faces the disc gets of it: the
    mean cosine of its parts. radius_m: of the ball."""
    rows = np.zeros((MOST_LIGHTS, 4, 4), np.float32)  # always as many: lights come and go, arrays do not
    count = len(discs)
    rows[:count, :3, :3] = axes * np.array([1.0, 1.0, -1.0])[:, None]
    inverse_m = np.array([0.0 if disc.center_m is None else 1 / disc.distance_m for disc in discs])
    rows[:count, 0, 3] = inverse_m
    rows[:count, 1, 3] = radius_m / np.sqrt(1 - (inverse_m * radius_m) ** 2)  # of the ball, mapped
    tangent = np.tan([disc.half_angle_rad for disc in discs])
    rows[:count, 2, 3] = tangent
    rows[:count, 3, :3] = [disc.irradiance for disc in discs]
    distance = np.linalg.norm(disc_places(), axis=1)
    rows[:count, 3, 3] = (1 / np.sqrt(1 + np.outer(tangent, distance) ** 2)).mean(axis=1)
    return rows


@cache
def _disc_places() -> NDArray[np.float32]:
    """_Buffers.disc_places."""
    return _float2(np.concatenate([search_places(), disc_places()]))


@cache
def _ray_places() -> NDArray[np.float32]:
    """_Buffers.ray_places."""
    return _float2(ray_places())


def _float2(places: Floats) -> NDArray[np.float32]:
    return np.ascontiguousarray(places, np.float32).view(cl_types.float2)[:, 0]


def _kernel(engine: Engine, name: str, **defines: Define) -> cl.Kernel:
    return engine.kernel("shadow_map.cl", name, MAP_SIDE=MAP_SIDE, LANES=engine.lanes, **defines)
