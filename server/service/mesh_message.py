"""Splits the scene's mesh files into parts that fit a message."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from protocol.limits import MAX_MESH_PART_BYTES, MAX_SCENE_MESH_BYTES
from protocol.messages import MeshFormat, MeshPart


def mesh_parts(request: int, files: Mapping[MeshFormat, bytes]) -> Iterator[MeshPart]:
    """The parts of all files, in order. Raises ValueError before the first part if a file is too large."""
    for format_, data in files.items():
        if len(data) > MAX_SCENE_MESH_BYTES:
            raise ValueError(
                f"the scene's mesh has {len(data) >> 20} MiB as {format_}, at most {MAX_SCENE_MESH_BYTES >> 20} MiB "
                "are sent: give a larger --voxel, or use probeless run"
            )
    return (
        MeshPart(
            request=request,
            format=format_,
            size_bytes=len(data),
            offset=offset,
            data=data[offset : offset + MAX_MESH_PART_BYTES],
        )
        for format_, data in files.items()
        for offset in range(0, len(data), MAX_MESH_PART_BYTES)
    )
