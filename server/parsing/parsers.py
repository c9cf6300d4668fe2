"""Decodes meshes and images in child processes, with the same results and errors as in this process."""

from __future__ import annotations

import mmap
import struct
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from protocol.codec import ProtocolError
from protocol.colors import ColorReader
from protocol.frames import CameraModel
from protocol.limits import MAX_IMAGE_PIXELS
from server.children.nursery import ChildDied, JobSpec, Nursery
from server.children.process_pool import IS_SUPPORTED, ProcessPool
from server.children.turns import MAX_INTERRUPTIONS, Account, Overdrawn, Turns
from server.parsing.mesh_bytes import MAX_PACKED_BYTES, mesh_from_bytes
from server.scene.limits import MeshError
from server.scene.mesh import Mesh, load_mesh

MESH_JOB = JobSpec("server.parsing.read_mesh:read_mesh", 4096, timeout_s=30.0, max_answer_bytes=MAX_PACKED_BYTES)
PICTURE_JOB = JobSpec(
    "server.parsing.read_picture:read_picture",
    1024,
    timeout_s=5.0,
    max_answer_bytes=4096,
    shared_bytes=3 * MAX_IMAGE_PIXELS,
)
VIDEO_JOB = replace(PICTURE_JOB, job="server.parsing.read_video:read_video")
_SIZE = struct.Struct("<II")
MESH_CHILDREN, PICTURE_CHILDREN = 2, 2
"""Two each, so that a slow file does not block other sessions."""
READING_BURST_S, READING_RATE = 120.0, 0.5
"""Reading time of one session: at once, and per second. Most files take less than 0.1 s."""


class Parsers:
    """Parsers of one service, called from worker threads. On unsupported systems they decode in this process."""

    def __init__(
        self,
        mesh_spec: JobSpec = MESH_JOB,
        picture_spec: JobSpec = PICTURE_JOB,
        video_spec: JobSpec = VIDEO_JOB,
    ) -> None:
        self.on_death: Callable[[str], None] = lambda _kind: None
        """Called in the waiting thread with `mesh`, `picture` or `video` when a child dies during a request."""
        on_mesh_death = partial(self._note_death, "mesh")
        self.meshes = ProcessPool(mesh_spec, MESH_CHILDREN, on_mesh_death)
        self.mesh_turns = Turns(MESH_CHILDREN)
        self.pictures = ProcessPool(picture_spec, PICTURE_CHILDREN, lambda: self.on_death("picture"))
        self._video_spec, self._video_nursery = video_spec, Nursery(video_spec)
        self._videos: set[ProcessPool] = set()
        """One child per session that sends video."""
        self._changing = threading.Lock()
        self._has_stopped = False

    def _note_death(self, kind: str) -> None:
        self.on_death(kind)

    def start(self) -> None:
        """Load what readers of meshes and pictures need in the background."""
        if IS_SUPPORTED:
            self.meshes.load()
            self.pictures.load()

    def stop(self) -> None:
        """End all children."""
        self.meshes.stop()
        self.pictures.stop()
        with self._changing:
            self._has_stopped = True
            videos = tuple(self._videos)
        for video in videos:
            video.stop()
        self._video_nursery.stop()

    def mesh_loader(self) -> Callable[[bytes, str], Mesh]:
        """`load_mesh` for one session, which has its own reading time."""
        return partial(self.load_mesh, account=Account(READING_BURST_S, READING_RATE))

    def load_mesh(self, data: bytes, file_format: str, account: Account | None = None) -> Mesh:
        """As server.scene.mesh.load_mesh. Raises MeshError, also if the child runs out of resources or dies.

        `account`: that of the session; None: a new one. Sessions that have read less go first (`turns.py`).
        """
        if not IS_SUPPORTED:
            return load_mesh(data, file_format)
        try:
            request = file_format.encode() + b"\n" + data
            answer = self._read_mesh(request, account or Account(READING_BURST_S, READING_RATE))
        except ChildDied as error:
            raise MeshError(f"the reader of the {file_format} file {error}: simplify the mesh or repair it") from error
        except (ValueError, Overdrawn) as error:
            raise MeshError(str(error)) from error
        assert isinstance(answer, bytearray)
        return mesh_from_bytes(answer)

    def _read_mesh(self, request: bytes, account: Account) -> object:
        """The child's answer. Begins again after an interruption. Raises ValueError, ChildDied, Overdrawn."""
        for _ in range(1 + MAX_INTERRUPTIONS):
            with self.mesh_turns.taken(account) as turn:
                try:
                    return self.meshes.ask(request, turn=turn)
                except ChildDied:
                    if not turn.is_interrupted:
                        raise
        raise MeshError(
            "reading it took so long that other sessions needed the reader: simplify it, or try again later"
        )

    def color_reader(self, camera: CameraModel) -> ColorReader:
        """Colour decoder of one session; must be closed."""
        return ColorReader(camera, self._decompress, self._open_video) if IS_SUPPORTED else ColorReader(camera)

    def _decompress(self, data: bytes) -> NDArray[np.uint8]:
        return _picture_of(self.pictures, data)

    def _open_video(self) -> _Video:
        children = ProcessPool(self._video_spec, 1, lambda: self.on_death("video"), self._video_nursery)
        with self._changing:
            self._videos.add(children)
            if self._has_stopped:
                children.stop()
        return _Video(children, self._forget)

    def _forget(self, children: ProcessPool) -> None:
        with self._changing:
            self._videos.discard(children)


class _Video:
    """Video decoder child of one session. After a crash, a new child starts without reference frames."""

    def __init__(self, children: ProcessPool, on_close: Callable[[ProcessPool], None]) -> None:
        self._children, self._on_close = children, on_close

    def decode(self, data: bytes) -> NDArray[np.uint8]:
        return _picture_of(self._children, data)

    def close(self) -> None:
        self._on_close(self._children)
        self._children.stop()


def _picture_of(children: ProcessPool, data: bytes) -> NDArray[np.uint8]:
    """Raises ProtocolError."""
    try:
        picture = children.ask(data, _shared_picture)
    except ChildDied as error:
        raise ProtocolError(f"color.data: the picture's reader {error}") from error
    except ValueError as error:
        raise ProtocolError(str(error)) from error
    assert isinstance(picture, np.ndarray)
    return picture


def _shared_picture(answer: bytearray, memory: mmap.mmap | None) -> NDArray[np.uint8]:
    """[h, w, 3] as a copy. Raises ValueError for an invalid size."""
    assert memory is not None
    if len(answer) != _SIZE.size:
        raise ValueError("color.data: its reader returned no size")
    height, width = _SIZE.unpack(answer)
    if 3 * height * width > len(memory):
        raise ValueError("color.data: its reader returned an invalid size")
    return np.frombuffer(memory, np.uint8, 3 * height * width).reshape(height, width, 3).copy()
