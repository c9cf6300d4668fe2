"""Doubles for the service's tests: a pipeline of plain NumPy that can be held, slowed or made to fail."""

from __future__ import annotations

import queue
import threading
import time
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.images import encode_color, encode_depth
from protocol.messages import Frame, LeftOut, Light, PlacedObject, Plan, Timings, Wishes
from server.meshing.scene_mesh import SceneMesh
from server.meshing.surface import MeshingError
from server.shading.layer import Layer, LayerPart

if TYPE_CHECKING:
    from server.client_session import FrameTurn  # loads OpenCL, which a fake does not need

PATIENCE_S = 60.0
SLICE_S = 0.02
"""Time between the slices of a held frame."""
CAMERA = CameraModel(width=48, height=32, fx=40.0, fy=41.0, cx=23.5, cy=15.5)
POSE = np.array([[0, -1, 0, 0.125], [1, 0, 0, 0.1], [0, 0, 1, -2.5], [0, 0, 0, 1]], np.float64)

REFUSE_MM, EXPLODE_MM = 111, 222
"""Depths in the first pixel that make the fake refuse a frame or fail."""


@dataclass(frozen=True)
class FakeResult:
    """Has the fields of `server.pipeline.FrameResult`."""

    color: np.ndarray | None
    light: Light
    world_from_camera: np.ndarray
    tracking: str
    timings: Timings
    plan: Plan
    notes: tuple[str, ...]
    layer: Layer | None = None
    placed: tuple[PlacedObject, ...] = ()


@dataclass
class Lab:
    """What the test and all fake pipelines of one service share."""

    hold: bool = False
    """Each `process` waits for one `release`."""
    slices: bool = False
    """While it waits, it lets others use the device as frames do that take long."""
    entered: queue.Queue = field(default_factory=queue.Queue)
    """The index of each frame as its processing begins."""
    released: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))
    predicted_s: dict[str, float] = field(default_factory=dict)
    """What a frame takes at a preset; 0 at others."""
    log: list = field(default_factory=list)
    """Everything asked of the pipelines, in order."""
    mesh: SceneMesh | None = None
    """What the pipelines say they have fused; None: nothing."""
    panorama: bytes | None = None
    """The file that the pipelines make of their light; None: they know none."""
    closed: threading.Event = field(default_factory=threading.Event)
    threads: set = field(default_factory=set)

    def build(self, _device: object, _camera: CameraModel, wishes: Wishes, *_room: object) -> FakePipeline:
        """The `pipeline_factory` of a service under test."""
        self.threads.add(threading.current_thread().name)
        if wishes.preset == "auto":
            raise ValueError("preset auto is not for this fake: choose reg4")
        return FakePipeline(self, wishes.answer)

    def next_entered(self) -> int:
        """Wait until a pipeline begins a frame; its index."""
        return self.entered.get(timeout=PATIENCE_S)

    def release(self, count: int = 1) -> None:
        """Let held pipelines finish `count` frames."""
        self.released.release(count)


class FakePipeline:
    """The pipeline's interface; the picture it makes is the input's negative."""

    device_name = "a fake device"

    def __init__(self, lab: Lab, answer: str = "picture") -> None:
        self.lab = lab
        self.answer = answer
        self.objects: set[str] = set()

    def place_object(self, object_id: str, mesh: object, placement: object) -> tuple[str, ...]:
        self.lab.log.append(("place", object_id, mesh, placement))
        self.objects.add(object_id)
        return (f"{object_id} has no texture",)

    def move_object(self, object_id: str, placement: object) -> None:
        self.lab.log.append(("move", object_id, placement))
        if object_id not in self.objects:
            raise KeyError(object_id)

    def remove_object(self, object_id: str) -> None:
        self.lab.log.append(("remove", object_id))
        self.objects.remove(object_id)

    def set_quality(self, preset: str, budget_ms: float | None, max_light_error_deg: float | None) -> None:
        self.lab.log.append(("preset", preset, budget_ms, max_light_error_deg))

    def predicted_s(self, preset: str) -> float:
        return self.lab.predicted_s.get(preset, 0.0)

    def scene_mesh(self) -> SceneMesh:
        self.lab.log.append(("mesh",))
        if self.lab.mesh is None:
            raise MeshingError("there is no surface to mesh: no frame has been fused yet")
        return self.lab.mesh

    def panorama(
        self,
        format_: str,
        position_m: tuple[float, float, float] | None = None,
        device: AbstractContextManager[object] = nullcontext(),  # noqa: B008 (it has no state)
    ) -> tuple[bytes, tuple[float, float, float]]:
        with device:
            self.lab.log.append(("panorama", format_, position_m))
        if self.lab.panorama is None:
            raise ValueError("there is no light yet: no frame has been placed in the room")
        return self.lab.panorama, position_m or (1.0, 2.0, 3.0)

    def process(self, frame: RgbdFrame, *, watched: bool = False, turn: FrameTurn | None = None) -> FakeResult:
        self.lab.log.append(("frame", frame.index))
        self.lab.entered.put(frame.index)
        if self.lab.hold:
            self._work_until_released(turn)
        if frame.depth[0, 0] == REFUSE_MM:
            raise ValueError("no depth in this frame: point the camera at something")
        if frame.depth[0, 0] == EXPLODE_MM:
            raise RuntimeError("secret internals")
        result = fake_result(frame)
        color = result.color if watched or self.answer == "picture" else None
        return replace(result, color=color, layer=fake_layer(frame) if self.answer == "layer" else None)

    def _work_until_released(self, turn: FrameTurn | None) -> None:
        """A frame that takes long; in slices, if the lab says so."""
        end_s = time.monotonic() + PATIENCE_S
        while not self.lab.released.acquire(timeout=SLICE_S):
            if time.monotonic() > end_s:
                raise RuntimeError("the test never released this frame")
            if self.lab.slices and turn is not None and turn.is_due():
                turn.give_way(may_end=True)

    def close(self) -> None:
        self.lab.closed.set()


