"""The service: one device with its capturing sessions, watchers and metrics. `app` adds the routes."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from protocol.codec import encode, one_line
from protocol.colors import readable_codecs
from protocol.frames import CameraModel
from protocol.images import DEPTH_CODECS
from protocol.limits import FEW_INFLIGHT
from protocol.messages import Acknowledged, Bye, Hello, Watch, Welcome, Wishes
from server.parsing.parsers import Parsers
from server.scene.mesh import Mesh
from server.service.broadcast import Broadcast, serve_watcher
from server.service.edge.connection import (
    GONE,
    INTERNAL,
    POLICY,
    TRY_LATER,
    BadMessage,
    ClientGone,
    Connection,
    Refusal,
)
from server.service.edge.connection_limits import ConnectionLimits
from server.service.graceful_shutdown import GracefulShutdown
from server.service.limits import DEFAULT_LIMITS, Limits
from server.service.mailbox import ObjectRequest, PanoramaOrder, WatcherRequest
from server.service.memory_return import MemoryReturn
from server.service.monitoring.event_log import about
from server.service.monitoring.metrics import Metrics
from server.service.room_registry import RoomFactory, RoomRegistry, key_digest_of
from server.service.saving.retention import StorageUsage
from server.service.saving.room_persistence import RoomPersistence
from server.service.scheduler import Scheduler
from server.service.session import CaptureSession, EventLoopOutbox
from server.service.worker import WorkerContext, not_saved

if TYPE_CHECKING:
    from server.client_session import ClientSession
    from server.opencl.device import Device
    from server.room.room import Room

SERVER_NAME = f"probeless {version('probeless')}"
NO_SESSION = "waiting"
"""Session name in a watcher's welcome while there is no capturing session."""

ORDER_PATIENCE_S = 60.0
"""Time limit of a panorama: it waits for the frames before it and for the device, which other sessions share."""

FULL_MAILBOX_PAUSE_S = 0.02
"""Interval at which a watcher's request is offered again to a session that has too much unread."""

log = logging.getLogger(__name__)

PipelineFactory = Callable[["Device", CameraModel, Wishes, "Room | None", Hello], "ClientSession"]
MeshLoader = Callable[[bytes, str], Mesh]
WarmUp = Callable[["Device"], object]


class NoSession(LookupError):
    """No session of this name exists, or it may not be seen with this key; one line."""


