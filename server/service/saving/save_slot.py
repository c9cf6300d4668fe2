"""One of the two folders to which saves of a room alternate. A save is complete in itself and replaced atomically."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from weakref import ref

import msgspec
from msgspec import structs

from server.parsing.mesh_bytes import mesh_to_bytes
from server.room.room_objects import ObjectRecord
from server.scene.mesh import Mesh
from server.scene.placement import Placement
from server.service.saving.brick_files import Batch, merged, write_bricks
from server.service.saving.checksummed_files import DamagedFile, check_file, read_parts, sync_folder, write_parts
from server.service.saving.retention import QUARANTINE_PREFIX
from server.service.saving.room_state import (
    READABLE,
    VERSION,
    FileName,
    Header,
    RoomState,
    StoredObject,
    StoredVolume,
    state_from_bytes,
    state_to_bytes,
)
from server.service.saving.snapshot import Snapshot
from server.volume.volume import Volume

SAVE, PART = "save", "save.part"
"""The index file, which names all other files of a save."""
FOLDER_MODE = 0o700
"""Scans of rooms are for the server's user alone."""
SPARE_BRICKS = 1024
"""Brick files are merged when they hold more than twice the live bricks plus this number."""


@dataclass(frozen=True)
class _Bricks:
    """Content of the brick files: a volume in the state in which its `changes` was `change`."""

    volume: ref[Volume]
    change: int
    files: tuple[FileName, ...]
    count: int
    """Bricks in all files, including outdated versions."""


@dataclass
class _Work:
    """A save that is being written."""

    header: Header
    taken: Snapshot
    new: list[Path] = field(default_factory=list)
    """New files, deleted if the save fails."""
    bricks: _Bricks | None = None
    meshes: dict[FileName, Mesh | None] = field(default_factory=dict)
    size: int = 0


