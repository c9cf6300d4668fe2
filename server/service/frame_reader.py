"""Reads one session's frames from their messages."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from protocol.colors import ColorReader
from protocol.frames import CameraModel, RgbdFrame, Viewpoint
from protocol.images import decode_depth
from protocol.messages import DepthImage, Frame


class FrameReader:
    """Depth is decoded in a thread of its own while a child decodes the colours (parsers.py). Owned by one thread."""

    def __init__(self, camera: CameraModel, colors: ColorReader) -> None:
        """`colors`: closed with this."""
        self._camera, self._colors = camera, colors
        self._beside = ThreadPoolExecutor(1, "depth")
        lens = camera.depth_lens
        self._no_depth = np.zeros((lens.height, lens.width), np.uint16)
        self.cpu_s_beside = 0.0
        """Processor time of the other thread, in all."""

    def read(self, frame: Frame) -> RgbdFrame | Viewpoint:
        """What a message shows. Raises ProtocolError."""
        pose = None if frame.world_from_camera is None else np.array(frame.world_from_camera, np.float64).reshape(4, 4)
        if frame.color is None:
            assert pose is not None  # of a frame that decodes
            return Viewpoint(frame.frame, frame.timestamp_s, pose)
        depth = None if frame.depth is None else self._beside.submit(self._decode_depth, frame.depth)
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

    def close(self) -> None:
        """End the thread, and the decoder of colours."""
        self._beside.shutdown()
        self._colors.close()

    def _decode_depth(self, image: DepthImage) -> NDArray[np.uint16]:
        began_s = time.thread_time()
        try:
            return decode_depth(image, self._camera)
        finally:
            self.cpu_s_beside += time.thread_time() - began_s
