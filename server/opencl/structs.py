"""Device structs: what kernels take by value beside their buffers. Each is declared once, as a NumPy dtype.

The C text is made from the same declaration and stands in front of every program (program.py). OpenCL 1.2 allows no
pointers in the structs of kernel arguments, so buffers stay arguments of their own. Vectors of three are left out: C
gives a float3 the size of a float4.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pyopencl.cltypes as cl_types

_TYPES: dict[str, np.dtype[Any]] = {
    "int": np.dtype(np.int32),
    "float": np.dtype(np.float32),
    "int4": cl_types.int4,
    "float4": cl_types.float4,
    "float16": cl_types.float16,
}


class Struct:
    """A C struct of 32-bit scalars, vectors and other structs; called with all fields by name, it gives a value."""

    def __init__(self, name: str, **fields: str | Struct) -> None:
        """Each field is the name of an OpenCL C type, or a struct. Raises KeyError for a type that is not shared."""
        self.name: str = name
        dtypes = [field.dtype if isinstance(field, Struct) else _TYPES[field] for field in fields.values()]
        alignments = [
            field.alignment if isinstance(field, Struct) else _TYPES[field].itemsize for field in fields.values()
        ]
        self.alignment: int = max(alignments)
        """Bytes. C aligns scalars and vectors to their size, and a struct as its most aligned field."""
        offsets, end, packing = [], 0, "<"
        for field, dtype, alignment in zip(fields.values(), dtypes, alignments, strict=True):
            start = _rounded(end, alignment)
            offsets.append(start)
            packing += f"{start - end}x" + {"int": "i", "float": "f"}.get(str(field), f"{dtype.itemsize}s")
            end = start + dtype.itemsize
        size = _rounded(end, self.alignment)
        self._packing = struct.Struct(f"{packing}{size - end}x")
        self._blocks: dict[str, int] = {
            name: dtype.itemsize for name, dtype in zip(fields, dtypes, strict=True) if dtype.names
        }
        """Bytes of the fields that are vectors or structs."""
        layout: Any = {"names": [*fields], "formats": dtypes, "offsets": offsets, "itemsize": size}
        self.dtype: np.dtype[Any] = np.dtype(layout)
        self._names: frozenset[str] = frozenset(fields)
        types = {field: of.name if isinstance(of, Struct) else of for field, of in fields.items()}
        members = "".join(f"    {of} {field};\n" for field, of in types.items())
        self.c_text = f"typedef struct {{\n{members}}} {name};\n"

    def __call__(self, **values: Any) -> np.void:
        """A kernel argument. Raises TypeError where a field is missing or unknown, or is a vector or struct of another
        size."""
        if values.keys() != self._names:
            wrong = ", ".join(sorted(values.keys() ^ self._names))
            names = ", ".join(self.dtype.names or ())
            raise TypeError(f"{self.name} has the fields {names}; missing or unknown: {wrong}")
        for name, size in self._blocks.items():
            values[name] = block = values[name].tobytes()
            if len(block) != size:
                raise TypeError(f"{name} of {self.name} has {size} bytes, not {len(block)}")
        # Ten times as fast as a NumPy array whose fields are set one by one: a frame makes seventy structs.
        packed = self._packing.pack(*(values[name] for name in self.dtype.names or ()))
        result: np.void = np.frombuffer(packed, self.dtype)[0]
        return result


def _rounded(count: int, step: int) -> int:
    return -(-count // step) * step


GRID = Struct("Grid", cols="int", rows="int", stride="int", width="int")
"""Samples of a picture `width` wide: sample (row, col) lies at pixel stride / 2 + stride * (row, col)."""

VOLUME_SHAPE = Struct("VolumeShape", bricks="int4", voxel_m="float", truncation_m="float", gaps_at="int")
"""Volume of include/volume.clh. gaps_at: byte of the ray tables at which the gaps begin, behind the solid cells."""

LIGHT_TABLE = Struct(
    "LightTable",
    places="int",
    directions="int",
    coefficients_at="int",
    whole_at="int",
    arriving_at="int",
    positions_at="int",
    owners_at="int",
)
"""Arrays of include/light_table.clh, their sizes and the byte of the light's table at which each begins. directions: of
all sets."""

LIGHT_PARAMETERS = Struct("LightParameters", unseen="float4", table=LIGHT_TABLE, count="int", ray_length_m="float")
"""Arriving of include/arriving.clh. count: directions of one set."""

RAY_GROUP = Struct(
    "RayGroup", first_item="int", count="int", per_set="int", sets="int", first_row="int", first_arrival="int"
)
"""Rays of arrivals.cl from `count` points, each along one of `sets` sets of `per_set` directions: where their items,
rows of the table and arrivals begin."""

CHANGED_PARAMETERS = Struct("ChangedParameters", camera_from_volume="float16", intrinsics="float4", grid="int4")
"""Changed of include/changed.clh."""

OBJECT_PARAMETERS = Struct(
    "ObjectParameters", ball="float4", count="int", dims_at="int", normals_at="int", cells_at="int", nearest_at="int"
)
"""Objects of include/scene.clh. ball: around all objects, centre and radius. dims_at: byte of the objects'
table; the others: bytes of the points' table."""

SCENE_PARAMETERS = Struct(
    "SceneParameters",
    volume=VOLUME_SHAPE,
    light=LIGHT_PARAMETERS,
    changed=CHANGED_PARAMETERS,
    objects=OBJECT_PARAMETERS,
    samples=GRID,
    every="int",
)
"""Scene of include/scene.clh. samples: where the kernel shades; every: it traces every n-th direction."""

REFLECTION_PARAMETERS = Struct("ReflectionParameters", scene=SCENE_PARAMETERS, eye="float4", least_gloss="float")
"""Parameters of reflect.cl. eye: where the camera is, volume metres."""