def fake_result(frame: RgbdFrame) -> FakeResult:
    """What the fake makes of a frame: exact numbers that JPEG or float32 would not survive."""
    pose = np.eye(4) if frame.world_from_camera is None else frame.world_from_camera
    return FakeResult(
        color=255 - frame.color,
        light=fake_light(frame),
        world_from_camera=pose,
        tracking="given",
        timings=Timings(input=1.5, rendering=3.25, total=7.0),
        plan=Plan(run=("composite",), left_out=(LeftOut(effect="shadow", reason="no object", error_bound=0.0),)),
        notes=("one note",),
    )


def fake_layer(frame: RgbdFrame) -> Layer:
    """Some virtual pixels, of no two frames the same; no real ones that change."""
    random = np.random.default_rng(1000 + frame.index)
    color = random.integers(0, 256, (5, 7, 4), np.uint8)
    return Layer(virtual=LayerPart(3, 2, color, random.integers(1, 5000, (5, 7), np.uint16)))


def fake_light(frame: RgbdFrame) -> Light:
    return Light(
        frame=frame.index,
        timestamp_s=frame.timestamp_s,
        sh=((float(frame.depth.sum()) / 3.0, 0.1, 1e-17),) * 16,
        sh_std=((None, None, None),) * 16,
        sh_webxr=(1 / 3,) * 27,
        dominant_direction=(0.0, 1.0, 0.0),
        dominant_intensity=2 / 7,
        condition=None,
        valid=True,
    )


def rgbd_frame(index: int, first_depth_mm: int = 1000, camera: CameraModel = CAMERA) -> RgbdFrame:
    """A frame of noise, different for every index."""
    random = np.random.default_rng(index)
    depth = random.integers(0, 5000, (camera.height, camera.width), np.uint16)
    depth[0, 0] = first_depth_mm
    color = random.integers(0, 256, (camera.height, camera.width, 3), np.uint8)
    return RgbdFrame(index=index, timestamp_s=index / 30, color=color, depth=depth, world_from_camera=POSE)


def frame_message(index: int, first_depth_mm: int = 1000) -> Frame:
    """The same frame as a client sends it, losslessly."""
    frame = rgbd_frame(index, first_depth_mm)
    return Frame(
        frame=index,
        timestamp_s=frame.timestamp_s,
        world_from_camera=tuple(POSE.ravel().tolist()),
        color=encode_color(frame.color, "raw"),
        depth=encode_depth(frame.depth),
    )


def terrain(side: int) -> SceneMesh:
    """A mesh of `side` x `side` vertices, different in every byte that is sent."""
    random = np.random.default_rng(side)
    corner = np.arange(side * (side - 1)).reshape(side - 1, side)[:, :-1].ravel()
    return SceneMesh(
        vertices=random.normal(size=(side * side, 3)).astype(np.float32),
        triangles=np.stack([corner, corner + 1, corner + side], axis=1).astype(np.int32),
        normals=np.tile(np.float32([0, 0, 1]), (side * side, 1)),
        colors=random.integers(0, 256, (side * side, 3), np.uint8),
        gltf_from_world=np.diag([1.0, -1.0, -1.0]),
    )


FAKE_DEVICE = SimpleNamespace(
    name="a fake device",
    memory=SimpleNamespace(bytes_held=4096),
    compile_beside=lambda: None,
    end_children=lambda: None,
)


class FakeMesh(NamedTuple):
    """What was to be read; a cube of one metre."""

    format: str
    data: bytes

    @property
    def bounds(self) -> NDArray[np.float64]:
        """As of a Mesh."""
        return np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])

    @property
    def up_axis(self) -> str:
        """As of a Mesh."""
        return "y"


def fake_mesh(data: bytes, format_: str) -> FakeMesh:
    """The `mesh_loader` of a service under test."""
    if data == b"no mesh":
        raise ValueError("the object is no GLB: its first bytes are not glTF")
    return FakeMesh(format_, data)
