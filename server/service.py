"""The service: one device, its capturing sessions and watchers, its metrics. An app is made around one of these."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from itertools import count
from typing import TYPE_CHECKING

from protocol.codec import encode, one_line
from protocol.frames import CameraModel
from protocol.messages import Bye, Hello, Watch, Welcome, Wishes
from server.broadcast import Broadcast, serve_watcher
from server.connection import INTERNAL, POLICY, TRY_LATER, BadMessage, ClientGone, Connection, Refusal
from server.metrics import Metrics
from server.scene.mesh import Mesh, load_mesh
from server.session import MAX_INFLIGHT, CaptureSession, LoopOutlet
from server.worker import Workshop

if TYPE_CHECKING:
    from server.opencl.device import Device
    from server.pipeline import Pipeline

DEFAULT_MAX_SESSIONS = 16
MAX_WATCHERS = 64
SERVER_NAME = f"probeless {version('probeless')}"
NO_SESSION = "waiting"
"""The session in the welcome of a watcher for which there is no capturing session yet."""

log = logging.getLogger(__name__)

PipelineFactory = Callable[["Device", CameraModel, Wishes], "Pipeline"]
MeshLoader = Callable[[bytes, str], Mesh]
WarmUp = Callable[["Device"], object]


class Service:
    """Serves any number of connections on one event loop. `start` and `stop` are called by the app."""

    def __init__(
        self,
        device: Device,
        *,
        pipeline_factory: PipelineFactory | None = None,
        mesh_loader: MeshLoader = load_mesh,
        warm_up: WarmUp | None = None,
        max_sessions: int = DEFAULT_MAX_SESSIONS,
    ) -> None:
        """`pipeline_factory` (default: the real pipeline) and `mesh_loader` are called in workers' threads.

        `warm_up` is called once before the first session, in a thread too; None: there is nothing to wait for.
        """
        self.device_name = device.name
        self.metrics = Metrics()
        self.failure: str | None = None
        """One line, where the warm-up failed: the service will never be ready."""
        self.on_prepared: Callable[[], None] = lambda: None
        """Called on the event loop when the warm-up has ended, well or not."""
        self._device = device
        self._warm_up = warm_up
        self._max_sessions = max_sessions
        self._broadcast = Broadcast()
        self._session_numbers = count(1)
        self._sessions = 0
        self._watchers = 0
        self._prepared = asyncio.Event()
        self._threads = ThreadPoolExecutor(max_sessions + 1, thread_name_prefix="probeless-session")
        factory = pipeline_factory or _real_pipeline()
        self._workshop = Workshop(
            build_pipeline=lambda hello: factory(device, hello.camera, hello.wishes),
            load_mesh=mesh_loader,
            metrics=self.metrics,
        )
        self._preparing: asyncio.Task[None] | None = None

    @property
    def ready(self) -> bool:
        """The kernels are warm and clients are welcome."""
        return self._prepared.is_set() and self.failure is None

    @property
    def sessions(self) -> int:
        """Capturing sessions now."""
        return self._sessions

    def start(self) -> None:
        """Begin to warm up, without waiting for it. Needs the running event loop that will serve."""
        self._preparing = asyncio.create_task(self._prepare())

    def stop(self) -> None:
        """Let the threads go; sessions have ended by now."""
        if self._preparing is not None:
            self._preparing.cancel()
        self._threads.shutdown(wait=False, cancel_futures=True)

    async def _prepare(self) -> None:
        if self._warm_up is not None:
            try:
                await asyncio.get_running_loop().run_in_executor(self._threads, self._warm_up, self._device)
            except Exception as error:  # told to whoever asks: `failure`, /healthz, every client
                log.exception("the warm-up failed")
                self.failure = one_line(f"the warm-up on {self.device_name} failed: {error}")
        self._prepared.set()
        self.on_prepared()

    async def serve(self, connection: Connection) -> None:
        """One client, from its first message to its end."""
        try:
            await self._serve_first_message(connection)
        except Refusal as refusal:
            await connection.refuse(refusal)
        except ClientGone:
            log.info("a client left")
        except Exception:  # reported to both sides
            log.exception("a connection failed")
            await connection.refuse(Refusal(INTERNAL, "the server failed; its log says why"))

    async def _serve_first_message(self, connection: Connection) -> None:
        try:
            first = await connection.receive()
        except BadMessage as bad:
            raise Refusal(POLICY, "the first message must be hello or watch") from bad
        match first:
            case Hello():
                await self._capture(connection, first)
            case Watch():
                await self._watch(connection, first)
            case None | Bye():
                await connection.close()
            case _:
                raise Refusal(POLICY, f"the first message must be hello or watch, not {type(first).__name__.lower()}")

    async def _capture(self, connection: Connection, hello: Hello) -> None:
        with self._counted_session() as name:
            await self._until_ready()
            outlet = LoopOutlet(name, SERVER_NAME, connection, self._broadcast)
            log.info("%s: %s captures %dx%d", name, hello.client, hello.camera.width, hello.camera.height)
            await CaptureSession(connection, hello, self._workshop, outlet).run(self._threads)

    async def _until_ready(self) -> None:
        await self._prepared.wait()
        if self.failure is not None:
            raise Refusal(INTERNAL, self.failure)

    @contextlib.contextmanager
    def _counted_session(self) -> Iterator[str]:
        if self._sessions >= self._max_sessions:
            raise Refusal(TRY_LATER, f"all {self._max_sessions} sessions of this server are taken: try again later")
        self._sessions += 1
        self.metrics.sessions.set(self._sessions)
        try:
            yield f"session-{next(self._session_numbers)}"
        finally:
            self._sessions -= 1
            self.metrics.sessions.set(self._sessions)

    async def _watch(self, connection: Connection, watch: Watch) -> None:
        waiting = Welcome(session=NO_SESSION, server=SERVER_NAME, device=self.device_name, max_inflight=MAX_INFLIGHT)
        with self._counted_watcher(), self._broadcast.watcher(watch.session, encode(waiting)) as watcher:
            await serve_watcher(connection, watcher)

    @contextlib.contextmanager
    def _counted_watcher(self) -> Iterator[None]:
        if self._watchers >= MAX_WATCHERS:
            raise Refusal(TRY_LATER, f"{MAX_WATCHERS} clients watch this server already: try again later")
        self._watchers += 1
        self.metrics.watchers.set(self._watchers)
        try:
            yield
        finally:
            self._watchers -= 1
            self.metrics.watchers.set(self._watchers)


def _real_pipeline() -> PipelineFactory:
    from server.pipeline import Pipeline  # loads OpenCL, which a service with another factory does not need

    return Pipeline
