"""Reads one session's frames from their messages: the next one while the device is at work on the one before."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import ParamSpec, TypeVar

import numpy as np

from protocol.colors import ColorReader
from protocol.frames import CameraModel, RgbdFrame, Viewpoint
from protocol.images import decode_depth
from protocol.messages import Frame

P = ParamSpec("P")
T = TypeVar("T")


class FrameReader:
    """Depth is decoded in a thread of its own while a child decodes the colours (parsers.py). Frames are read in the
    order in which they are begun or asked for, since a picture of a video needs those before it."""

    def __init__(self, camera: CameraModel, colors: ColorReader) -> None:
        """`colors`: closed with this."""
        self._camera, self._colors = camera, colors
        self._reading = ThreadPoolExecutor(1, "frames")
        self._beside = ThreadPoolExecutor(1, "depth")
        lens = camera.depth_lens
        self._no_depth = np.zeros((lens.height, lens.width), np.uint16)
        self._changing = threading.Lock()
        self._begun: tuple[Frame, Future[RgbdFrame | Viewpoint]] | None = None
        self._is_closed = False
        self._cpu_s = 0.0

    def begin(self, frame: Frame) -> None:
        """Any thread: begin to read what will be asked for next. One frame at a time: until another one is asked for,
        the first is kept, even if it never is."""
        with self._changing:
            if self._begun is None and not self._is_closed:
                self._begun = frame, self._reading.submit(self._timed, self._read, frame)

    def read(self, frame: Frame) -> RgbdFrame | Viewpoint:
        """What a message shows. Raises ProtocolError."""
        with self._changing:
            begun, self._begun = self._begun, None
            if begun is None or begun[0] is not frame:
                begun = frame, self._reading.submit(self._timed, self._read, frame)
        return begun[1].result()

    def take_cpu_s(self) -> float:
        """Processor time that the threads have taken since this was last asked."""
        with self._changing:
            spent_s, self._cpu_s = self._cpu_s, 0.0
        return spent_s

    def close(self) -> None:
        """End the threads, and the decoder of colours."""
        with self._changing:
            self._is_closed = True
        self._reading.shutdown(cancel_futures=True)
        self._beside.shutdown()
        self._colors.close()

    def _read(self, frame: Frame) -> RgbdFrame | Viewpoint:
        pose = None if frame.world_from_camera is None else np.array(frame.world_from_camera, np.float64).reshape(4, 4)
        if frame.color is None:
            assert pose is not None  # of a frame that decodes
            return Viewpoint(frame.frame, frame.timestamp_s, pose)
        depth = None
        if frame.depth is not None:
            depth = self._beside.submit(self._timed, decode_depth, frame.depth, self._camera)
        color = self._colors.decode(frame.color)
        return RgbdFrame(
            index=frame.frame,
            timestamp_s=frame.timestamp_s,
            color=color,
            depth=self._no_depth if depth is None else depth.result(),
            world_from_camera=pose,
            exposure=frame.exposure,
            has_depth=depth is not None,
        )

    def _timed(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """What `work` returns; its processor time counts."""
        began_s = time.thread_time()
        try:
            return work(*args, **kwargs)
        finally:
            with self._changing:
                self._cpu_s += time.thread_time() - began_s
