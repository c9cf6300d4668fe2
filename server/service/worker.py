"""The thread behind one capturing session: it owns the pipeline, decodes frames, encodes answers. No asyncio here."""

from __future__ import annotations

import contextlib
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from msgspec import structs

from protocol.codec import ProtocolError, encode, one_line
from protocol.colors import ColorReader
from protocol.frames import CameraModel, RgbdFrame, Viewpoint
from protocol.images import decode_depth
from protocol.messages import (
    Acknowledged,
    Composite,
    Dropped,
    Frame,
    Hello,
    Layer,
    MoveObject,
    PlaceObject,
    Plan,
    Quality,
    RemoveObject,
    RequestMesh,
)
from server.meshing.files import mesh_files
from server.scene.mesh import Mesh
from server.scene.placement import Placement
from server.service.answers import composite_message, layer_message
from server.service.connection import POLICY, UNAUTHORIZED, Refusal
from server.service.mailbox import Letter, Mailbox
from server.service.mesh_message import mesh_parts
from server.service.metrics import Metrics
from server.service.pressure import Pressure
from server.service.pressure import Quality as Asked
from server.service.rooms import RoomLocked
from server.service.scheduler import Scheduler

if TYPE_CHECKING:
    from server.client_session import ClientSession
    from server.pipeline import FrameResult

KEPT_ACKNOWLEDGEMENTS = 256
KEPT_ANSWERS = 4
"""More than a client may have unanswered (session.MAX_INFLIGHT)."""

SceneControl = PlaceObject | MoveObject | RemoveObject | Quality


class Outlet(Protocol):
    """Where a worker's answers go; the session's side of it hands them to the event loop."""

    def greet(self, device_name: str) -> None:
        """Welcome the client: its pipeline is built. Raises ClientGone."""

    def send(self, data: bytes) -> None:
        """Send to the capturing client, returning when the socket has taken it. Raises ClientGone."""

    @property
    def waited_s(self) -> float:
        """For how long, in all, the socket was waited for."""

    def is_watched(self) -> bool:
        """Whether anybody wants what `publish` is given."""

    def publish(self, messages: tuple[bytes, ...]) -> None:
        """Give watchers a frame's light and composite; returns at once."""


@dataclass(frozen=True)
class Workshop:
    """What every worker of a service shares."""

    opened_pipeline: Callable[[Hello], AbstractContextManager[ClientSession]]
    """The pipeline of a client, as long as it is there. Raises ValueError for wishes that cannot be met."""
    load_mesh: Callable[[bytes, str], Mesh]
    metrics: Metrics
    scheduler: Scheduler
    wanted_period_s: float = 0.25
    """Between two frames of sessions that share the device: when it is longer, they sample more cheaply."""
    color_reader: Callable[[CameraModel], ColorReader] = ColorReader
    keep_room: Callable[[str], None] = lambda _name: None
    """Save a room, before its objects' coming or going is acknowledged: a server that is killed loses none."""
    keep_moves: Callable[[str], None] = lambda _name: None
    """Likewise where its objects have been moved to, which takes less."""


