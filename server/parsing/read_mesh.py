"""Job of mesh children."""

from __future__ import annotations

from server.parsing.mesh_bytes import mesh_to_bytes
from server.scene.mesh import load_mesh


def read_mesh(request: bytes) -> bytes:
    """`FORMAT\\n` and a file -> the mesh as server.parsing.mesh_bytes packs it. Raises MeshError."""
    file_format, _, data = request.partition(b"\n")
    return mesh_to_bytes(load_mesh(data, file_format.decode()))
