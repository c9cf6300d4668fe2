"""What is kept of a room beside its voxels and meshes, as typed structs, and those as bytes."""

from __future__ import annotations

from typing import Annotated, Any, get_args, get_origin

import msgspec
import numpy as np
import zstandard
from msgspec import Meta, Struct
from numpy.typing import NDArray

from protocol.messages import Wishes
from server.light.room_light import KnownRoomLight
from server.maths.near_light import Found
from server.scene.placement import Placement
from server.tracking.relocalize import Keyframe

VERSION = 1
"""Of all that is written. A change of any of these types, or of those that they are made of, is another version."""
_MOST_BYTES = 1 << 30

FileName = Annotated[str, Meta(pattern="^[a-z0-9-]+$")]


class StoredVolume(Struct, frozen=True, forbid_unknown_fields=True):
    """A volume less its voxels."""

    bounds_m: tuple[float, float, float, float, float, float]
    voxel_m: float
    frames: int
    exposure_logarithms: float
    places: NDArray[np.int32]
    """[n] its bricks."""
    files: tuple[FileName, ...] = ()
    """Of its voxels; a later one holds what has changed."""
    bricks_in_files: int = 0
    """In all of them together."""


class StoredMarker(Struct, frozen=True, forbid_unknown_fields=True):
    """A marker that clients have seen."""

    dictionary: str
    number: int
    room_from_marker: NDArray[np.float64]


class StoredObject(Struct, frozen=True, forbid_unknown_fields=True):
    """An object less its mesh; one of the two is there."""

    object_id: str
    mesh: FileName
    world_from_model: NDArray[np.float64] | None = None
    asked: Placement | None = None


class RoomState(Struct, frozen=True, forbid_unknown_fields=True):
    """One room."""

    wishes: Wishes
    """Of the client that opened it."""
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
    """What every version begins a save with."""

    version: int
    name: str
    sequence: int
    """Grows from save to save of a room."""
    key_digest: bytes | None = None
    """The state's, to be compared before all else is read; earlier programs left it out."""
    revision: int = 0
    """Of the objects (see Inventory), by which moves are told that came after."""
    owed: tuple[str, ...] = ()


def state_to_bytes(state: RoomState) -> bytes:
    """Packed."""
    return zstandard.ZstdCompressor(level=1).compress(msgspec.msgpack.encode(state, enc_hook=array_to_list))


def state_from_bytes(data: bytes) -> RoomState:
    """Raises ValueError, one line, for what is none."""
    try:
        if zstandard.frame_content_size(data) > _MOST_BYTES:
            raise ValueError("it is larger than any room")
        packed = zstandard.ZstdDecompressor().decompress(data)
        return msgspec.msgpack.decode(packed, type=RoomState, dec_hook=array_from_list)
    except (zstandard.ZstdError, msgspec.MsgspecError) as error:
        raise ValueError(str(error)) from error


def array_to_list(value: Any) -> Any:
    """For msgspec's `enc_hook`."""
    if isinstance(value, np.ndarray):
        return [value.dtype.str, value.shape, np.ascontiguousarray(value).tobytes()]
    if isinstance(value, np.generic):
        return value.item()
    raise NotImplementedError(f"a {type(value).__name__} is not kept")


def array_from_list(asked: Any, value: Any) -> Any:
    """For msgspec's `dec_hook`: an own copy. Raises ValueError for another type than `asked`, an NDArray's."""
    if get_origin(asked) is not np.ndarray:
        raise NotImplementedError(f"a {asked} is not kept")
    kind = np.dtype(get_args(get_args(asked)[1])[0])
    name, shape, data = value
    if name != kind.str:
        raise ValueError(f"numbers of type {name} where {kind.str} belong")
    return np.frombuffer(data, kind).reshape(shape).copy()
