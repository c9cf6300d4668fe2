"""An OAK-D camera as a live source. depthai is an optional package, imported only on use.

`oak` takes poses from the camera's visual-inertial odometry, if the camera has an IMU. `oak?vio=off` leaves tracking to
the server and switches the infrared dot projector on, if there is one.
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
    """Interface of `frames.FrameReader`."""

    missed: int

    def read(self, index: int) -> tuple[RgbdFrame, CameraModel]: ...


class OakSource:
    """An OAK camera as a `Source`. Every index returns the newest unread frame, numbered with that index."""

    name = "oak"
    fps = FPS

    def __init__(
        self, reader: Reader, has_poses: bool, up: tuple[float, float, float] | None, close: Callable[[], None]
    ) -> None:
        """`reader` reads a running pipeline; `close` ends it, at exit at the latest."""
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
        """Number of camera frames that were not read in time."""
        return self._reader.missed

    def __len__(self) -> int:
        return ENDLESS

    def __getitem__(self, index: int) -> RgbdFrame:
        frame, _ = self._reader.read(index)
        return frame

    def close(self) -> None:
        """Release the camera."""
        self._close()


def open_oak(options: str = "") -> OakSource:
    """The first connected camera. `options`: empty, `vio=on` or `vio=off`.

    Raises SourceError without depthai, without a camera, and for other options.
    """
    if options not in ("", "vio=on", "vio=off"):
        raise SourceError(f"oak?{options}: there is only oak?vio=off, which leaves tracking to the server")
    # Set before the import: no telemetry, no recalibration while in use, no warnings without USB.
    for name, value in (("DEPTHAI_TELEMETRY", "0"), ("DEPTHAI_AUTOCALIBRATION", "OFF"), ("DEPTHAI_LEVEL", "error")):
        os.environ.setdefault(name, value)
    try:
        import depthai as dai
    except ImportError as error:
        raise SourceError(
            f"oak: depthai, which reads OAK cameras, is not installed: make install-oak installs it; or {INSTEAD}"
        ) from error
    found = dai.Device.getAllAvailableDevices()  # opening an absent one would block for 10 s
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
