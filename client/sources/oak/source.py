"""An OAK-D camera as a source: live, without an end. depthai is an extra, loaded only here.

`oak` takes poses from the camera's visual-inertial odometry where it has the sensor; `oak?vio=off` leaves tracking to
the server and the projector of dots on, where there is one.
"""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable
from typing import Protocol

from client.errors import SourceError
from client.sources.frame_source import ENDLESS
from protocol.frames import CameraModel, RgbdFrame

SIZE = (640, 480)
FPS = 30.0
INSTEAD = "stream a data-set folder, a recording or synthetic:table instead"


class Reader(Protocol):
    """What `oak_frames.FrameReader` does."""

    missed: int

    def read(self, index: int) -> tuple[RgbdFrame, CameraModel]: ...


class OakSource:
    """An OAK camera as a `Source`. Every index returns the newest unread frame, numbered with that index."""

    name = "oak"
    fps = FPS

    def __init__(
        self, reader: Reader, has_poses: bool, up: tuple[float, float, float] | None, close: Callable[[], None]
    ) -> None:
        """`reader` is of a running pipeline, which `close` ends, at the program's end at the latest."""
        self._reader = reader
        self.has_poses, self.up = has_poses, up
        self._close = weakref.finalize(self, close)
        try:
            _, self.camera = reader.read(0)
        except SourceError:
            self._close()
            raise

    @property
    def missed(self) -> int:
        """Frames that the camera took and nobody asked for in time."""
        return self._reader.missed

    def __len__(self) -> int:
        return ENDLESS

    def __getitem__(self, index: int) -> RgbdFrame:
        frame, _ = self._reader.read(index)
        return frame

    def close(self) -> None:
        """Give the camera back."""
        self._close()


def open_oak(options: str = "") -> OakSource:
    """The first camera that is connected. `options`: `vio=off` or nothing.

    Raises SourceError, one line, without depthai, without a camera, and for other options.
    """
    if options not in ("", "vio=on", "vio=off"):
        raise SourceError(f"oak?{options}: there is only oak?vio=off, which leaves tracking to the server")
    # Before it is loaded: it would send usage to its maker, calibrate anew in use, and warn where there is no USB.
    for name, value in (("DEPTHAI_TELEMETRY", "0"), ("DEPTHAI_AUTOCALIBRATION", "OFF"), ("DEPTHAI_LEVEL", "error")):
        os.environ.setdefault(name, value)
    try:
        import depthai as dai
    except ImportError as error:
        raise SourceError(
            f"oak: depthai, which reads OAK cameras, is not installed: make install-oak installs it; or {INSTEAD}"
        ) from error
    found = dai.Device.getAllAvailableDevices()  # opening one that is not there looks for it for 10 s
    if not found:
        raise SourceError(f"oak: no OAK camera is connected; plug one in, or {INSTEAD}")
    try:
        device = dai.Device(found[0])
    except RuntimeError as error:
        raise SourceError(f"oak: the OAK camera cannot be opened ({error}); plug it in again, or {INSTEAD}") from error
    return _start(device, options != "vio=off")


def _start(device: object, wants_pose: bool) -> OakSource:
    import depthai as dai

    from client.sources.oak.frames import FrameReader
    from client.sources.oak.nodes import build_nodes, has_odometry, left_from_color
    from client.sources.oak.poses import UP

    assert isinstance(device, dai.Device)
    with_pose = wants_pose and has_odometry(device)
    try:
        pipeline = dai.Pipeline(device)
        outputs = build_nodes(pipeline, device, SIZE, FPS, with_pose)
        reader = FrameReader(pipeline, outputs, FPS, left_from_color(device.readCalibration()))
        pipeline.start()
    except RuntimeError as error:
        raise SourceError(f"oak: the camera {device.getDeviceName()} cannot do it: {error}") from error
    return OakSource(reader, with_pose, UP if with_pose else None, reader.close)