VIEW_PARAMETERS = Struct(
    "ViewParameters",
    picture_from_volume="float16",
    picture_intrinsics="float4",
    center="float4",
    side="int",
    distance_m="float",
    per_pixel="float",
    picture_width="int",
    picture_height="int",
    near_m="float",
    near_ratio="float",
    most_apart="float",
)
"""RealViews and Picture of include/views.clh."""

DIRECT_PARAMETERS = Struct("DirectParameters", ball="float4", least="float4", count="int")
"""DirectLights of include/direct_lights.clh. least: the least shading that counts, see include/direct_mix.clh."""

TRANSFER_PARAMETERS = Struct(
    "TransferParameters",
    grid=GRID,
    volume=VOLUME_SHAPE,
    intrinsics="float4",
    height="int",
    radius="int",
    count="int",
    first_set="int",
    ray_length_m="float",
    phase="int",
    layers="int",
    newest="int",
    cached_normals_at="int",
    chosen_count="int",
)
"""Parameters of radiance_transfer.cl. cached_normals_at: byte of the cache's surface at which its normals begin."""

TRANSFER_CACHE_PARAMETERS = Struct(
    "TransferCacheParameters",
    grid=GRID,
    eye="float4",
    spacing="float",
    now="int",
    renews="int",
    period="int",
    checks="int",
    parts="int",
    count="int",
    met="int",
    ray_length_m="float",
    places="int",
    most="int",
)
"""Parameters of transfer_cache.cl. eye: where the camera is, volume metres; spacing: metres between samples that are a
metre away; now: this frame's number; renews: every entry is traced again; period: frames after which one is in any
case; checks: those after which it is checked again, 0: never; parts: of the `count` directions of a sample, of which a
check traces one; met: of its directions whose surface is known, how many a check traces at most; places: of the table;
most: samples that a frame traces."""

SHADOW_CELLS = Struct(
    "ShadowCells",
    eye="float4",
    spacing="float",
    level="float",
    close="float",
    places="int",
    now="int",
    since="int",
    turns="int",
)
"""A table of kept_shadows.clh. eye, spacing: as in TransferCacheParameters; level: of the light's radiance, which
values are relative to; close: values that differ by no more are the same; places: 0 where nothing is kept; now: this
frame's number; since: what was found in this frame or later is true; turns: frames after which a value is found anew at
the latest."""

LOOK_UP_PARAMETERS = Struct(
    "LookUpParameters",
    grid=GRID,
    center="float4",
    distance_m="float",
    per_pixel="float",
    block_cols="int",
    block_rows="int",
    count="int",
    first_set="int",
    ray_length_m="float",
    lift_m="float",
)
"""Parameters of look_into_views in auxiliary_views.cl. center, distance_m, per_pixel: of the views, see draw_views."""

GATHER_PARAMETERS = Struct(
    "GatherParameters",
    grid=GRID,
    volume=VOLUME_SHAPE,
    count="int",
    every="int",
    most="int",
    ray_length_m="float",
    least_cosine="float",
)
"""Parameters of indirect.cl. count: directions of one set; every: a sample traces every n-th blocked direction, `most`
in all."""

VIEW_TRANSFER_PARAMETERS = Struct(
    "ViewTransferParameters",
    grid=GRID,
    camera_from_volume="float16",
    intrinsics="float4",
    height="int",
    voxel_m="float",
    count="int",
    first_set="int",
    ratio="float",
    steps="int",
    further="int",
    near_m="float",
    ray_length_m="float",
    slack="float",
    inverse_threshold="float",
)
"""Parameters of transfer_from_views in image_space.cl."""

MIXTURE_PARAMETERS = Struct(
    "MixtureParameters",
    camera_from_volume="float16",
    around="int4",
    height="int",
    tolerance_m="float",
    virtual_gain="float",
    log_white="float4",
    light=LIGHT_TABLE,
    virtual_samples=GRID,
    real_samples=GRID,
    has_refined_occluded="int",
    has_refined_ratio="int",
)
"""Mixture of include/composite_inputs.clh."""

LAYER_PARAMETERS = Struct(
    "LayerParameters",
    mixture=MIXTURE_PARAMETERS,
    depth_scale_m="float",
    virtual_depth_at="int",
    ratio_at="int",
    real_depth_at="int",
)
"""Parameters of layer.cl. ..._at: byte of the layer's buffer at which an array begins."""

SURFACE_PARAMETERS = Struct(
    "SurfaceParameters", around="int4", region="int4", width="int", parts="int", object_count="int"
)
"""Parameters of shade_surface in rasterize.cl."""

STRUCTS = (
    GRID,
    VOLUME_SHAPE,
    LIGHT_TABLE,
    LIGHT_PARAMETERS,
    RAY_GROUP,
    CHANGED_PARAMETERS,
    OBJECT_PARAMETERS,
    SCENE_PARAMETERS,
    REFLECTION_PARAMETERS,
    VIEW_PARAMETERS,
    DIRECT_PARAMETERS,
    TRANSFER_PARAMETERS,
    TRANSFER_CACHE_PARAMETERS,
    SHADOW_CELLS,
    LOOK_UP_PARAMETERS,
    GATHER_PARAMETERS,
    VIEW_TRANSFER_PARAMETERS,
    MIXTURE_PARAMETERS,
    LAYER_PARAMETERS,
    SURFACE_PARAMETERS,
)
"""All structs; a struct stands behind those that it contains."""


def struct_text() -> str:
    """C declarations of all structs, for the front of a program's source."""
    return '#line 1 "structs.py"\n' + "".join(struct.c_text for struct in STRUCTS)
