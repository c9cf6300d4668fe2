"""Worker thread of one capturing session: owns the pipeline. Uses no asyncio.

While a frame is computed, the one before it is encoded and sent, and the one after it is read, in threads of their own.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from msgspec import structs

from protocol.codec import ProtocolError, encode, one_line
from protocol.colors import ColorReader
from protocol.frames import CameraModel, RgbdFrame, Viewpoint
from protocol.messages import (
    NOT_SAVED,
    Acknowledged,
    Composite,
    Dropped,
    Frame,
    Hello,
    Layer,
    MoveObject,
    Panorama,
    Plan,
    Quality,
    RequestMesh,
    RequestPanorama,
)
from server.meshing.files import mesh_files
from server.scene.mesh import Mesh
from server.service.edge.connection import POLICY, UNAUTHORIZED, ClientGone, Refusal
from server.service.frame_reader import FrameReader
from server.service.load_shedding import LoadShedding, SamplingRequest
from server.service.mailbox import Mailbox, PanoramaOrder, QueuedMessage, WatcherRequest, cancel_order
from server.service.mesh_message import mesh_parts
from server.service.monitoring.metrics import Metrics
from server.service.overhead import Overhead
from server.service.result_encoding import composite_message, layer_message
from server.service.room_registry import WrongRoomKey
from server.service.scene_control import SceneControl, apply_control
from server.service.scheduler import REQUEST_QUANTUM_S, Scheduler, Turn

if TYPE_CHECKING:
    from server.client_session import ClientSession
    from server.pipeline import FrameResult

log = logging.getLogger(__name__)

MAX_ACKNOWLEDGEMENTS = 256

SaveRoom = Callable[[str], str | None]
"""Saves the room of that name and returns why it could not, one line for the client, or None."""


class Outbox(Protocol):
    """Destination of a worker's messages. The session's implementation passes them to the event loop."""

    def greet(self, device_name: str) -> None:
        """Welcome the client once its pipeline is built. Raises ClientGone."""

    def answer_to(self, connection: int) -> None:
        """What is sent from now on answers a message that came over the session's connection of that number."""

    def send(self, data: bytes) -> None:
        """Send to the capturing client; returns when the socket has accepted the data. Raises ClientGone."""

    @property
    def waited_s(self) -> float:
        """Total time spent waiting for the socket."""

    @property
    def has_ended(self) -> bool:
        """Whether the client has left for good: nobody waits for the frame that is worked on."""

    def is_watched(self) -> bool:
        """Whether the session has watchers."""

    def publish(self, messages: tuple[bytes, ...]) -> None:
        """Send a frame's light and composite to the watchers; returns at once."""


def not_saved(_room: str) -> None:
    """As a `SaveRoom` of a service that keeps its rooms in memory, which is no failure."""


@dataclass(frozen=True)
class WorkerContext:
    """What all workers of a service share."""

    open_pipeline: Callable[[Hello], AbstractContextManager[ClientSession]]
    """Context with a client's pipeline. Raises ValueError for wishes that cannot be met."""
    mesh_loader: Callable[[], Callable[[bytes, str], Mesh]]
    """Makes the function that reads a session's meshes."""
    metrics: Metrics
    scheduler: Scheduler
    target_period_s: float = 0.25
    """See `Limits.target_period_s`."""
    color_reader: Callable[[CameraModel], ColorReader] = ColorReader
    save_room: SaveRoom = not_saved
    """Saves a room before placing or removing an object is acknowledged; a crash loses no acknowledged change."""
    save_placements: SaveRoom = not_saved
    """Saves only object placements before moves are acknowledged; cheaper than `save_room`."""