class Service:
    """Serves all connections on one event loop. The app calls `start` and `stop`."""

    def __init__(
        self,
        device: Device,
        *,
        pipeline_factory: PipelineFactory | None = None,
        room_factory: RoomFactory | None = None,
        mesh_loader: MeshLoader | None = None,
        parsers: Parsers | None = None,
        warm_up: WarmUp | None = None,
        max_sessions: int | None = None,
        limits: Limits = DEFAULT_LIMITS,
        concurrent_frames: int = 1,
        data: Path | None = None,
    ) -> None:
        """`pipeline_factory`, `room_factory` and `mesh_loader` (default: the real ones) are called in worker threads.
        `parsers` decode untrusted input in child processes. `concurrent_frames`: frames that may run on the device at
        the same time. `data`: folder in which rooms are saved; None: a room is lost when its last client leaves.

        `warm_up` is called once in a thread before the first session; None: no warm-up. `max_sessions` overrides
        `limits.sessions`.
        """
        self.device_name = device.name
        self.metrics = Metrics()
        self.failure: str | None = None
        """Why the warm-up failed, one line. The service is then never ready."""
        self.failed_check: str | None = None
        """Name of the failed check, if the self-check found a wrong result."""
        self.shutdown = GracefulShutdown()
        self.on_prepared: Callable[[], None] = lambda: None
        """Called on the event loop when the warm-up has ended, also after a failure."""
        self._device = device
        self._warm_up = warm_up
        self.limits = limits if max_sessions is None else replace(limits, sessions=max_sessions)
        self.connection_limits = ConnectionLimits(self.limits)
        self._broadcast = Broadcast()
        self._memory = MemoryReturn()
        self._session_numbers = count(1)
        self._sessions = 0
        self._watchers = 0
        self._prepared = asyncio.Event()
        self._threads = ThreadPoolExecutor(self.limits.sessions + 1, thread_name_prefix="probeless-session")
        self._parsers = parsers or Parsers()
        self._parsers.on_death = self._note_parser_death
        self.metrics.ready.set_function(lambda: float(self.ready))
        self.metrics.device_memory.set_function(lambda: float(device.memory.bytes_held))
        self._captures: dict[str, CaptureSession] = {}
        """Capturing sessions by name."""
        self._resumable_sessions: dict[str, CaptureSession] = {}
        """Sessions that survive a lost connection, by their keys."""
        self.shutdown.begin_hooks += [self._stop_waiting_for_clients, self._leave_out_later_frames]
        self.shutdown.answer_hooks.append(self._finish_frames)
        self._scheduler = Scheduler(concurrent_frames)
        self._factory = pipeline_factory or _real_pipeline()
        self._persistence = RoomPersistence(data, device, self.limits.room_retention) if data is not None else None
        if self._persistence is not None:
            self.rooms = RoomRegistry(
                self._persistence.open_room, self._persistence.save_and_release, self._persistence.key_digest
            )
        else:
            self.rooms = RoomRegistry(room_factory or _real_room(device))
        self.metrics.add_room_metrics(lambda: self.rooms.count, self._persistence)
        self._worker_context = WorkerContext(
            open_pipeline=self._open_pipeline,
            scheduler=self._scheduler,
            target_period_s=self.limits.target_period_s,
            mesh_loader=self._parsers.mesh_loader if mesh_loader is None else lambda: mesh_loader,
            color_reader=self._parsers.color_reader,
            metrics=self.metrics,
            save_room=self._persistence.save_now if self._persistence else not_saved,
            save_placements=self._persistence.save_placements if self._persistence else not_saved,
        )
        self._preparing: asyncio.Task[None] | None = None

    async def _stop_persistence(self) -> None:
        assert self._persistence is not None
        await asyncio.to_thread(self._persistence.stop)

    def _enter_room(self, name: str, hello: Hello) -> contextlib.AbstractContextManager[Room]:
        return self.rooms.entered(name, hello.wishes, hello.room_key)

    @contextlib.contextmanager
    def _open_pipeline(self, hello: Hello) -> Iterator[ClientSession]:
        """Worker thread: context with the client's pipeline, in its room if it names one."""
        with contextlib.ExitStack() as stack:
            room = None if hello.room is None else stack.enter_context(self._enter_room(hello.room, hello))
            pipeline = self._factory(self._device, hello.camera, hello.wishes, room, hello)
            stack.callback(pipeline.close)
            yield pipeline

    @property
    def ready(self) -> bool:
        """True once kernels are compiled and the self-check has passed, until shutdown begins."""
        return self._prepared.is_set() and self.failure is None and not self.shutdown.is_draining

    @property
    def takes_sessions(self) -> bool:
        """Whether a new client would be given a session now, as far as the server's own limits go."""
        if not self.ready or self._sessions >= self.limits.sessions:
            return False
        try:
            self._admit()
        except Refusal:
            return False
        return True

    @property
    def sessions(self) -> int:
        """Number of capturing sessions."""
        return self._sessions

    @property
    def storage(self) -> StorageUsage | None:
        """Disk usage of saved rooms at the last check; None: rooms are not saved."""
        return self._persistence.storage if self._persistence else None

    def start(self) -> None:
        """Start the warm-up in the background. Must be called on the event loop that will serve."""
        self._preparing = asyncio.create_task(self._prepare())
        if self._persistence is not None:
            self._persistence.start(self.rooms)
            self.shutdown.save_hooks.append(self._stop_persistence)

    def stop(self) -> None:
        """Release threads and processes. All sessions have ended before."""
        if self._preparing is not None:
            self._preparing.cancel()
        self._memory.stop()
        self._threads.shutdown(wait=False, cancel_futures=True)
        self._parsers.stop()
        self._device.end_children()

    def compile_beside(self) -> None:
        """As `Device.compile_beside`: sessions do not wait for kernels of others. Call when it is prepared."""
        self._device.compile_beside()

    async def _prepare(self) -> None:
        if self._warm_up is not None:
            try:
                self._parsers.start()
                await asyncio.get_running_loop().run_in_executor(self._threads, self._warm_up, self._device)
            except Exception as error:  # reported by `failure`, /healthz and to every client
                log.exception("the warm-up failed")
                self.failure = one_line(f"the warm-up on {self.device_name} failed: {error}")
                self.failed_check = getattr(error, "check", None)
            else:
                log.info("ready", extra={"device": self.device_name})
        self._prepared.set()
        self.on_prepared()

    def _note_parser_death(self, kind: str) -> None:
        self.metrics.parser_deaths.labels(kind).inc()
        log.warning("a parser died", extra={"kind": kind})

    def note_refusal(self, refusal: Refusal, address: str) -> None:
        """Count and log a refused client."""
        self.metrics.refused.labels(str(refusal.code)).inc()
        log.info("client refused", extra={"address": address, "code": refusal.code, "reason": refusal.reason})

    async def panorama(
        self, order: PanoramaOrder, session: str | None = None, room: str | None = None, room_key: str | None = None
    ) -> bytes:
        """The file that `asked` describes, of a session; default: the newest one (in `room`).

        Raises NoSession, TimeoutError, or ValueError with one line if there is no light yet.
        """
        name = self._broadcast.find(session, room, key_digest_of(room_key))
        capture = self._captures.get(name or "")
        if capture is None:
            raise NoSession(f"there is no session {session!r} here" if session else "no session is streaming")
        if not capture.take_order(order):
            raise TimeoutError
        try:
            async with asyncio.timeout(ORDER_PATIENCE_S):
                return await asyncio.wrap_future(order.answer)
        except asyncio.CancelledError:
            if order.answer.cancelled():
                raise NoSession("the session has just ended") from None
            raise

    async def serve(self, connection: Connection) -> None:
        """Serve one client from its first message to its end."""
        try:
            with self.shutdown.registered(connection):
                await self._serve_first_message(connection)
        except Refusal as refusal:
            await connection.refuse(refusal)
        except ClientGone:
            log.info("a client left", extra={"address": connection.address})
        except Exception:  # reported to both sides
            log.exception("a connection failed")
            await connection.refuse(Refusal(INTERNAL, "the server failed; its log says why"))

    async def _serve_first_message(self, connection: Connection) -> None:
        try:
            async with asyncio.timeout(self.limits.first_message_s):
                first = await connection.receive()
        except BadMessage as bad:
            raise Refusal(POLICY, "the first message must be hello or watch") from bad
        except TimeoutError as late:
            raise Refusal(POLICY, f"neither hello nor watch came within {self.limits.first_message_s:g} s") from late
        match first:
            case Hello(resume=str(key)):
                await self._resume(connection, key)
            case Hello():
                self._admit()
                await self._capture(connection, first)
            case Watch():
                await self._watch(connection, first)
            case None | Bye():
                await connection.close()
            case _:
                raise Refusal(POLICY, f"the first message must be hello or watch, not {type(first).__name__.lower()}")

    async def _capture(self, connection: Connection, hello: Hello) -> None:
        with self.connection_limits.capturing(connection.address), self._counted_session() as name:
            await self._until_ready()
            key = secrets.token_urlsafe(24) if hello.keep_s > 0 else None
            welcome = Welcome(
                session=name,
                server=SERVER_NAME,
                device="",
                max_inflight=hello.max_inflight,
                key=key,
                room=hello.room,
                codecs=readable_codecs(),
                depth_codecs=DEPTH_CODECS,
            )
            key_digest = key_digest_of(hello.room_key)
            outbox = EventLoopOutbox(
                welcome,
                connection,
                self._broadcast,
                is_resumable=key is not None,
                key_digest=key_digest,
                camera=hello.camera,
            )
            size = f"{hello.camera.width}x{hello.camera.height}"
            with about(session=name, address=connection.address):
                log.info("session opened", extra={"client": hello.client, "picture": size})
                session = CaptureSession(connection, hello, self._worker_context, outbox)
                self._captures[name] = session
                try:
                    with self._resumable(key, session):
                        await session.run(self._threads)
                finally:
                    del self._captures[name]
                    self._memory.note_end()
                log.info("session closed", extra={"reason": session.why_ended})

    @contextlib.contextmanager
    def _resumable(self, key: str | None, session: CaptureSession) -> Iterator[None]:
        if key is not None:
            self._resumable_sessions[key] = session
        try:
            yield
        finally:
            self._resumable_sessions.pop(key or "", None)

    def _leave_out_later_frames(self) -> None:
        for session in tuple(self._captures.values()):
            session.leave_out_later_frames()

    async def _finish_frames(self) -> None:
        await asyncio.gather(*(session.finish() for session in tuple(self._captures.values())))

    def _stop_waiting_for_clients(self) -> None:
        for session in tuple(self._resumable_sessions.values()):
            session.stop_waiting()

    async def _resume(self, connection: Connection, key: str) -> None:
        session = self._resumable_sessions.get(key)
        if session is None:
            raise Refusal(GONE, "there is no session with this key: it ended, or the server was restarted")
        await session.resume(connection)

    def _admit(self) -> None:
        """Admission control: raises Refusal if the device has no time for another session."""
        period_s, busy = self._scheduler.period_s(newcomers=1), self._scheduler.busy
        if busy and period_s > self.limits.max_period_s:
            raise Refusal(
                TRY_LATER,
                f"the server is full: {busy} sessions share its device, and with one more each would get a frame every "
                f"{period_s:.1f} s, more than {self.limits.max_period_s:g} s: try again later",
            )

    async def _until_ready(self) -> None:
        await self._prepared.wait()
        if self.failure is not None:
            raise Refusal(INTERNAL, self.failure)

    @contextlib.contextmanager
    def _counted_session(self) -> Iterator[str]:
        if self._sessions >= self.limits.sessions:
            raise Refusal(TRY_LATER, f"all {self.limits.sessions} sessions of this server are taken: try again later")
        self._sessions += 1
        self.metrics.sessions.set(self._sessions)
        try:
            yield f"session-{next(self._session_numbers)}"
        finally:
            self._sessions -= 1
            self.metrics.sessions.set(self._sessions)

    async def _watch(self, connection: Connection, watch: Watch) -> None:
        waiting = Welcome(session=NO_SESSION, server=SERVER_NAME, device=self.device_name, max_inflight=FEW_INFLIGHT)
        with (
            self._counted_watcher(),
            self._broadcast.watcher(
                watch.session, encode(waiting), watch.room, key_digest_of(watch.room_key)
            ) as watcher,
        ):
            await serve_watcher(connection, watcher, self._ask_session)

    async def _ask_session(self, session: str | None, message: ObjectRequest) -> Acknowledged:
        """Have the worker of a session apply what one of its watchers asks for."""
        order = WatcherRequest(message)
        while (capture := self._captures.get(session or "")) is not None and not capture.take_order(order):
            await asyncio.sleep(FULL_MAILBOX_PAUSE_S)
        if capture is None:
            return Acknowledged(request=message.request, error="no session is streaming that could have objects")
        try:
            return await asyncio.wrap_future(order.answer)
        except asyncio.CancelledError:
            if (task := asyncio.current_task()) is not None and task.cancelling():
                raise  # the watcher has left
            return Acknowledged(request=message.request, error="the session has just ended")

    @contextlib.contextmanager
    def _counted_watcher(self) -> Iterator[None]:
        if self._watchers >= self.limits.watchers:
            raise Refusal(TRY_LATER, f"{self.limits.watchers} clients watch this server already: try again later")
        self._watchers += 1
        self.metrics.watchers.set(self._watchers)
        try:
            yield
        finally:
            self._watchers -= 1
            self.metrics.watchers.set(self._watchers)


def _real_room(device: Device) -> RoomFactory:
    def open_room(wishes: Wishes, name: str) -> Room:
        from server.room.room import Room  # loads OpenCL, as below

        return Room(device, wishes, name)

    return open_room


def _real_pipeline() -> PipelineFactory:
    from server.client_session import ClientSession  # loads OpenCL, which a service with another factory does not need

    return ClientSession
