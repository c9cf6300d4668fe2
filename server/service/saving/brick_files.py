"""Brick files of a volume: the first holds all bricks, later ones those that have changed since."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyopencl.cltypes as cl_types
import zstandard
from msgspec import Struct
from numpy.typing import NDArray

from server.service.saving.checksummed_files import DamagedFile, read_parts, write_parts
from server.volume.brick_pool import BRICK_VOXELS
from server.volume.brick_table import Indices

Batch = tuple[Indices, NDArray[Any], NDArray[np.uint32]]
"""Brick indices [k], voxels [k, 512] float2 (tsdf, weight), colours [k, 512]."""

_LEVEL = 1  # zstd; about 1 GB/s
_MOST = 1 << 16  # bricks per batch


class _Batch(Struct, array_like=True):
    places: bytes
    voxels: bytes
    colors: bytes


def write_bricks(path: Path, batches: Iterable[Batch]) -> int:
    """Write a brick file and return its size in bytes. Raises OSError."""
    return write_parts(
        path,
        (msgspec.msgpack.encode(_Batch(*map(_packed, batch))) for batch in batches),
    )


def read_bricks(path: Path) -> Iterator[Batch]:
    """The batches of a file. Raises DamagedFile, OSError."""
    for part in read_parts(path):
        batch = _decoded(path, part)
        places = np.frombuffer(_unpacked(path, batch.places, 4 * _MOST), np.int32)
        voxels = np.frombuffer(_unpacked(path, batch.voxels, 8 * BRICK_VOXELS * len(places)), cl_types.float2)
        colors = np.frombuffer(_unpacked(path, batch.colors, 4 * BRICK_VOXELS * len(places)), np.uint32)
        if not len(voxels) == len(colors) == BRICK_VOXELS * len(places):
            raise DamagedFile(f"{path} holds parts of bricks")
        yield places, voxels.reshape(-1, BRICK_VOXELS), colors.reshape(-1, BRICK_VOXELS)


def merged(paths: list[Path], live: Indices) -> Iterator[Batch]:
    """The newest version of each brick in `live`. Raises DamagedFile, also if a brick is in none of the files."""
    last: dict[int, int] = {}
    for number, path in enumerate(paths):
        for part in read_parts(path):
            places = np.frombuffer(_unpacked(path, _decoded(path, part).places, 4 * _MOST), np.int32)
            last |= dict.fromkeys(places.tolist(), number)
    wanted = np.array([last.get(place, -1) for place in live.tolist()], np.int64)
    if (wanted < 0).any():
        raise DamagedFile(
            f"{int((wanted < 0).sum())} bricks are in none of the files of {paths[0].parent if paths else ''}"
        )
    for number, path in enumerate(paths):
        own = live[wanted == number]
        if not own.size:
            continue
        for places, voxels, colors in read_bricks(path):
            chosen = np.isin(places, own)
            if chosen.any():
                yield places[chosen], voxels[chosen], colors[chosen]


def _packed(array: NDArray[Any]) -> bytes:
    return zstandard.ZstdCompressor(level=_LEVEL).compress(np.ascontiguousarray(array).data.cast("B"))


def _decoded(path: Path, part: bytes) -> _Batch:
    try:
        return msgspec.msgpack.decode(part, type=_Batch)
    except msgspec.MsgspecError as error:
        raise DamagedFile(f"{path} holds no bricks: {error}") from error


def _unpacked(path: Path, data: bytes, most: int) -> bytes:
    try:
        if zstandard.frame_content_size(data) > most:
            raise DamagedFile(f"{path} holds more voxels than its bricks have")
        return zstandard.ZstdDecompressor().decompress(data)
    except zstandard.ZstdError as error:
        raise DamagedFile(f"{path} holds no bricks: {error}") from error