class Worker:
    """Processes one session's frames and control messages in mailbox order."""

    def __init__(self, context: WorkerContext, hello: Hello, mailbox: Mailbox, outbox: Outbox) -> None:
        self._context = context
        self._hello = hello
        self._mailbox = mailbox
        self._outbox = outbox
        self._share = context.scheduler.join(hello.room)
        self._load_mesh = context.mesh_loader()
        self._frames = FrameReader(hello.camera, context.color_reader(hello.camera))
        self._delivering = ThreadPoolExecutor(1, "answers")
        self._delivery: Future[None] | None = None
        """Of the newest frame. Nothing else is sent before it is done."""
        self._load_shedding = LoadShedding(hello.wishes, context.target_period_s)
        self._acknowledged: OrderedDict[int, Acknowledged] = OrderedDict()
        """Acknowledgements by request number: a client that lost its connection may repeat requests."""
        self._answers: deque[tuple[int, tuple[bytes, ...]]] = deque(maxlen=hello.max_inflight)
        """Last answers of a lossless session by frame number: those that the client may not have had."""

    def run(self) -> None:
        """Build the pipeline, welcome the client, and process messages until the mailbox closes.

        Raises Refusal if the client's wishes cannot be met, ClientGone if it left. Other errors are server errors.
        """
        try:
            with contextlib.ExitStack() as stack:
                try:
                    pipeline = stack.enter_context(self._context.open_pipeline(self._hello))
                except WrongRoomKey as error:
                    raise Refusal(UNAUTHORIZED, str(error)) from error
                except ValueError as error:
                    raise Refusal(POLICY, str(error)) from error
                self._outbox.greet(pipeline.device_name)
                while (queued := self._take()) is not None:
                    self._handle(pipeline, queued)
                self._finish_delivery()
        finally:
            self._context.scheduler.leave(self._share)
            self._delivering.shutdown()
            self._frames.close()
            self._log_undelivered()

    def begin_reading(self) -> None:
        """Any thread: what comes next may have arrived, and can be read while the device is at work."""
        self._mailbox.show_next_frame(self._frames.begin)

    def _take(self) -> QueuedMessage | None:
        """The next message, which may come while the newest frame is being answered. Raises what that raised."""
        if self._delivery is not None:
            self._mailbox.wait_or(self._delivery)
            if self._delivery.done():
                self._finish_delivery()
        return self._mailbox.take()

    def _finish_delivery(self) -> None:
        """Wait until the newest frame is answered. Raises what that raised."""
        delivery, self._delivery = self._delivery, None
        if delivery is not None:
            delivery.result()

    def _log_undelivered(self) -> None:
        """Say why the newest frame was not answered, where another error ended the session before that was asked."""
        error = None if self._delivery is None else self._delivery.exception()
        if error is not None and not isinstance(error, ClientGone):
            log.error("a frame could not be answered", exc_info=error)

    def _handle(self, pipeline: ClientSession, queued: QueuedMessage) -> None:
        if isinstance(queued.message, Frame):
            self._context.metrics.queue_age_s.observe(queued.age_ms / 1e3)
            self._answer_frame(pipeline, queued.message, queued)
            return
        try:
            self._finish_delivery()
        except BaseException:  # the session ends; the mailbox does not have the message any more
            cancel_order(queued.message)
            raise
        self._outbox.answer_to(queued.connection)
        if isinstance(queued.message, RequestMesh):
            self._send_mesh(pipeline, queued.message.request)
        elif isinstance(queued.message, RequestPanorama):
            self._send_panorama(pipeline, queued.message)
        elif isinstance(queued.message, PanoramaOrder):
            self._fill_order(pipeline, queued.message)
        elif isinstance(queued.message, WatcherRequest):
            self._answer_watcher(pipeline, queued.message)
        elif isinstance(queued.message, MoveObject):
            self._handle_moves(pipeline, [queued.message, *self._mailbox.take_while(MoveObject)])
        else:
            done = self._applied(pipeline, queued.message)
            if not isinstance(queued.message, Quality):
                (done,) = self._saved([done], self._context.save_room)
            self._outbox.send(encode(done))

    def _answer_watcher(self, pipeline: ClientSession, request: WatcherRequest) -> None:
        """Apply what a watcher asks for. Its numbers are its own, and it never repeats one."""
        if not request.answer.set_running_or_notify_cancel():
            return  # it has left
        is_move = isinstance(request.message, MoveObject)
        save = self._context.save_placements if is_move else self._context.save_room
        try:
            (done,) = self._saved([apply_control(pipeline, request.message, self._load_mesh)], save)
        except BaseException as error:
            request.answer.set_exception(error)
            raise
        request.answer.set_result(done)

    def _handle_moves(self, pipeline: ClientSession, moves: list[MoveObject]) -> None:
        """Apply consecutive moves, save them together, then acknowledge each."""
        done = [self._applied(pipeline, move) for move in moves]
        for acknowledged in self._saved(done, self._context.save_placements):
            self._outbox.send(encode(acknowledged))

    def _saved(self, done: list[Acknowledged], save: SaveRoom) -> list[Acknowledged]:
        """Save what was applied, also if it was before. Where that fails, the acknowledgements say so."""
        room = self._hello.room
        if room is None or all(acknowledged.error is not None for acknowledged in done):
            return done
        cause = save(room)
        if cause is None:
            return done
        error = one_line(
            f"{NOT_SAVED}{cause}; it is done, and lost if the server is killed before it can save the room: "
            "send the same request again to ask"
        )
        return [kept if kept.error is not None else structs.replace(kept, error=error) for kept in done]

    def _applied(self, pipeline: ClientSession, message: SceneControl) -> Acknowledged:
        """Apply a request and return its acknowledgement. A repeated request is not applied again."""
        done = self._acknowledged.get(message.request)
        if done is None:
            done = apply_control(pipeline, message, self._load_mesh)
            if isinstance(message, Quality) and done.error is None:
                self._load_shedding.request(
                    SamplingRequest(message.preset, message.budget_ms, message.max_light_error_deg)
                )
            self._acknowledged[message.request] = done
            if len(self._acknowledged) > MAX_ACKNOWLEDGEMENTS:
                self._acknowledged.popitem(last=False)
        return done

    def _answer_frame(self, pipeline: ClientSession, frame: Frame, queued: QueuedMessage) -> None:
        known = next((answer for number, answer in self._answers if number == frame.frame), None)
        if known is not None:
            self._outbox.answer_to(queued.connection)
            return self._send_answer(known, queued.connection)
        overhead = Overhead(self._outbox, self._context.metrics, self._frames)
        try:
            with overhead.measured():
                rgbd = self._read(frame)
        except ProtocolError as error:
            return self._drop(frame, queued.connection, "unreadable", error)
        self.begin_reading()
        if self._load_shedding.limit(self._context.scheduler.busy, pipeline.predicted_s):
            self._sample_as_granted(pipeline)
        try:
            with self._context.scheduler.acquire(self._share) as turn:
                waited_ms = queued.age_ms
                frame_turn = _FrameTurn(turn, self._outbox)
                result = pipeline.process(rgbd, watched=self._outbox.is_watched(), turn=frame_turn)
                self._adapt_sampling(pipeline)
        except ValueError as error:
            return self._drop(frame, queued.connection, "refused", error)
        self._context.metrics.turn_s.observe(turn.waited_s)
        self._context.metrics.observe_stages(result.timings)
        self._context.metrics.processed.inc()
        self._finish_delivery()
        done = _Drawn(frame, queued.connection, result, self._plan(result.plan), waited_ms, overhead)
        self._delivery = self._delivering.submit(self._deliver, done)
        if self._hello.wishes.lossless:  # which may ask for it again next
            self._finish_delivery()
        return None

    def _adapt_sampling(self, pipeline: ClientSession) -> None:
        """Apply the load-shedding step: cheaper sampling under load, the requested sampling otherwise."""
        scheduler, load_shedding = self._context.scheduler, self._load_shedding
        if load_shedding.observe(scheduler.busy, scheduler.period_s):
            self._sample_as_granted(pipeline)

    def _sample_as_granted(self, pipeline: ClientSession) -> None:
        with contextlib.suppress(ValueError):  # not available on this device: keep the current sampling
            pipeline.set_quality(*self._load_shedding.granted)

    def _send_mesh(self, pipeline: ClientSession, request: int) -> None:
        try:
            parts = mesh_parts(request, mesh_files(pipeline.scene_mesh()))
        except ValueError as error:  # MeshingError is one
            return self._outbox.send(encode(Acknowledged(request=request, error=one_line(str(error)))))
        for part in parts:
            self._outbox.send(encode(part))
        return self._outbox.send(encode(Acknowledged(request=request)))

    @contextlib.contextmanager
    def _short_turn(self) -> Iterator[_FrameTurn]:
        """Context of a request's use of the device, which lets others' frames go first."""
        with self._context.scheduler.acquire(self._share, REQUEST_QUANTUM_S) as turn:
            yield _FrameTurn(turn, self._outbox)

    def _send_panorama(self, pipeline: ClientSession, request: RequestPanorama) -> None:
        try:
            data, position_m = pipeline.panorama(request.format, request.position_m, self._short_turn())
        except ValueError as error:
            return self._outbox.send(encode(Acknowledged(request=request.request, error=one_line(str(error)))))
        panorama = Panorama(request=request.request, format=request.format, position_m=position_m, data=data)
        self._outbox.send(encode(panorama))
        return self._outbox.send(encode(Acknowledged(request=request.request)))

    def _fill_order(self, pipeline: ClientSession, order: PanoramaOrder) -> None:
        if not order.answer.set_running_or_notify_cancel():
            return  # nobody waits any more
        try:
            data, _ = pipeline.panorama(order.format, order.position_m, self._short_turn())
        except ValueError as error:
            order.answer.set_exception(error)
        except BaseException as error:
            order.answer.set_exception(error)
            raise
        else:
            order.answer.set_result(data)

    def _read(self, frame: Frame) -> RgbdFrame | Viewpoint:
        start_s = time.perf_counter()
        read = self._frames.read(frame)
        if isinstance(read, RgbdFrame):
            self._context.metrics.decode_s.observe(time.perf_counter() - start_s)
        return read

    def _drop(self, frame: Frame, connection: int, cause: str, error: ValueError) -> None:
        self._finish_delivery()
        self._outbox.answer_to(connection)
        self._context.metrics.dropped.labels(cause).inc()
        self._mailbox.note_answered(connection)
        self._outbox.send(encode(Dropped(frame=frame.frame, reason=one_line(str(error)))))

    def _deliver(self, done: _Drawn) -> None:
        """Encode and send a frame's answer, while the next one is computed."""
        self._outbox.answer_to(done.connection)
        with done.overhead.measured(sends=True):
            self._send_drawn(done)
        done.overhead.record()

    def _send_drawn(self, done: _Drawn) -> None:
        wishes, frame, result, plan = self._hello.wishes, done.frame, done.result, done.plan
        light = encode(result.light)

        def timed(make: Callable[[], Composite | Layer]) -> bytes:
            start_s = time.perf_counter()
            data = encode(structs.replace(make(), waited_ms=done.waited_ms))
            self._context.metrics.encode_s.observe(time.perf_counter() - start_s)
            return data

        def composite(*, lossless: bool) -> bytes:
            return timed(lambda: composite_message(frame, result, plan, lossless=lossless))

        answer: tuple[bytes, ...] = (light,)
        if wishes.answer != "light":  # which does not wait until the picture is encoded
            self._outbox.send(light)
            drawn = timed(lambda: layer_message(frame, result, plan)) if wishes.answer == "layer" else None
            answer = (light, drawn or composite(lossless=wishes.lossless))
        if wishes.lossless:
            self._answers.append((frame.frame, answer))
        self._mailbox.note_answered(done.connection)
        self._outbox.send(answer[-1])
        if self._outbox.is_watched() and result.color is not None:
            is_shown = wishes.answer == "picture" and not wishes.lossless
            self._outbox.publish((light, answer[-1] if is_shown else composite(lossless=False)))

    def _send_answer(self, answer: tuple[bytes, ...], connection: int) -> None:
        *before, last = answer
        for message in before:
            self._outbox.send(message)
        self._mailbox.note_answered(connection)
        self._outbox.send(last)

    def _plan(self, plan: Plan) -> Plan:
        """The frame's plan, with the reason if load shedding lowered its sampling."""
        if self._load_shedding.steps == 0 or plan.point is None:
            return plan
        sharing, steps = self._context.scheduler.busy, self._load_shedding.steps
        reason = f"{sharing} sessions share the device: {steps} below what was asked"
        return structs.replace(plan, point=structs.replace(plan.point, reason=reason))


@dataclass(frozen=True)
class _FrameTurn:
    """A frame's use of the device, as long as its client is there."""

    turn: Turn
    outbox: Outbox

    def is_due(self) -> bool:
        return self.outbox.has_ended or self.turn.is_due()

    def give_way(self, *, may_end: bool) -> None:
        """Raises ClientGone."""
        if self.outbox.has_ended and may_end:
            raise ClientGone
        if self.turn.is_due():
            self.turn.give_way()

    def released(self) -> AbstractContextManager[None]:
        return self.turn.released()


@dataclass(frozen=True)
class _Drawn:
    """A frame that is to be answered."""

    frame: Frame
    connection: int
    """Number of the one over which it came."""
    result: FrameResult
    plan: Plan
    waited_ms: float
    overhead: Overhead