class SaveSlot:
    """Not thread-safe."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._bricks: _Bricks | None = None
        self._meshes: dict[FileName, Mesh | None] = {}
        """Mesh files known to be complete, and the mesh each was written from."""
        self._read: tuple[tuple[FileName, ...], int] = ((), 0)

    def paths(self, files: Iterable[FileName]) -> list[Path]:
        """Paths of files in this slot."""
        return [self.folder / name for name in files]

    def change_of(self, volume: Volume) -> int:
        """The volume's `changes` at the time of the save; -1 if the files hold another volume or none."""
        known = self._bricks
        return known.change if known and known.volume() is volume else -1

    def note_filled(self, volume: Volume) -> None:
        """Note that `volume` was filled from the files that were read."""
        files, count = self._read
        self._bricks = _Bricks(ref(volume), volume.changes, files, count)

    def header(self) -> Header | None:
        """The save's header, without verifying the checksum; None if there is no save. Raises DamagedFile, OSError."""
        path = self.folder / SAVE
        if not path.exists():
            return None
        try:
            return msgspec.msgpack.decode(next(read_parts(path), b""), type=Header)
        except msgspec.MsgspecError as error:
            raise DamagedFile(f"{path} is no save: {error}") from error

    def key_digest(self) -> bytes | None:
        """Digest of the room's key from this save, if it has one. Raises DamagedFile, OSError."""
        check_file(self.folder / SAVE)
        header = self.header()
        if header is not None and header.key_digest is not None:
            return header.key_digest
        return self._state().key_digest

    def read(self) -> RoomState:
        """Read the save after verifying all its files. Raises DamagedFile, OSError."""
        check_file(self.folder / SAVE)
        state = self._state()
        meshes: dict[FileName, Mesh | None] = dict.fromkeys(kept.mesh for kept in state.objects)
        files = state.volume.files if state.volume else ()
        for file in self.paths((*files, *meshes)):
            check_file(file)
        self._meshes = meshes
        self._read = files, state.volume.bricks_in_files if state.volume else 0
        return state

    def _state(self) -> RoomState:
        path, header = self.folder / SAVE, self.header()
        if header is None or header.version not in READABLE:
            raise DamagedFile(f"{path} is of version {header and header.version}, this program reads {VERSION}")
        try:
            _, packed = read_parts(path)
            return state_from_bytes(packed)
        except ValueError as error:
            raise DamagedFile(f"{path} is no save: {error}") from error

    def write(self, header: Header, taken: Snapshot) -> int:
        """Write the snapshot and return the number of bytes. Raises OSError; the previous save is then still valid, or
        the new one is complete but not yet synced.

        Raises DamagedFile if earlier files were altered on disk; the next save then writes all bricks.
        """
        self._make_folder()
        work = _Work(header, taken)
        try:
            self._write_files(work)
            sync_folder(self.folder)
            os.replace(self.folder / PART, self.folder / SAVE)
        except (OSError, DamagedFile) as error:
            if isinstance(error, DamagedFile):
                self._bricks = None
            _remove(work.new)
            raise
        self._bricks, self._meshes = work.bricks, work.meshes
        sync_folder(self.folder)
        self._remove_unnamed({*(work.bricks.files if work.bricks else ()), *work.meshes})
        return work.size

    def _write_files(self, work: _Work) -> None:
        """Write all files. The final rename, which makes them the current save, is not done here."""
        state = work.taken.state
        state = structs.replace(state, objects=tuple(self._objects(work)))
        if state.volume and work.taken.volume:
            work.bricks = self._written_bricks(work, work.taken.volume, state.volume)
            files, count = work.bricks.files, work.bricks.count
            state = structs.replace(state, volume=structs.replace(state.volume, files=files, bricks_in_files=count))
        work.new.append(self.folder / PART)
        work.size += write_parts(self.folder / PART, [msgspec.msgpack.encode(work.header), state_to_bytes(state)])

    def _objects(self, work: _Work) -> Iterator[StoredObject]:
        """Entries of the objects; writes meshes that are not on disk yet."""
        names = {id(mesh): name for name, mesh in self._meshes.items()}
        for kept in work.taken.objects:
            name = names.get(id(kept.mesh))
            if name is None:
                data = mesh_to_bytes(kept.mesh)
                name = f"mesh-{hashlib.blake2b(data, digest_size=16).hexdigest()}"
                if name not in self._meshes:
                    work.new.append(self.folder / name)
                    work.size += write_parts(self.folder / name, [data])
                names[id(kept.mesh)] = name
            work.meshes[name] = kept.mesh
            yield _stored_object(kept, name)

    def _written_bricks(self, work: _Work, volume: Volume, kept: StoredVolume) -> _Bricks:
        """The brick files with one more for changed bricks, or a single merged one."""
        known = self._bricks if self.change_of(volume) >= 0 else None
        files, count = (known.files, known.count) if known else ((), 0)
        sequence, bricks = work.header.sequence, work.taken.bricks
        if bricks:
            files = (*files, self._write_bricks(work, f"bricks-{sequence}", bricks))
            count += sum(len(places) for places, _, _ in bricks)
        if len(files) > 1 and count > 2 * len(kept.places) + SPARE_BRICKS:
            everything = merged(self.paths(files), kept.places)
            files, count = (self._write_bricks(work, f"bricks-{sequence}-all", everything),), len(kept.places)
        return _Bricks(ref(volume), work.taken.change, files, count)

    def _write_bricks(self, work: _Work, name: FileName, bricks: Iterable[Batch]) -> FileName:
        work.new.append(self.folder / name)
        work.size += write_bricks(self.folder / name, bricks)
        return name

    def _make_folder(self) -> None:
        for folder in (self.folder.parent, self.folder):
            folder.mkdir(mode=FOLDER_MODE, parents=True, exist_ok=True)
            if folder.stat().st_mode & 0o777 != FOLDER_MODE:
                folder.chmod(FOLDER_MODE)  # made by an earlier version
        if not (self.folder / SAVE).exists():
            for folder in self.folder.parents[:3]:
                sync_folder(folder)

    def _remove_unnamed(self, kept: set[FileName]) -> None:
        """Delete files that the save does not name: those of earlier and of unfinished saves."""
        _remove([path for path in self.folder.iterdir() if path.name not in kept and path.name != SAVE])

    def quarantine(self) -> Path:
        """Rename the damaged folder so that it can be inspected. Returns the new path. Raises OSError."""
        room = self.folder.parent
        number = next(n for n in range(1, 1 << 30) if not (room / f"{QUARANTINE_PREFIX}{n}").exists())
        os.replace(self.folder, room / f"{QUARANTINE_PREFIX}{number}")
        sync_folder(room)
        self._bricks, self._meshes = None, {}
        return room / f"{QUARANTINE_PREFIX}{number}"


def _stored_object(kept: ObjectRecord, mesh: FileName) -> StoredObject:
    if isinstance(kept.place, Placement):
        return StoredObject(kept.object_id, mesh, placement=kept.place)
    return StoredObject(kept.object_id, mesh, world_from_model=kept.place)


def _remove(paths: Sequence[Path]) -> None:
    for path in paths:
        path.unlink(missing_ok=True)
