"""This program, through the geometry half of its own spine, its stages timed as whole calls.

Integrate is the spine's row "reconstruct": bricks found, given memory, integrated, their table for rays brought up to
date. Ray cast is its row "surface": positions and normals.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Wishes
from server.geometry.geometry import Geometry, GeometryFrame
from server.input.denoise import bilateral_depth
from server.input.measure import Measurement
from server.opencl.device import open_device
from server.opencl.engine import Engine
from server.opencl.profile import Profile
from server.tracking import camera_tracking as tracking
from server.tracking.camera_tracking import CameraTracking, PoseEstimate
from server.volume.raycast import Surface
from server.volume.volume import Volume
from tests.bench.geometry.surface import model_depth
from tests.bench.peers.contestant import FILTER, INTEGRATE, RAYCAST, TRACK, Scene, Turn
from tests.bench.peers.worker import device_name

Floats = NDArray[np.float64]
ROWS = {"reconstruct": INTEGRATE, "surface": RAYCAST}


class WholeStages(Profile):
    """Clocks each stage from an idle device to an idle device, into the turn that is being played."""

    def __init__(self, engine: Engine) -> None:
        super().__init__()
        self._engine = engine
        self.turn = Turn()

    @contextmanager
    def stage(self, row: str) -> Iterator[None]:
        self._engine.queue.finish()
        with self.turn.clock(ROWS.get(row, row)), super().stage(row):
            yield
            self._engine.queue.finish()


class GivenPoses:
    """Fuse and predict at the poses given, on the processor."""

    def __init__(self, scene: Scene, kind: str = "CPU") -> None:
        self.engine = Engine(open_device(device_name(kind)))
        self._stages = WholeStages(self.engine)
        self.engine.profile = self._stages
        self.geometry = Geometry(self.engine, scene.camera, Wishes(volume_m=scene.bounds_m, voxel_m=scene.voxel_m))
        self._shown: GeometryFrame | None = None

    def process(self, frame: RgbdFrame, turn: Turn) -> None:
        self._stages.turn = turn
        self._stages.begin()
        self._shown = self.geometry.scan(frame)

    def depth(self, frame: RgbdFrame) -> NDArray[np.float32]:  # noqa: ARG002
        """Of the frame that was processed last: it must be this one."""
        assert self._shown is not None
        return model_depth(self.engine, self._shown)


class Tracking:
    """Follow the camera by depth alone, on the processor: pyramids, the model's view, all iterations.

    The bilateral filter before it is an action of its own, as nobody else's tracking has one.
    """

    def __init__(self, scene: Scene) -> None:
        self._engine = Engine(open_device(device_name("CPU")))
        wishes = Wishes(volume_m=scene.bounds_m, voxel_m=scene.voxel_m, poses="track")
        self._geometry = Geometry(self._engine, scene.camera, wishes)
        self._tracking = ClockedTracking(self._engine, scene.camera)
        self._geometry._tracking = self._tracking

    def process(self, frame: RgbdFrame, turn: Turn) -> None:
        self._tracking.turn = turn
        self._engine.profile.begin()
        result = self._geometry.scan(frame)
        if result.tracking == "lost":
            raise RuntimeError(f"frame {frame.index}: {'; '.join(result.notes)}")
        turn.world_from_camera = result.world_from_camera

    def depth(self, frame: RgbdFrame) -> None:  # noqa: ARG002
        return None


class ClockedTracking(CameraTracking):
    """The spine's tracking, its two calls clocked as one action."""

    def __init__(self, engine: Engine, camera: CameraModel) -> None:
        super().__init__(engine, camera, "track")
        self._finish = engine.queue.finish
        self.turn = Turn()
        tracking.bilateral_depth = self._filter  # type: ignore[assignment]

    def locate(self, frame: RgbdFrame, measurement: Measurement, volume: Volume) -> PoseEstimate:
        with self._clock():
            return super().locate(frame, measurement, volume)

    def remember(self, frame: RgbdFrame, located: PoseEstimate, model: Surface, volume_from_camera: Floats) -> None:
        with self._clock():
            super().remember(frame, located, model, volume_from_camera)

    def _filter(self, engine: Engine, depth_m: cl_array.Array) -> cl_array.Array:
        with self.turn.clock(FILTER), self.turn.without(TRACK):
            result = bilateral_depth(engine, depth_m)
            self._finish()
        return result

    @contextmanager
    def _clock(self) -> Iterator[None]:
        self._finish()
        with self.turn.clock(TRACK):
            yield
            self._finish()


class OnGpu(GivenPoses):
    """The same on a GPU."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene, "GPU")
