"""Newest complete frames of a depthai pipeline, of a camera or of host nodes that simulate one."""

from __future__ import annotations

from datetime import timedelta
from typing import Any

import cv2
import depthai as dai
import numpy as np
from numpy.typing import NDArray

from client.errors import SourceError
from client.sources.oak.nodes import Outputs
from client.sources.oak.poses import PoseTrail, world_from_lens
from protocol.frames import CameraModel, RgbdFrame

MILLIMETRE_M = 0.001
SILENCE_S = 10.0
"""Time without a picture, or without a pose, after which reading fails."""
POSE_PATIENCE_S = 0.1
NO_DEPTH = 65535
"""Depth of disparity 0; becomes 0, no depth."""


class FrameReader:
    """Reads the newest frame of a pipeline; must be created before the pipeline starts."""

    def __init__(
        self, pipeline: dai.Pipeline, outputs: Outputs, fps: float, left_from_color: NDArray[np.float64]
    ) -> None:
        self._pipeline, self._left_from_color = pipeline, left_from_color
        sync = pipeline.create(dai.node.Sync)
        sync.setRunOnHost(True)
        sync.setSyncThreshold(timedelta(seconds=0.5 / fps))
        outputs.color.link(sync.inputs["color"])
        outputs.depth.link(sync.inputs["depth"])
        self._queue = sync.out.createOutputQueue(maxSize=1, blocking=False)
        self._trail = self._follow(outputs, PoseTrail(2.5 / fps)) if outputs.pose is not None else None
        self._last: int | None = None
        self.missed = 0
        """Number of pictures that were not read in time."""

    def read(self, index: int) -> tuple[RgbdFrame, CameraModel]:
        """The newest unread frame, numbered `index`, and its camera; waits for one if necessary.

        Raises SourceError if the camera is disconnected, sends nothing, or finds no pose.
        """
        for _ in range(round(SILENCE_S / POSE_PATIENCE_S)):
            color, depth = self._parts()
            time_s = color.getTimestamp().total_seconds()
            pose = None
            if self._trail is not None:
                found = self._trail.at(time_s, POSE_PATIENCE_S)
                if found is None:
                    continue  # odometry is still initialising, or missed a picture
                pose = found @ self._left_from_color
            return self._frame(index, time_s, color, depth, pose), _camera(color)
        raise SourceError(
            "oak: the camera's odometry finds no pose; show it more texture, or stream oak?vio=off --poses track"
        )

    def close(self) -> None:
        """End the pipeline and wait for it; its destructor would deadlock with threads that wait for this one."""
        self._pipeline.stop()
        self._pipeline.wait()

    def _parts(self) -> tuple[dai.ImgFrame, dai.ImgFrame]:
        try:
            group = self._queue.get(timedelta(seconds=SILENCE_S))
        except (dai.MessageQueue.QueueException, RuntimeError) as error:
            raise SourceError("oak: the camera has gone; is its cable in place?") from error
        if group is None:
            raise SourceError(f"oak: the camera has sent no picture for {SILENCE_S:g} s; plug it in again")
        color, depth = group["color"], group["depth"]
        number = color.getSequenceNum()
        if self._last is not None:
            self.missed += max(number - self._last - 1, 0)
        self._last = number
        return color, depth

    def _frame(
        self, index: int, time_s: float, color: dai.ImgFrame, depth: dai.ImgFrame, pose: NDArray[np.float64] | None
    ) -> RgbdFrame:
        rgb = cv2.cvtColor(color.getCvFrame(), cv2.COLOR_BGR2RGB)
        depth_mm = np.array(depth.getFrame(), np.uint16)
        if depth_mm.shape != rgb.shape[:2]:
            raise SourceError(f"oak: depth is {depth_mm.shape[::-1]}, colour {rgb.shape[1::-1]}: not of one size")
        depth_mm[depth_mm == NO_DEPTH] = 0
        return RgbdFrame(index, time_s, rgb, depth_mm, pose, _exposure(color))

    @staticmethod
    def _follow(outputs: Outputs, trail: PoseTrail) -> PoseTrail:
        """Fill the trail with incoming poses. A pose has no timestamp; it belongs to the picture that is sent next.

        Callbacks run in order in the sending thread; separate queues could be off by one.
        """
        newest: list[dai.TransformData] = []

        def keep(_name: str, message: Any) -> None:
            newest[:] = [message]

        def date(_name: str, message: Any) -> None:
            if newest:
                at, rotation = newest[0].getTranslation(), newest.pop().getQuaternion()
                pose = world_from_lens((at.x, at.y, at.z), (rotation.qx, rotation.qy, rotation.qz, rotation.qw))
                trail.add(message.getTimestamp().total_seconds(), pose)

        for output, callback in ((outputs.pose, keep), (outputs.pose_image, date)):
            assert output is not None
            output.createOutputQueue(maxSize=1, blocking=False).addCallback(callback)
        return trail


def _exposure(color: dai.ImgFrame) -> float | None:
    """Exposure time in seconds times gain; None if the camera does not report it."""
    product = color.getExposureTime().total_seconds() * color.getSensitivity() / 100
    return product if product > 0 else None


def _camera(color: dai.ImgFrame) -> CameraModel:
    """Camera model of the picture after resizing, cropping and undistortion."""
    matrix = np.array(color.getTransformation().getIntrinsicMatrix(), np.float64)
    return CameraModel(
        width=color.getWidth(),
        height=color.getHeight(),
        fx=float(matrix[0, 0]),
        fy=float(matrix[1, 1]),
        cx=float(matrix[0, 2]),
        cy=float(matrix[1, 2]),
        depth_scale_m=MILLIMETRE_M,
    )
