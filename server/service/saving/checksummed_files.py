"""Files with a checksum: length-prefixed parts, and a digest of everything at the end."""

from __future__ import annotations

import hashlib
import os
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path

MAGIC = b"probeless file 1"
_LENGTH = struct.Struct("<Q")
_END = 0xFFFF_FFFF_FFFF_FFFF
_DIGEST_BYTES = 32
_CHUNK = 1 << 20


class DamagedFile(Exception):
    """A file is incomplete or was altered; one line."""


def write_parts(path: Path, parts: Iterable[bytes]) -> int:
    """Write `parts` to a file, fsync it, and return its size in bytes. Raises OSError; the file is then removed."""
    try:
        return _write(path, parts)
    except OSError:
        path.unlink(missing_ok=True)
        raise


def _write(path: Path, parts: Iterable[bytes]) -> int:
    digest = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    size = 0
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | getattr(os, "O_BINARY", 0), 0o600)
    try:
        for piece in _pieces(parts):
            digest.update(piece)
            size += _write_all(file, piece)
        size += _write_all(file, digest.digest())
        os.fsync(file)
    finally:
        os.close(file)
    return size


def _pieces(parts: Iterable[bytes]) -> Iterator[bytes]:
    yield MAGIC
    for part in parts:
        yield _LENGTH.pack(len(part))
        yield part
    yield _LENGTH.pack(_END)


def _write_all(file: int, data: bytes) -> int:
    view = memoryview(data)
    while view:
        view = view[os.write(file, view) :]
    return len(data)


def sync_folder(folder: Path) -> None:
    """fsync a folder, so that renames and new files in it are durable. Raises OSError."""
    if os.name == "nt":
        return  # Windows cannot open folders; names are written with the files
    file = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def check_file(path: Path) -> None:
    """Verify the checksum. Raises DamagedFile, or OSError if the file cannot be read."""
    digest = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    try:
        with path.open("rb") as file:
            left = os.fstat(file.fileno()).st_size - _DIGEST_BYTES
            if left < len(MAGIC):
                raise DamagedFile(f"{path} is too short")
            while left > 0 and (piece := file.read(min(_CHUNK, left))):
                digest.update(piece)
                left -= len(piece)
            said = file.read()
    except FileNotFoundError as error:
        raise DamagedFile(f"{path} is not there") from error
    if said != digest.digest():
        raise DamagedFile(f"{path} is not what was written: its checksum is another")


def read_parts(path: Path) -> Iterator[bytes]:
    """Iterate over the parts without verifying the digest. Raises DamagedFile, OSError."""
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise DamagedFile(f"{path} is not of this program, or of another version of it")
        while (length := _length(file.read(_LENGTH.size))) != _END:
            part = file.read(length) if 0 <= length <= os.fstat(file.fileno()).st_size else b""
            if len(part) != length:
                raise DamagedFile(f"{path} ends too early")
            yield part


def _length(data: bytes) -> int:
    """-1 if there are too few bytes."""
    return int(_LENGTH.unpack(data)[0]) if len(data) == _LENGTH.size else -1