class Worker:
    """Runs one session's frames and control messages, in the order of its mailbox."""

    def __init__(self, workshop: Workshop, hello: Hello, mailbox: Mailbox, outlet: Outlet) -> None:
        self._workshop = workshop
        self._hello = hello
        self._mailbox = mailbox
        self._outlet = outlet
        self._share = workshop.scheduler.join(hello.room)
        self._colors = workshop.color_reader(hello.camera)
        self._arrived_s = self._waited_ms = 0.0
        """Of the newest frame: when it came, and for how long it then waited."""
        self._pressure = Pressure(hello.wishes, workshop.wanted_period_s)
        self._acknowledged: OrderedDict[int, bytes] = OrderedDict()
        """Requests that were done: a client that lost its connection may send them again."""
        self._answers: deque[tuple[int, tuple[bytes, ...]]] = deque(maxlen=KEPT_ANSWERS)
        """Of lossless sessions: their last frames, by number."""

    def run(self) -> None:
        """Build the pipeline, welcome the client, and work until the mailbox closes.

        Raises Refusal if the client's wishes cannot be met, ClientGone if it left, anything else for a fault of ours.
        """
        try:
            with contextlib.ExitStack() as stack:
                try:
                    pipeline = stack.enter_context(self._workshop.opened_pipeline(self._hello))
                except RoomLocked as error:
                    raise Refusal(UNAUTHORIZED, str(error)) from error
                except ValueError as error:
                    raise Refusal(POLICY, str(error)) from error
                self._outlet.greet(pipeline.device_name)
                while (letter := self._mailbox.take()) is not None:
                    self._handle(pipeline, letter)
        finally:
            self._workshop.scheduler.leave(self._share)
            self._colors.close()

    def _handle(self, pipeline: ClientSession, letter: Letter) -> None:
        if isinstance(letter.message, Frame):
            self._arrived_s = letter.arrived_s
            self._workshop.metrics.queue_age_ms.observe(letter.age_ms)
            self._answer_frame(pipeline, letter.message)
        elif isinstance(letter.message, RequestMesh):
            self._send_mesh(pipeline, letter.message.request)
        elif isinstance(letter.message, MoveObject):
            self._answer_moves(pipeline, [letter.message, *self._mailbox.take_more(MoveObject)])
        else:
            self._outlet.send(self._done(pipeline, letter.message))

    def _answer_moves(self, pipeline: ClientSession, moves: list[MoveObject]) -> None:
        """Moves that waited one behind the other: kept together, then acknowledged."""
        answers = [self._done(pipeline, move) for move in moves]
        if self._hello.room is not None:
            self._workshop.keep_moves(self._hello.room)
        for answer in answers:
            self._outlet.send(answer)

    def _done(self, pipeline: ClientSession, message: SceneControl) -> bytes:
        """Its acknowledgement; it is done once, however often it is sent."""
        done = self._acknowledged.get(message.request)
        if done is None:
            acknowledged = apply_control(pipeline, message, self._workshop.load_mesh)
            room = self._hello.room
            if room is not None and acknowledged.error is None and isinstance(message, PlaceObject | RemoveObject):
                self._workshop.keep_room(room)
            if isinstance(message, Quality) and acknowledged.error is None:
                self._pressure.ask(Asked(message.preset, message.budget_ms, message.max_light_error_deg))
            done = self._acknowledged[message.request] = encode(acknowledged)
            if len(self._acknowledged) > KEPT_ACKNOWLEDGEMENTS:
                self._acknowledged.popitem(last=False)
        return done

    def _answer_frame(self, pipeline: ClientSession, frame: Frame) -> None:
        known = next((answer for number, answer in self._answers if number == frame.frame), None)
        if known is not None:
            return self._send_answer(known)
        overhead = _Overhead(self._outlet)
        try:
            rgbd = self._decode(frame)
        except ProtocolError as error:
            return self._drop(frame, "unreadable", error)
        try:
            with overhead.left_out(), self._workshop.scheduler.turn(self._share) as waited_s:
                self._waited_ms = (time.perf_counter() - self._arrived_s) * 1e3
                result = pipeline.process(rgbd, watched=self._outlet.is_watched())
                self._follow_pressure(pipeline)
        except ValueError as error:
            return self._drop(frame, "refused", error)
        self._workshop.metrics.turn_ms.observe(waited_s * 1e3)
        self._workshop.metrics.observe_stages(result.timings)
        self._workshop.metrics.processed.inc()
        self._deliver(frame, result)
        return overhead.tell(self._workshop.metrics)

    def _follow_pressure(self, pipeline: ClientSession) -> None:
        """Sample more cheaply where too many share the device, and as asked for again when they are fewer."""
        scheduler, pressure = self._workshop.scheduler, self._pressure
        if pressure.observe(scheduler.busy, scheduler.period_s):
            with contextlib.suppress(ValueError):  # what cannot be chosen on this device is not: it stays as it is
                pipeline.set_quality(*pressure.quality)

    def _send_mesh(self, pipeline: ClientSession, request: int) -> None:
        try:
            parts = mesh_parts(request, mesh_files(pipeline.scene_mesh()))
        except ValueError as error:  # MeshingError is one
            return self._outlet.send(encode(Acknowledged(request=request, error=one_line(str(error)))))
        for part in parts:
            self._outlet.send(encode(part))
        return self._outlet.send(encode(Acknowledged(request=request)))

    def _decode(self, frame: Frame) -> RgbdFrame | Viewpoint:
        start_s = time.perf_counter()
        camera, lens = self._hello.camera, self._hello.camera.depth_lens
        pose = None if frame.world_from_camera is None else np.array(frame.world_from_camera, np.float64).reshape(4, 4)
        if frame.color is None:
            assert pose is not None  # of a frame that decodes
            return Viewpoint(frame.frame, frame.timestamp_s, pose)
        no_depth = np.zeros((lens.height, lens.width), np.uint16)
        rgbd = RgbdFrame(
            index=frame.frame,
            timestamp_s=frame.timestamp_s,
            color=self._colors.decode(frame.color),
            depth=no_depth if frame.depth is None else decode_depth(frame.depth, camera),
            world_from_camera=pose,
            exposure=frame.exposure,
            has_depth=frame.depth is not None,
        )
        self._workshop.metrics.decode_ms.observe((time.perf_counter() - start_s) * 1e3)
        return rgbd

    def _drop(self, frame: Frame, cause: str, error: ValueError) -> None:
        self._workshop.metrics.dropped.labels(cause).inc()
        self._mailbox.note_answered()
        self._outlet.send(encode(Dropped(frame=frame.frame, reason=one_line(str(error)))))

    def _deliver(self, frame: Frame, result: FrameResult) -> None:
        wishes, light = self._hello.wishes, encode(result.light)
        plan = self._plan(result.plan)

        def composite(*, lossless: bool) -> bytes:
            return self._timed(lambda: composite_message(frame, result, plan, lossless=lossless))

        answer: tuple[bytes, ...] = (light,)
        if wishes.answer == "layer":
            answer = (light, self._timed(lambda: layer_message(frame, result, plan)))
        elif wishes.answer == "picture":
            answer = (light, composite(lossless=wishes.lossless))
        if wishes.lossless:
            self._answers.append((frame.frame, answer))
        self._send_answer(answer)
        if self._outlet.is_watched() and result.color is not None:
            is_shown = wishes.answer == "picture" and not wishes.lossless
            self._outlet.publish((light, answer[-1] if is_shown else composite(lossless=False)))

    def _send_answer(self, answer: tuple[bytes, ...]) -> None:
        *before, last = answer
        for message in before:
            self._outlet.send(message)
        self._mailbox.note_answered()
        self._outlet.send(last)

    def _plan(self, plan: Plan) -> Plan:
        """What a frame ran, and why it was sampled so."""
        if self._pressure.steps == 0 or plan.point is None:
            return plan
        reason = (
            f"{self._workshop.scheduler.busy} sessions share the device: {self._pressure.steps} below what was asked"
        )
        return structs.replace(plan, point=structs.replace(plan.point, reason=reason))

    def _timed(self, make: Callable[[], Composite | Layer]) -> bytes:
        """An answer, encoded; notes how long that takes."""
        start_s = time.perf_counter()
        data = encode(structs.replace(make(), waited_ms=self._waited_ms))
        self._workshop.metrics.encode_ms.observe((time.perf_counter() - start_s) * 1e3)
        return data


