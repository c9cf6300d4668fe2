"""Stores all meshes of a scene in shared arrays, so that one launch draws them all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from server.objects.virtual_object import VirtualObject
from server.opencl.buffers import BufferDescription, DeviceBuffer, StageBuffers
from server.opencl.engine import Engine
from server.scene.mipmaps import CHANNEL_VALUES


@dataclass(frozen=True)
class Arena:
    """Device arrays of several meshes. Valid while they live and until the next gather() of another set of them."""

    things: tuple[VirtualObject, ...]
    """The meshes, each once."""
    firsts: NDArray[np.int32]
    """[n, 3] where each mesh's vertices, triangles and materials begin."""
    vertices: cl_array.Array
    """[v, 3] float32"""
    triangles: cl_array.Array
    """[t, 3] int32, counted from the mesh's first vertex."""
    attributes: cl_array.Array
    """[v, 12] float32, see VirtualObject."""
    material_of: cl_array.Array
    """[t] int32, counted from the mesh's first material."""
    materials: cl_array.Array
    """[m] float4, see MaterialTables; this and the next three count in the arena."""
    textures: cl_array.Array
    """[n] int4"""
    levels: cl_array.Array
    """[l] int4"""
    texels: cl_array.Array
    """[n, 4] uint8"""
    channel_values: cl_array.Array
    """[512] float32: linear value of a texel's byte."""


class _Buffers(StageBuffers):
    """Device buffers of the joined arrays, with the names of `Arena`."""

    vertices = BufferDescription(np.float32)
    triangles = BufferDescription(np.int32)
    attributes = BufferDescription(np.float32)
    material_of = BufferDescription(np.int32)
    materials = BufferDescription(cl_types.float4)
    textures = BufferDescription(cl_types.int4)
    levels = BufferDescription(cl_types.int4)
    texels = BufferDescription(np.uint8)
    channel_values = BufferDescription(np.float32)


class _LastArena:
    """The arena of the last frame."""

    arena: Arena | None = None


def gather(engine: Engine, things: Sequence[VirtualObject]) -> Arena:
    """The arena of `things`, with each mesh once; copied only when the set of meshes changes.

    The arrays of a single mesh are used as they are.
    """
    unique = tuple({id(thing): thing for thing in things}.values())
    kept = engine.state(_LastArena)
    last = kept.arena
    if last is None or not _is_valid(engine, last) or [*map(id, last.things)] != [*map(id, unique)]:
        last = kept.arena = _gathered(engine, unique)
    return last


def _is_valid(engine: Engine, arena: Arena) -> bool:
    """Whether the arena's buffers have not been released since."""
    return engine.buffers(_Buffers).channel_values.constant(CHANNEL_VALUES) is arena.channel_values


def _gathered(engine: Engine, things: tuple[VirtualObject, ...]) -> Arena:
    sizes = np.array([(len(t.vertices), len(t.triangles), len(t.tables.materials)) for t in things], np.int64).reshape(
        -1, 3
    )
    firsts = np.cumsum(np.vstack([np.zeros((1, 3), np.int64), sizes]), axis=0)[:-1].astype(np.int32)
    materials, textures, levels = _joined_tables(things)
    buffers = engine.buffers(_Buffers)
    return Arena(
        things,
        firsts,
        _joined(engine, buffers.vertices, [t.vertices for t in things], (3,)),
        _joined(engine, buffers.triangles, [t.triangles for t in things], (3,)),
        _joined(engine, buffers.attributes, [t.attributes for t in things], (12,)),
        _joined(engine, buffers.material_of, [t.material_of for t in things], ()),
        buffers.materials.upload(materials.view(cl_types.float4)[:, 0]),
        buffers.textures.upload(textures.view(cl_types.int4)[:, 0]),
        buffers.levels.upload(levels.view(cl_types.int4)[:, 0]),
        _joined(engine, buffers.texels, [t.texels for t in things], (4,)),
        buffers.channel_values.constant(CHANNEL_VALUES),
    )


def _joined(engine: Engine, buffer: DeviceBuffer, parts: list[cl_array.Array], tail: tuple[int, ...]) -> cl_array.Array:
    """`parts` one after the other along their first axis."""
    if len(parts) == 1:
        return parts[0]
    whole = buffer.array((max(sum(map(len, parts)), 1), *tail))
    start = 0
    for part in parts:
        engine.copy_into(whole, start, part)
        start += part.nbytes
    return whole


def _joined_tables(
    things: tuple[VirtualObject, ...],
) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.int32]]:
    """Materials, textures and levels [>= 1, 4] of all meshes, their numbers those of the arena."""
    materials, textures, levels = (
        [np.zeros((0, 4), np.float32)],
        [np.zeros((0, 4), np.int32)],
        [np.zeros((0, 4), np.int32)],
    )
    first_texture = first_level = first_texel = 0
    for thing in things:
        tables = thing.tables
        rows = tables.materials.copy()
        rows[:, 2:] += np.where(rows[:, 2:] >= 0, first_texture, 0)
        materials.append(rows)
        textures.append(tables.textures + np.array([first_level, 0, 0, 0], np.int32))
        levels.append(tables.levels + np.array([first_texel, 0, 0, 0], np.int32))
        first_texture += len(tables.textures)
        first_level += len(tables.levels)
        first_texel += len(thing.texels)
    return _filled(materials), _filled(textures), _filled(levels)


def _filled(parts: list[NDArray[Any]]) -> NDArray[Any]:
    """All rows; one row of zeros without any, because a buffer cannot be empty."""
    rows = np.concatenate(parts)
    return rows if len(rows) else np.zeros((1, 4), rows.dtype)
