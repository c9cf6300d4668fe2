"""The OAK source without a camera and without depthai: poses, a source without end, what is said of what is missing."""

from __future__ import annotations

import importlib.util
import os
import signal
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from client.commands.run import Run
from client.commands.stopping import stop_on_interrupt
from client.errors import SourceError
from client.options.capture import prepare
from client.options.capture_options import CaptureOptions
from client.options.source import open_source
from client.sources.frame_source import ENDLESS, is_live
from client.sources.oak.poses import FLU_FROM_CAMERA, UP, PoseTrail, world_from_lens
from client.sources.oak.source import OakSource
from protocol.frames import CameraModel, RgbdFrame
from tests.client.lights import light_of

CAMERA = CameraModel(width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=23.5)


class FakeReader:
    """Plays a wall 1.5 m away; every second picture is missed."""

    def __init__(self) -> None:
        self.missed, self.indices = 0, []

    def read(self, index: int) -> tuple[RgbdFrame, CameraModel]:
        self.missed += 1
        self.indices.append(index)
        color = np.full((48, 64, 3), 128, np.uint8)
        depth = np.full((48, 64), 1500, np.uint16)
        return RgbdFrame(index, 100 + 0.1 * index, color, depth, np.eye(4), 0.01), CAMERA


@pytest.fixture
def oak() -> OakSource:
    return OakSource(FakeReader(), True, UP, lambda: None)


def test_the_odometrys_axes_become_the_cameras() -> None:
    turned = Rotation.from_rotvec([0.0, 0.0, np.pi / 2])  # about its z, up: to the left
    pose = world_from_lens((1.0, 2.0, 3.0), tuple(turned.as_quat()))
    np.testing.assert_allclose(pose[:3, 3], [-2.0, -3.0, 1.0], atol=1e-12)  # forward z, left -x, up -y
    np.testing.assert_allclose(pose[:3, 2], [-1.0, 0.0, 0.0], atol=1e-12)  # it looks to the left
    np.testing.assert_allclose(pose[:3, 1], [0.0, 1.0, 0.0], atol=1e-12)
    assert np.linalg.det(FLU_FROM_CAMERA) == pytest.approx(1.0)
    np.testing.assert_allclose(FLU_FROM_CAMERA[:3, :3] @ UP, [0, 0, 1])


def turned_by(degrees: float, x_m: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    pose[0, 3] = x_m
    return pose


def test_a_pose_between_two_times_lies_between() -> None:
    trail = PoseTrail(gap_s=0.1)
    trail.add(1.0, turned_by(0, 0))
    trail.add(1.04, turned_by(8, 0.4))
    np.testing.assert_allclose(trail.at(1.01, 0), turned_by(2, 0.1), atol=1e-12)
    np.testing.assert_allclose(trail.at(1.04, 0), turned_by(8, 0.4), atol=1e-12)


def test_a_time_without_a_pose_near_has_none() -> None:
    trail = PoseTrail(gap_s=0.1)
    assert trail.at(1.0, 0) is None
    trail.add(1.0, turned_by(0, 0))
    trail.add(0.9, turned_by(50, 0))  # too late to be of use
    assert trail.at(1.06, 0) is None
    assert trail.at(0.9, 0) is None
    np.testing.assert_array_equal(trail.at(1.04, 0), turned_by(0, 0))
    trail.add(2.0, turned_by(0, 0))
    assert trail.at(1.5, 0) is None


def test_a_pose_that_lags_is_waited_for() -> None:
    trail = PoseTrail(gap_s=0.1)
    later = threading.Timer(0.05, trail.add, (1.0, turned_by(3, 1)))
    later.start()
    np.testing.assert_array_equal(trail.at(1.0, 20), turned_by(3, 1))


def test_a_camera_has_no_end_and_gives_its_newest(oak: OakSource) -> None:
    assert (len(oak), is_live(oak)) == (ENDLESS, True)
    assert (oak[7].index, oak[8].index) == (7, 8)
    assert oak.missed == 3
    assert oak.camera is CAMERA
    assert not is_live(open_source("synthetic:table?frames=3"))


def test_a_camera_that_sends_nothing_is_given_back() -> None:
    class Dead(FakeReader):
        def read(self, _index: int) -> tuple[RgbdFrame, CameraModel]:
            raise SourceError("oak: the camera has gone")

    closed: list[bool] = []
    with pytest.raises(SourceError, match="has gone"):
        OakSource(Dead(), False, None, lambda: closed.append(True))
    assert closed == [True]


def test_a_live_capture_is_prepared_from_its_first_frame(oak: OakSource, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("client.sources.oak.source.open_oak", lambda options: oak if options == "vio=off" else None)
    capture = prepare(CaptureOptions("oak?vio=off"))
    assert (capture.total, capture.wishes.poses, capture.wishes.up) == (None, "given", UP)
    x0, _, z0, x1, _, z1 = capture.wishes.volume_m
    assert x1 - x0 > 3  # the wall is 1.6 m wide: room to move
    assert z0 < 0.5
    assert z1 > 1.5
    assert prepare(CaptureOptions("oak?vio=off", frames="0:5")).total == 5
    assert oak._reader.indices == [0, 0, 0]


def test_run_of_a_camera_ends_at_ctrl_c(oak: OakSource, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("client.sources.oak.source.open_oak", lambda _options: oak)
    given: list[int] = []

    def outputs(_pipeline: object, frames: object, _camera: object) -> object:
        for frame in frames:
            given.append(frame.index)
            if frame.index == 2:
                os.kill(os.getpid(), signal.SIGINT)
            yield SimpleNamespace(
                notes=(),
                light=light_of(frame.index),
                world_from_camera=np.eye(4),
                tracking="given",
                timestamp_s=frame.timestamp_s,
            )

    monkeypatch.setattr("client.commands.run.process_frames", outputs)
    run = Run.__new__(Run)
    run._capture, run._pipeline, run._path = prepare(CaptureOptions("oak")), None, []
    assert len(list(run.outputs())) == 3
    assert given == [0, 1, 2]


def test_the_second_ctrl_c_interrupts() -> None:
    before = signal.getsignal(signal.SIGINT)
    with stop_on_interrupt() as stopping:
        os.kill(os.getpid(), signal.SIGINT)
        assert stopping.wait(5)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before
    with stop_on_interrupt(enabled=False):
        assert signal.getsignal(signal.SIGINT) is before


def test_without_depthai_the_source_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "depthai", None)
    with pytest.raises(SourceError, match=r"depthai.*make install-oak.*synthetic:table") as told:
        open_source("oak")
    assert "\n" not in str(told.value)
    assert "install-oak:" in (Path(__file__).parents[2] / "Makefile").read_text()


def test_an_unknown_option_of_the_camera_is_refused() -> None:
    with pytest.raises(SourceError, match=r"oak\?fps=5.*vio=off"):
        open_source("oak?fps=5")


def test_oak_modules_do_not_load_depthai() -> None:
    assert importlib.util.find_spec("depthai") is None or "depthai" not in vars(
        sys.modules["client.sources.oak.source"]
    )
