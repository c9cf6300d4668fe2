"""Takes a snapshot of a room, and rebuilds a room from a saved state."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from server.opencl.device import Device
from server.parsing.mesh_bytes import mesh_from_bytes
from server.room.room import Room
from server.room.room_objects import ObjectRecord
from server.scene.placement import Placement
from server.service.saving.brick_files import merged
from server.service.saving.checksummed_files import DamagedFile, read_parts
from server.service.saving.room_state import RoomState, StoredMarker, StoredVolume
from server.service.saving.save_slot import SaveSlot
from server.service.saving.snapshot import Snapshot
from server.volume.volume import Volume

log = logging.getLogger(__name__)


def snapshot(room: Room, slot: SaveSlot) -> Snapshot:
    """Snapshot of the room, with the bricks that `slot` does not have. Waits for the room's lock."""
    with room.lock:
        start_s = time.perf_counter()
        taken = snapshot_within(room, slot)
        return replace(taken, lock_ms=1e3 * (time.perf_counter() - start_s))


def snapshot_within(room: Room, slot: SaveSlot) -> Snapshot:
    """As `snapshot`; the caller holds the room's lock."""
    volume = room.reconstruction.volume
    bricks = list(volume.copies(volume.changed_since(slot.change_of(volume)))) if volume else []
    state = RoomState(
        wishes=room.wishes,
        up=room.objects.up if room.objects.has_begun else None,
        volume=_kept(volume, room.reconstruction.exposure_logarithms) if volume else None,
        keyframes=tuple(room.reconstruction.keyframes.kept()),
        markers=tuple(StoredMarker(*name, place) for name, place in room.markers.places().items()),
        light=room.light.known(),
        lamps=room.lamps.found,
        key_digest=room.key_digest,
    )
    return Snapshot(state, room.objects.inventory(), volume, bricks, volume.changes if volume else 0)


def _kept(volume: Volume, exposure_logarithms: float) -> StoredVolume:
    return StoredVolume(volume.bounds_m, volume.voxel_m, volume.frames, exposure_logarithms, volume.places())


def rebuilt(name: str, state: RoomState, slot: SaveSlot, device: Device) -> Room:
    """Rebuild the room whose `state` was read from `slot`. Raises DamagedFile, OSError."""
    room = Room(device, state.wishes, name)
    room.key_digest = state.key_digest
    try:
        if state.volume:
            _rebuild_volume(room, state.volume, slot)
        for keyframe in state.keyframes:
            room.reconstruction.keyframes.add(keyframe.thumbnail, keyframe.volume_from_camera)
        room.markers.resume({(kept.dictionary, kept.number): kept.room_from_marker for kept in state.markers})
        room.light.resume(state.light)
        room.lamps.resume(state.lamps)
        _rebuild_objects(room, state, slot)
    except BaseException:
        room.close()
        raise
    return room


def _rebuild_volume(room: Room, kept: StoredVolume, slot: SaveSlot) -> None:
    volume = Volume(room.engine, kept.bounds_m, kept.voxel_m)
    if kept.places.size and not 0 <= int(kept.places.min()) <= int(kept.places.max()) < int(np.prod(volume.bricks)):
        raise DamagedFile(f"{slot.folder} names bricks beyond the volume")
    volume.fill(merged(slot.paths(kept.files), kept.places), kept.frames)
    room.reconstruction.volume = volume
    room.reconstruction.exposure_logarithms = kept.exposure_logarithms
    slot.note_filled(volume)


def _rebuild_objects(room: Room, state: RoomState, slot: SaveSlot) -> None:
    if state.up is not None:
        room.resume_up(state.up)
    for kept in state.objects:
        place = kept.world_from_model if kept.world_from_model is not None else kept.placement or Placement()
        try:
            mesh = mesh_from_bytes(_only(read_parts(slot.folder / kept.mesh)))
            room.objects.restore(ObjectRecord(kept.object_id, mesh, place))
        except ValueError as error:
            log.warning("object %r of room %r could not be restored: %s", kept.object_id, room.name, error)


def _only(parts: Iterable[bytes]) -> bytes:
    return next(iter(parts), b"")
