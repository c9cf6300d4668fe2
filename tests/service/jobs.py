"""What children of the tests do instead of reading: each line of a request says how it goes wrong."""

from __future__ import annotations

import os
import resource
import signal
import time

import numpy as np

from server.parsing.mesh_bytes import mesh_to_bytes
from server.parsing.read_mesh import read_mesh as really_read_mesh
from server.parsing.read_picture import read_picture as really_read_picture
from server.scene.mesh import Mesh


def read_mesh(request: bytes) -> bytes:
    """As the real one, but for files that say what shall happen."""
    match request.partition(b"\n")[2]:
        case b"hang":
            time.sleep(60)
        case b"eat":
            np.ones(1 << 36)
        case b"crash":
            os.kill(os.getpid(), signal.SIGSEGV)
        case b"lie":
            return b"\xc1 no mesh"
        case b"talk":
            return bytes(200_000)
        case b"limits":
            names = ("RLIMIT_AS", "RLIMIT_FSIZE", "RLIMIT_NPROC", "RLIMIT_CORE")
            raise ValueError(" ".join(str(resource.getrlimit(getattr(resource, name))[0]) for name in names))
        case b"environment":
            raise ValueError(" ".join(os.environ))
        case b"tiny":
            return mesh_to_bytes(triangle())
    return really_read_mesh(request)


def read_picture(request: bytes) -> bytes:
    """As the real one, but dies of a picture that is all black."""
    answer = really_read_picture(request)
    if b"\x00" * 64 in request:
        os.kill(os.getpid(), signal.SIGSEGV)
    return answer


def triangle() -> Mesh:
    """One."""
    return Mesh(
        vertices=np.eye(3, dtype=np.float32),
        triangles=np.array([[0, 1, 2]], np.int32),
        vertex_colors=np.full((3, 3), 0.5, np.float32),
        normals=np.tile(np.float32([0, 0, 1]), (3, 1)),
        up_axis="y",
    )
