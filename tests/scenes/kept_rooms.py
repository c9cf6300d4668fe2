"""Rooms to be saved, and what two of them must have alike."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import trimesh

from protocol.messages import Hello, Wishes
from server.client_session import ClientSession
from server.opencl.device import Device
from server.room.room import Room
from server.scene.placement import Placement
from server.service.saving.room_snapshots import snapshot_within
from server.service.saving.room_state import state_to_bytes
from server.service.saving.room_store import RoomStore
from server.service.saving.save_slot import SaveSlot
from server.volume.volume import Volume
from tests.scenes.meshes import shape_of
from tests.scenes.rooms import CAMERA, frame_at, view_at

CUBE = shape_of(trimesh.creation.box((0.2, 0.2, 0.2)))
BALL = shape_of(trimesh.creation.icosphere(1, 0.1))
PLACE = Placement(position_m=(-0.9, 0.6, 1.0))


def client_of(device: Device, room: Room, asked: Wishes, **said: Any) -> ClientSession:
    """A pipeline of one more client of the room."""
    hello = Hello(client="test", camera=CAMERA, wishes=asked, room=room.name, **said)
    return ClientSession(device, CAMERA, asked, room, hello)


def scan(pipeline: ClientSession, steps: range) -> None:
    """Frames of the room from the usual way."""
    for step in steps:
        pipeline.process(frame_at(view_at(step), step, given=view_at(step)))


def voxels_of(volume: Volume) -> dict[int, bytes]:
    """All bits of each brick, by its place."""
    return {
        place: voxel.tobytes() + color.tobytes()
        for places, voxels, colors in volume.copies(volume.places())
        for place, voxel, color in zip(places.tolist(), voxels, colors, strict=True)
    }


def print_of(room: Room) -> tuple[str, ...]:
    """Of everything in it: rooms of the same print are the same, bit for bit. For whoever holds the room's lock."""
    taken = snapshot_within(room, SaveSlot(Path()))
    voxels = hashlib.blake2b()
    for place, data in sorted(voxels_of(room.reconstruction.volume).items() if room.reconstruction.volume else ()):
        voxels.update(f"{place}".encode() + data)
    return voxels.hexdigest(), state_to_bytes(taken.state).hex(), *map(_print_of_object, taken.objects)


def found(folder: Path, device: Device) -> tuple[str, ...]:
    """Print of what a server finds that was started anew."""
    room = RoomStore(folder).load("study", device)
    assert room is not None
    try:
        return print_of(room)
    finally:
        room.close()


def _print_of_object(kept: Any) -> str:
    arrays = [kept.mesh.vertices, kept.mesh.triangles, kept.mesh.vertex_colors, kept.mesh.normals, kept.mesh.texture_uv]
    digest = hashlib.blake2b(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()
    place = kept.place.tolist() if isinstance(kept.place, np.ndarray) else kept.place
    return f"{kept.object_id} {digest} {kept.mesh.up_axis} {kept.mesh.notes} {place}"


def layout_of(kind: Any) -> Any:
    """Names on disk and types of all fields of a stored struct, as plain lists."""
    return _layout(msgspec.inspect.type_info(kind), set())


def _layout(info: Any, within: set[Any]) -> Any:
    cls = getattr(info, "cls", None)
    if isinstance(info, msgspec.inspect.CustomType):
        return cls.__name__
    if cls is Wishes:
        return "Wishes"  # may have more of them, with defaults
    if hasattr(info, "fields"):
        if cls in within:
            return cls.__name__
        return [[field.encode_name, _layout(field.type, within | {cls})] for field in info.fields]
    parts = [getattr(info, name, None) for name in ("item_type", "item_types", "types", "key_type", "value_type")]
    flat = [part for some in parts if some is not None for part in (some if isinstance(some, tuple) else (some,))]
    return [type(info).__name__, *(_layout(part, within) for part in flat)]
