"""Nodes of the pipeline on an OAK-D: colour, stereo depth aligned to it, odometry. Needs depthai 3 and a device."""

from __future__ import annotations

from dataclasses import dataclass

import depthai as dai
import numpy as np
from numpy.typing import NDArray

COLOR, LEFT, RIGHT = dai.CameraBoardSocket.CAM_A, dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C
STEREO_SIZE = (640, 400)
SUBPIXEL_BITS = 5
"""Disparity in 1/32 pixel: depth steps of 2 mm at 1.5 m instead of 60 mm."""
LEFT_RIGHT_THRESHOLD = 5
"""Threshold of the left-right check in the device's unit; removes depth of points visible to one lens only."""
CONFIDENCE = 55
"""0 to 255, smaller is stricter; for fusion a wrong depth is worse than a missing one."""
IMU_HZ = 200
DOT_PROJECTOR = 0.7
"""Relative brightness of the infrared dots, if the camera has a projector; they give depth on textureless walls."""


@dataclass(frozen=True)
class Outputs:
    """Output streams of the nodes, read by `FrameReader`."""

    color: dai.Node.Output
    """BGR, without distortion."""
    depth: dai.Node.Output
    """Millimetres, aligned to the colour picture."""
    pose: dai.Node.Output | None = None
    pose_image: dai.Node.Output | None = None
    """The left picture of a pose, sent after the pose."""


def build_nodes(
    pipeline: dai.Pipeline, device: dai.Device, size: tuple[int, int], fps: float, with_pose: bool
) -> Outputs:
    """Colour of `size`, depth aligned to it, and poses if `with_pose`."""
    cameras = {socket: pipeline.create(dai.node.Camera).build(socket, sensorFps=fps) for socket in (COLOR, LEFT, RIGHT)}
    color = cameras[COLOR].requestOutput(
        size, dai.ImgFrame.Type.BGR888i, dai.ImgResizeMode.CROP, fps, enableUndistortion=True
    )
    left, right = (cameras[socket].requestOutput(STEREO_SIZE) for socket in (LEFT, RIGHT))
    depth = _build_depth(pipeline, device, left, right, color)
    if not with_pose:
        if device.getIrDrivers():  # not with odometry: the dots move with the camera
            device.setIrLaserDotProjectorIntensity(DOT_PROJECTOR)
        return Outputs(color, depth)
    odometry = _build_odometry(pipeline, left, right)
    return Outputs(color, depth, odometry.transform, odometry.passthrough)


def has_odometry(device: dai.Device) -> bool:
    """Whether the camera has the IMU that visual-inertial odometry needs."""
    return device.getConnectedIMU() not in ("", "NONE", "UNKNOWN")


def left_from_color(calibration: dai.CalibrationHandler) -> NDArray[np.float64]:
    """[4, 4] rigid, metres: from the axes of the colour lens to those of the left lens, from the calibration."""
    matrix = np.eye(4)
    matrix[:3] = np.array(calibration.getCameraExtrinsics(COLOR, LEFT, unit=dai.LengthUnit.METER), np.float64)[:3]
    return matrix


def _build_depth(
    pipeline: dai.Pipeline,
    device: dai.Device,
    left: dai.Node.Output,
    right: dai.Node.Output,
    color: dai.Node.Output,
) -> dai.Node.Output:
    stereo = pipeline.create(dai.node.StereoDepth)
    stereo.setDefaultProfilePreset(dai.node.StereoDepth.PresetMode.ROBOTICS)
    stereo.setLeftRightCheck(True)
    stereo.setSubpixel(True)
    stereo.setSubpixelFractionalBits(SUBPIXEL_BITS)
    stereo.initialConfig.setLeftRightCheckThreshold(LEFT_RIGHT_THRESHOLD)
    stereo.initialConfig.setMedianFilter(dai.StereoDepthConfig.MedianFilter.KERNEL_5x5)
    stereo.initialConfig.setConfidenceThreshold(CONFIDENCE)
    left.link(stereo.left)
    right.link(stereo.right)
    if device.getPlatform() != dai.Platform.RVC4:
        color.link(stereo.inputAlignTo)
        return stereo.depth
    align = pipeline.create(dai.node.ImageAlign)  # RVC4 does not align in the stereo node
    stereo.depth.link(align.input)
    color.link(align.inputAlignTo)
    return align.outputAligned


def _build_odometry(pipeline: dai.Pipeline, left: dai.Node.Output, right: dai.Node.Output) -> dai.node.BasaltVIO:
    inertia = pipeline.create(dai.node.IMU)
    inertia.enableIMUSensor([dai.IMUSensor.ACCELEROMETER_RAW, dai.IMUSensor.GYROSCOPE_RAW], IMU_HZ)
    inertia.setBatchReportThreshold(1)
    inertia.setMaxBatchReports(10)
    odometry = pipeline.create(dai.node.BasaltVIO)
    odometry.setImuUpdateRate(IMU_HZ)
    left.link(odometry.left)
    right.link(odometry.right)
    inertia.out.link(odometry.imu)
    return odometry
