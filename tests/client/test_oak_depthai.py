"""The OAK source on depthai itself, without a camera: a host-only pipeline that plays frames, and the nodes' names."""

from __future__ import annotations

import contextlib
import os
import time
from datetime import timedelta
from unittest.mock import MagicMock, create_autospec

import numpy as np
import pytest

for _name, _value in (("DEPTHAI_TELEMETRY", "0"), ("DEPTHAI_AUTOCALIBRATION", "OFF"), ("DEPTHAI_LEVEL", "error")):
    os.environ.setdefault(_name, _value)
dai = pytest.importorskip("depthai", reason="depthai is an extra: make install-oak")

from client.errors import SourceError  # noqa: E402
from client.sources.oak.frames import FrameReader  # noqa: E402
from client.sources.oak.nodes import Outputs, build_nodes, has_odometry, left_from_color  # noqa: E402
from client.sources.oak.poses import FLU_FROM_CAMERA, UP  # noqa: E402
from client.sources.oak.source import OakSource, open_oak  # noqa: E402
from tests.absent import NO_HARDWARE  # noqa: E402

FPS = 30.0
PATIENCE_S = 60.0
LENS = np.array([[60.0, 0, 31.0], [0, 61.0, 23.0], [0, 0, 1]])
LEFT_FROM_COLOR = np.array([[1.0, 0, 0, -0.0375], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def world_from_left(number: int) -> np.ndarray:
    pose = np.eye(4)
    angle = 0.01 * number
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = 0.01 * number, 0.02, -0.03
    return pose


def color_of(number: int) -> np.ndarray:
    """RGB, a gradient that tells red from blue."""
    picture = np.zeros((48, 64, 3), np.uint8)
    picture[..., 0], picture[..., 1] = number, np.arange(64)
    return picture


def depth_of(number: int) -> np.ndarray:
    depth = np.full((48, 64), 1000 + number, np.uint16)
    depth[0, :2] = 0, 65535
    return depth


class Player(dai.node.ThreadedHostNode):
    """Sends frames as a camera's nodes do: odometry one picture late, transform first, its picture after it."""

    def __init__(self) -> None:
        super().__init__()
        self.color, self.depth, self.pose, self.pose_image = (self.createOutput() for _ in range(4))
        self.last = 10**6
        self.sent = 0
        self.lost: range = range(0)

    def run(self) -> None:
        with contextlib.suppress(Exception):  # one that left a host node would end the process
            late = None
            for number in range(self.last):
                if not self.mainLoop():
                    return
                stamp = timedelta(seconds=50 + number / FPS)
                left = self._send(number, stamp)
                if late is not None and late[0] not in self.lost:
                    self.pose.send(self._transform(late[0]))
                    self.pose_image.send(late[1])
                late = number, left
                self.sent = number + 1
                time.sleep(0.005)
            self.stopPipeline()

    def _send(self, number: int, stamp: timedelta) -> dai.ImgFrame:
        for picture, kind, output in (
            (color_of(number % 200)[..., ::-1].copy(), dai.ImgFrame.Type.BGR888i, self.color),
            (depth_of(number % 200), dai.ImgFrame.Type.RAW16, self.depth),
        ):
            frame = dai.ImgFrame()
            frame.setCvFrame(picture, kind)
            frame.setTimestamp(stamp)
            frame.setTimestampDevice(stamp)
            frame.setSequenceNum(number)
            frame.setTransformation(dai.ImgTransformation(64, 48, LENS.tolist()))
            output.send(frame)
        return frame

    @staticmethod
    def _transform(number: int) -> dai.TransformData:
        flu = FLU_FROM_CAMERA @ world_from_left(number) @ FLU_FROM_CAMERA.T
        angle = -0.01 * number  # the camera's y points down, the body's z up
        x, y, z = flu[:3, 3]
        return dai.TransformData(x, y, z, 0.0, 0.0, float(np.sin(angle / 2)), float(np.cos(angle / 2)))


class Rig:
    """A pipeline without a device, its player and a reader of it."""

    def __init__(self, with_pose: bool, **settings: object) -> None:
        self.pipeline = dai.Pipeline(createImplicitDevice=False)
        self.player = player = self.pipeline.create(Player)
        for name, value in settings.items():
            setattr(player, name, value)
        poses = (player.pose, player.pose_image) if with_pose else ()
        self.reader = FrameReader(self.pipeline, Outputs(player.color, player.depth, *poses), FPS, LEFT_FROM_COLOR)
        self.pipeline.start()

    def wait_for_frames(self, count: int) -> None:
        """Until the camera has sent so many more frames."""
        until, until_s = self.player.sent + count, time.monotonic() + PATIENCE_S
        while self.player.sent < until:
            assert time.monotonic() < until_s
            time.sleep(0.005)


@pytest.fixture
def start():
    rigs: list[Rig] = []

    def build(with_pose: bool, **settings: object) -> Rig:
        rigs.append(Rig(with_pose, **settings))
        return rigs[-1]

    yield build
    for rig in rigs:
        rig.reader.close()


def test_frames_arrive_with_their_own_poses(start) -> None:
    rig = start(True)
    source = OakSource(rig.reader, True, UP, lambda: None)
    camera = source.camera
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (64, 48, 60, 61, 31, 23)
    seen = []
    for index in range(12):
        frame = source[index]
        number = round((frame.timestamp_s - 50) * FPS)
        seen.append(number)
        np.testing.assert_array_equal(frame.color, color_of(number % 200))
        expected = depth_of(number % 200)
        expected[0, 1] = 0
        np.testing.assert_array_equal(frame.depth, expected)
        np.testing.assert_allclose(frame.world_from_camera, world_from_left(number) @ LEFT_FROM_COLOR, atol=1e-5)
        assert frame.index == index
        if index == 5:
            rig.wait_for_frames(2)
    assert seen == sorted(set(seen))
    assert source.missed >= seen[-1] - seen[0] - len(seen) + 1


def test_a_slow_reader_gets_the_newest_frame(start) -> None:
    rig = start(False)
    source = OakSource(rig.reader, False, None, lambda: None)
    first = source[0].timestamp_s
    rig.wait_for_frames(20)
    assert source[1].timestamp_s - first > 10 / FPS
    assert source.missed > 5
    assert source[2].world_from_camera is None


def test_frames_whose_pose_was_lost_are_left_out(start) -> None:
    reader = start(True, lost=range(3, 60)).reader
    numbers = [round((reader.read(i)[0].timestamp_s - 50) * FPS) for i in range(2)]
    while numbers[-1] < 60:
        numbers.append(round((reader.read(0)[0].timestamp_s - 50) * FPS))
    assert not set(numbers) & set(range(5, 58))


def test_a_camera_that_goes_is_told(start) -> None:
    reader = start(False, last=3).reader
    read_to_the_end = (reader.read(index) for index in range(5))
    with pytest.raises(SourceError, match="the camera has gone"):
        list(read_to_the_end)


def test_without_a_camera_one_line_says_what_else_there_is(capfd) -> None:
    if dai.Device.getAllAvailableDevices():
        pytest.skip(f"{NO_HARDWARE}an OAK camera is connected")
    with pytest.raises(SourceError, match=r"no OAK camera.*synthetic:table"):
        open_oak()
    assert capfd.readouterr() == ("", "")


def fake_device(platform: object, dots: list[str]) -> MagicMock:
    device = create_autospec(dai.Device, instance=True)
    device.getPlatform.return_value, device.getIrDrivers.return_value = platform, dots
    return device


def fake_pipeline() -> tuple[MagicMock, dict[str, list[MagicMock]]]:
    """A pipeline that makes nodes with the names that depthai's have, and no others."""
    made: dict[str, list[MagicMock]] = {}

    def create(kind: type) -> MagicMock:
        node = create_autospec(kind, instance=True)
        made.setdefault(kind.__name__, []).append(node)
        if kind is dai.node.Camera:
            node.build.return_value = node
        return node

    pipeline = create_autospec(dai.Pipeline, instance=True)
    pipeline.create.side_effect = create
    return pipeline, made


def test_the_cameras_nodes_are_asked_for_what_a_room_needs() -> None:
    pipeline, made = fake_pipeline()
    device = fake_device(dai.Platform.RVC2, ["dots"])
    outputs = build_nodes(pipeline, device, (640, 480), FPS, with_pose=True)
    color, left, right = (node.requestOutput.return_value for node in made["Camera"])
    (stereo,), (odometry,), (inertia,) = made["StereoDepth"], made["BasaltVIO"], made["IMU"]
    stereo.setLeftRightCheck.assert_called_once_with(True)
    stereo.setSubpixel.assert_called_once_with(True)
    stereo.initialConfig.setMedianFilter.assert_called_once()
    stereo.initialConfig.setConfidenceThreshold.assert_called_once()
    left.link.assert_any_call(stereo.left)
    right.link.assert_any_call(stereo.right)
    color.link.assert_called_once_with(stereo.inputAlignTo)
    left.link.assert_any_call(odometry.left)
    inertia.out.link.assert_called_once_with(odometry.imu)
    assert outputs == Outputs(color, stereo.depth, odometry.transform, odometry.passthrough)
    device.setIrLaserDotProjectorIntensity.assert_not_called()


def test_without_odometry_the_dots_are_on_and_other_cameras_align_apart() -> None:
    pipeline, made = fake_pipeline()
    device = fake_device(dai.Platform.RVC4, ["dots"])
    outputs = build_nodes(pipeline, device, (640, 480), FPS, with_pose=False)
    (align,) = made["ImageAlign"]
    assert outputs.depth is align.outputAligned
    assert outputs.pose is None
    assert "BasaltVIO" not in made
    device.setIrLaserDotProjectorIntensity.assert_called_once()


def test_odometry_needs_a_sensor_of_inertia() -> None:
    device = create_autospec(dai.Device, instance=True)
    for name, has in (("BNO086", True), ("NONE", False), ("", False)):
        device.getConnectedIMU.return_value = name
        assert has_odometry(device) is has


def test_extrinsics_come_from_the_calibration_in_metres() -> None:
    calibration = dai.CalibrationHandler()
    color, left = dai.CameraBoardSocket.CAM_A, dai.CameraBoardSocket.CAM_B
    for socket in (color, left):
        calibration.setCameraIntrinsics(socket, LENS.tolist(), 64, 48)
    eye = np.eye(3).tolist()
    calibration.setCameraExtrinsics(color, left, eye, [-3.75, 0.0, 0.0], [-3.75, 0.0, 0.0])
    np.testing.assert_allclose(left_from_color(calibration), LEFT_FROM_COLOR, atol=1e-6)
