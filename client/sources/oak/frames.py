"""Frames out of a depthai pipeline, of a camera or of host nodes that play one: the newest that has all its parts."""

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
"""Without a picture, or with pictures but no pose: the camera is given up."""
POSE_PATIENCE_S = 0.1
NO_DEPTH = 65535
"""What a stereo disparity of 0 comes to; 0 is no depth too."""


class FrameReader:
    """Reads a started pipeline; made before it starts. Keeps no frame but the newest."""

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
        """Pictures that the camera took and nobody asked for in time."""

    def read(self, index: int) -> tuple[RgbdFrame, CameraModel]:
        """The newest frame that was not read yet, waited for if need be, numbered `index`; and its camera.

        Raises SourceError when the camera has gone, sends nothing, or knows no poses though it should.
        """
        for _ in range(round(SILENCE_S / POSE_PATIENCE_S)):
            color, depth = self._parts()
            time_s = color.getTimestamp().total_seconds()
            pose = None
            if self._trail is not None:
                found = self._trail.at(time_s, POSE_PATIENCE_S)
                if found is None:
                    continue  # odometry that has not found its feet yet, or lost a picture
                pose = found @ self._left_from_color
            return self._frame(index, time_s, color, depth, pose), _camera(color)
        raise SourceError(
            "oak: the camera's odometry finds no pose; show it more texture, or stream oak?vio=off --poses track"
        )

    def close(self) -> None:
        """End the pipeline. It is waited for: its destructor would wait for threads that wait for this one."""
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
        """Fill the trail as poses come. A pose has no time of its own: it is that of the picture sent after it.

        Callbacks run in the thread that sends, one after the other: queues read later could slip by one.
        """
        newest: list[dai.TransformData] = []

        def keep(_name: str, message: Any) -> None:
            newest[:] = [message]

        def date(_name: str, message: Any) -> None:
            if newest:
                at, turn = newest[0].getTranslation(), newest.pop().getQuaternion()
                pose = world_from_lens((at.x, at.y, at.z), (turn.qx, turn.qy, turn.qz, turn.qw))
                trail.add(message.getTimestamp().total_seconds(), pose)

        for output, callback in ((outputs.pose, keep), (outputs.pose_image, date)):
            assert output is not None
            output.createOutputQueue(maxSize=1, blocking=False).addCallback(callback)
        return trail


def _exposure(color: dai.ImgFrame) -> float | None:
    """Seconds times gain; None where the camera does not say."""
    product = color.getExposureTime().total_seconds() * color.getSensitivity() / 100
    return product if product > 0 else None


def _camera(color: dai.ImgFrame) -> CameraModel:
    """The picture's own lens, from the calibration, after resizing, cropping and undistortion."""
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
