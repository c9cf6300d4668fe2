"""Saved state of a room without voxels and meshes: typed structs and their encoding."""

from __future__ import annotations

from typing import Annotated, Any, get_args, get_origin

import msgspec
import numpy as np
import zstandard
from msgspec import Meta, Struct, field
from numpy.typing import NDArray

from protocol.messages import Wishes
from server.light.room_light import KnownRoomLight
from server.maths.near_light import Found
from server.scene.placement import Placement
from server.tracking.relocalize import Keyframe

VERSION = 5
"""Format version. Increase it when any of these types, or a type that they contain, changes."""
READABLE = (1, 2, 3, 4, VERSION)
"""Versions that can be read: what came since has a default, and what went is skipped."""
_MOST_BYTES = 1 << 30

FileName = Annotated[str, Meta(pattern="^[a-z0-9-]+$")]


class StoredVolume(Struct, frozen=True, forbid_unknown_fields=True):
    """A volume without its voxels."""

    bounds_m: tuple[float, float, float, float, float, float]
    voxel_m: float
    frames: int
    exposure_logarithms: float
    places: NDArray[np.int32]
    """[n] indices of its bricks."""
    files: tuple[FileName, ...] = ()
    """Brick files in order; later ones override earlier ones."""
    bricks_in_files: int = 0
    """Total number of bricks in all files."""


class StoredMarker(Struct, frozen=True, forbid_unknown_fields=True):
    """A marker that a client has detected."""

    dictionary: str
    number: int
    room_from_marker: NDArray[np.float64]


class StoredObject(Struct, frozen=True, forbid_unknown_fields=True):
    """An object without its mesh. Exactly one of the two placements is set."""

    object_id: str
    mesh: FileName
    world_from_model: NDArray[np.float64] | None = None
    placement: Placement | None = field(default=None, name="asked")


class RoomState(Struct, frozen=True, forbid_unknown_fields=True):
    """State of one room."""

    wishes: Wishes
    """Wishes of the client that opened it."""
    up: NDArray[np.float64] | None
    volume: StoredVolume | None
    keyframes: tuple[Keyframe, ...]
    markers: tuple[StoredMarker, ...]
    light: KnownRoomLight
    lamps: Found | None
    objects: tuple[StoredObject, ...] = ()
    key_digest: bytes | None = None
    """See Room."""


class Header(Struct, frozen=True):
    """Begin of a save, the same in every format version."""

    version: int
    name: str
    sequence: int
    """Increases with each save of a room."""
    key_digest: bytes | None = None
    """Same as in the state; read first to check the key. Earlier programs did not write it."""
    revision: int = 0
    """Revision of the objects (see Inventory), which decides whether a placement delta applies."""
    owed: tuple[str, ...] = ()


def state_to_bytes(state: RoomState) -> bytes:
    """Encode with MessagePack and Zstandard."""
    return zstandard.ZstdCompressor(level=1).compress(msgspec.msgpack.encode(state, enc_hook=array_to_list))


def state_from_bytes(data: bytes) -> RoomState:
    """Decode; raises ValueError for invalid data."""
    try:
        if zstandard.frame_content_size(data) > _MOST_BYTES:
            raise ValueError("it is larger than any room")
        packed = zstandard.ZstdDecompressor().decompress(data)
        return msgspec.msgpack.decode(packed, type=RoomState, dec_hook=array_from_list)
    except (zstandard.ZstdError, msgspec.MsgspecError) as error:
        raise ValueError(str(error)) from error


def array_to_list(value: Any) -> Any:
    """`enc_hook` for msgspec."""
    if isinstance(value, np.ndarray):
        return [value.dtype.str, value.shape, np.ascontiguousarray(value).tobytes()]
    if isinstance(value, np.generic):
        return value.item()
    raise NotImplementedError(f"a {type(value).__name__} is not kept")


def array_from_list(expected: Any, value: Any) -> Any:
    """`dec_hook` for msgspec; returns a copy. Raises ValueError if the dtype is not the one of `expected`."""
    if get_origin(expected) is not np.ndarray:
        raise NotImplementedError(f"a {expected} is not kept")
    kind = np.dtype(get_args(get_args(expected)[1])[0])
    name, shape, data = value
    if name != kind.str:
        raise ValueError(f"numbers of type {name} where {kind.str} belong")
    return np.frombuffer(data, kind).reshape(shape).copy()