class _Overhead:
    """What one frame takes outside of the pipeline: on the clock, without waiting for the socket; of the processor."""

    def __init__(self, outlet: Outlet) -> None:
        self._outlet = outlet
        self._wall_s, self._cpu_s = -time.perf_counter() + outlet.waited_s, -time.thread_time()

    @contextlib.contextmanager
    def left_out(self) -> Iterator[None]:
        """While it lasts, nothing counts."""
        wall_s, cpu_s = time.perf_counter(), time.thread_time()
        try:
            yield
        finally:
            self._wall_s -= time.perf_counter() - wall_s
            self._cpu_s -= time.thread_time() - cpu_s

    def tell(self, metrics: Metrics) -> None:
        """The frame is answered."""
        metrics.overhead_ms.observe((self._wall_s + time.perf_counter() - self._outlet.waited_s) * 1e3)
        metrics.overhead_cpu_ms.observe((self._cpu_s + time.thread_time()) * 1e3)


def apply_control(
    pipeline: ClientSession, message: SceneControl, load_mesh: Callable[[bytes, str], Mesh]
) -> Acknowledged:
    """Do what a control message asks; what cannot be done is said in the acknowledgement."""
    try:
        notes = _apply(pipeline, message, load_mesh)
    except ValueError as error:  # MeshError is one
        return Acknowledged(request=message.request, error=one_line(str(error)))
    return Acknowledged(request=message.request, notes=tuple(one_line(note) for note in notes))


def _apply(pipeline: ClientSession, message: SceneControl, load_mesh: Callable[[bytes, str], Mesh]) -> tuple[str, ...]:
    match message:
        case PlaceObject():
            return pipeline.place_object(message.object, load_mesh(message.data, message.format), _placement(message))
        case MoveObject():
            with _object_known(message.object):
                pipeline.move_object(message.object, _placement(message))
        case RemoveObject():
            with _object_known(message.object):
                pipeline.remove_object(message.object)
        case Quality():
            pipeline.set_quality(message.preset, message.budget_ms, message.max_light_error_deg)
    return ()


@contextlib.contextmanager
def _object_known(name: str) -> Iterator[None]:
    try:
        yield
    except KeyError as error:
        raise ValueError(f"there is no object {name!r} in this session: place it first") from error


def _placement(message: PlaceObject | MoveObject) -> Placement:
    return Placement(position_m=message.position_m, scale=message.scale, yaw_deg=message.yaw_deg)
