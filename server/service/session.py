"""One capturing client: the event loop reads its socket into a mailbox; a worker processes and answers (worker.py)."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from concurrent.futures import CancelledError, Executor, Future

from msgspec import structs

from protocol.codec import encode
from protocol.frames import CameraModel
from protocol.messages import Bye, ClientMessage, Dropped, Error, Frame, Hello, Watch, Welcome
from server.service.broadcast import Broadcast
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
from server.service.mailbox import Mailbox, Order
from server.service.worker import Worker, WorkerContext

FAR_TOO_MANY = 4
"""Windows of frames sent ahead of which the client is told."""

log = logging.getLogger(__name__)


class EventLoopOutbox:
    """Passes a worker's messages to the event loop and waits until the socket has accepted them.

    Answers to what came over a connection that was lost are discarded, also after the client has resumed its session:
    it repeats unanswered requests, and gives up unanswered frames or repeats them.
    """

    def __init__(
        self,
        welcome: Welcome,
        connection: Connection,
        broadcast: Broadcast,
        *,
        is_resumable: bool,
        key_digest: bytes = b"",
        camera: CameraModel | None = None,
    ) -> None:
        """`welcome`: without the device. `is_resumable`: the session survives a lost connection.

        `key_digest`: of the room's key. `camera`: of the pictures, for watchers.
        """
        self._key_digest = key_digest
        self._camera = camera
        self._welcome = welcome
        self._link: tuple[int, Connection | None] = 0, connection
        """Number of the connection, and the connection while it is not lost; replaced together."""
        self._answering = 0
        """Number of the connection over which the message came that is being answered."""
        self._broadcast = broadcast
        self._is_resumable = is_resumable
        self._loop = asyncio.get_running_loop()
        self._sending: Future[None] | None = None
        self._closed = False
        self.waited_s = 0.0

    @property
    def session(self) -> str:
        """The session's name."""
        return self._welcome.session

    def greet(self, device_name: str) -> None:
        """Worker thread: welcome the client and allow watchers. Raises ClientGone."""
        self._welcome = structs.replace(self._welcome, device=device_name)
        # Watchers must not be able to resume the session.
        shown = structs.replace(self._welcome, key=None, camera=self._camera)
        self._loop.call_soon_threadsafe(self._open_to_watchers, encode(shown))
        self.send(encode(self._welcome))

    def _open_to_watchers(self, welcome: bytes) -> None:
        if not self._closed:
            self._broadcast.open_session(self.session, welcome, self._welcome.room, self._key_digest)

    def answer_to(self, connection: int) -> None:
        """Worker thread: what is sent from now on answers a message of that connection."""
        self._answering = connection

    def send(self, data: bytes) -> None:
        """Worker thread: send to the capturing client. Raises ClientGone if its loss ends the session."""
        if self._closed:
            raise ClientGone
        number, connection = self._link
        if connection is None or number != self._answering:
            return
        self._sending = asyncio.run_coroutine_threadsafe(self._send_timed(connection, data), self._loop)
        try:
            self._sending.result()
        except (CancelledError, ClientGone) as error:
            if self._closed or not self._is_resumable:
                raise ClientGone from error

    async def _send_timed(self, connection: Connection, data: bytes) -> None:
        began = self._loop.time()
        try:
            await connection.send(data)
        finally:
            self.waited_s += self._loop.time() - began

    @property
    def has_ended(self) -> bool:
        """Any thread: whether the session is at its end."""
        return self._closed

    def is_watched(self) -> bool:
        """Worker thread: whether anybody watches this session."""
        return self._broadcast.is_watched(self.session)

    def publish(self, messages: tuple[bytes, ...]) -> None:
        """Worker thread: send to the watchers, without waiting."""
        self._loop.call_soon_threadsafe(self._broadcast.publish, self.session, messages)

    def detach(self) -> None:
        """Event loop: the connection is lost; a worker that is sending is released."""
        self._link = self._link[0] + 1, None
        self._let_go()

    async def attach(self, connection: Connection) -> None:
        """Event loop: use the client's new connection. Raises ClientGone if it is lost too."""
        await connection.send(encode(structs.replace(self._welcome, resumed=True)))
        self._link = self._link[0], connection

    def close(self) -> None:
        """Event loop: end the session; a worker that is sending is released."""
        self._closed = True
        self._broadcast.close_session(self.session)
        self._let_go()

    def _let_go(self) -> None:
        if self._sending is not None:
            self._sending.cancel()


class CaptureSession:
    """One capturing session, from hello to its end. It may survive lost connections."""

    def __init__(self, connection: Connection, hello: Hello, context: WorkerContext, outbox: EventLoopOutbox) -> None:
        self._connection = connection
        self._keep_s = hello.keep_s
        self._metrics = context.metrics
        self._outbox = outbox
        self._loop = asyncio.get_running_loop()
        self._mailbox_has_space = asyncio.Event()
        self._told_of_window = False
        self._max_inflight = hello.max_inflight
        self._mailbox = Mailbox(None if hello.wishes.lossless else hello.max_inflight, self._wake_reader)
        self._worker = Worker(context, hello, self._mailbox, outbox)
        self._returned: asyncio.Future[Connection] | None = None
        """Set while the connection is lost; its result is the client's new connection."""
        self._has_ended = False
        self._is_finishing = False
        """The server is stopping: what has arrived is answered, later frames are not."""
        self.why_ended = ""
        """One line; set when the session has ended."""
        self._done_with: dict[Connection, asyncio.Event] = {}
        """Connections that resumed this session; the event is set when a connection is no longer needed."""

    async def run(self, threads: Executor) -> None:
        """Serve the client until it leaves, is refused, or the worker fails. Returns when the worker has ended."""
        work = self._loop.run_in_executor(threads, self._worker.run)
        read = asyncio.create_task(self._read())
        try:
            await asyncio.wait((work, read), return_when=asyncio.FIRST_COMPLETED)
            while not work.done() and self._is_lost(read):
                if not await self._wait_for_return(work):
                    break
                read = asyncio.create_task(self._read())
                await asyncio.wait((work, read), return_when=asyncio.FIRST_COMPLETED)
            ended, other = (work, read) if work.done() else (read, work)
            await self._end(ended)
        finally:
            self._has_ended = True
            self._mailbox.close()
            self._outbox.close()
            read.cancel()
            await asyncio.wait((work, read))
            for done in self._done_with.values():
                done.set()
        _report(other)

    async def resume(self, connection: Connection) -> None:
        """Continue the session on a new connection. Returns when that connection is no longer needed.

        The old connection is closed if its loss was not detected yet. Raises Refusal if the session is ending.
        """
        self._done_with[connection] = asyncio.Event()
        if self._returned is None or self._returned.done():
            self._connection.is_lost = True
            await self._connection.close(POLICY, "the client has resumed its session by another connection")
            while not self._has_ended and (self._returned is None or self._returned.done()):
                await asyncio.sleep(0.01)
        if self._has_ended or self._returned is None or self._returned.done():
            raise Refusal(GONE, "the session has just ended")
        self._returned.set_result(connection)
        await self._done_with[connection].wait()

    def leave_out_later_frames(self) -> None:
        """Event loop: from now on no frame is taken."""
        self._is_finishing = True

    async def finish(self) -> None:
        """Event loop: returns once what has arrived is answered or the session has ended."""
        self.leave_out_later_frames()
        while not (self._has_ended or self._mailbox.is_idle()):
            await asyncio.sleep(0.01)

    def take_order(self, order: Order) -> bool:
        """Event loop: queue an order behind what the client has sent. Returns whether there was room."""
        if not self._mailbox.has_room():
            return False
        self._mailbox.post(order)
        return True

    def stop_waiting(self) -> None:
        """Stop waiting for the client to reconnect, now and later."""
        self._keep_s = 0.0
        if self._returned is not None:
            self._returned.cancel()

    def _is_lost(self, read: asyncio.Task[None]) -> bool:
        """Whether the reader ended because of a lost connection that this session survives."""
        if self._keep_s <= 0 or read.cancelled():
            return False
        error = read.exception()
        return isinstance(error, ClientGone) or (error is None and self._connection.is_lost)

    async def _wait_for_return(self, work: asyncio.Future[None]) -> bool:
        """Wait for the client to reconnect. Returns whether it did."""
        log.info("connection lost, session kept", extra={"seconds": self._keep_s})
        self._mailbox.begin_connection()
        self._outbox.detach()
        if self._connection in self._done_with:
            self._done_with[self._connection].set()
        self._returned = self._loop.create_future()
        await asyncio.wait((work, self._returned), timeout=self._keep_s, return_when=asyncio.FIRST_COMPLETED)
        if not self._returned.done() or self._returned.cancelled():
            log.info("the client has not come back")
            self._returned.cancel()
            return False
        self._connection = self._returned.result()
        if work.done():
            return False
        with contextlib.suppress(ClientGone):  # lost again: the reader says so
            await self._outbox.attach(self._connection)
        log.info("session resumed")
        return True

    def _wake_reader(self) -> None:
        self._loop.call_soon_threadsafe(self._mailbox_has_space.set)

    async def _end(self, ended: asyncio.Future[None]) -> None:
        """Close the socket according to the result of the reader or the worker, whichever ended first."""
        try:
            ended.result()
            self.why_ended = self._way_of_leaving()
            await self._connection.close()
        except ClientGone:
            self.why_ended = self._connection.dismissal or "the client is gone or does not read"
        except Refusal as refusal:
            self.why_ended = refusal.reason
            await self._connection.refuse(refusal)
        except Exception as error:  # reported to both sides: a fault of this session must not reach another
            log.exception("a session failed")
            self.why_ended = f"the server failed: {type(error).__name__}"
            await self._connection.refuse(_told(error))

    def _way_of_leaving(self) -> str:
        if self._connection.dismissal:
            return self._connection.dismissal
        if self._connection.is_lost:
            return "the connection was lost" + (", the client has not come back" if self._keep_s > 0 else "")
        return "the client left"

    async def _read(self) -> None:
        """Post the client's messages until it leaves. Pauses while too much is unread."""
        connection = self._connection
        while True:
            try:
                message = await connection.receive()
            except BadMessage as bad:
                if isinstance(bad.answer, Dropped):
                    self._metrics.dropped.labels("invalid").inc()
                await connection.send_message(bad.answer)
                continue
            if message is None or isinstance(message, Bye):
                return
            await self._post(message)

    async def _post(self, message: ClientMessage) -> None:
        if isinstance(message, Hello | Watch | Bye):
            raise Refusal(POLICY, f"{type(message).__name__.lower()} was received in a session that captures already")
        if self._is_finishing and isinstance(message, Frame):
            return  # unanswered: its client sends it again where it connects next
        while not self._mailbox.has_room():
            self._mailbox_has_space.clear()
            await self._mailbox_has_space.wait()
        receipt = self._mailbox.post(message)
        if isinstance(message, Frame):
            self._worker.begin_reading()
        if receipt.replaced is not None:
            await self._say_replaced(receipt.replaced)
        if receipt.frames_ahead > FAR_TOO_MANY * self._max_inflight and not self._told_of_window:
            self._told_of_window = True
            await self._say_too_many(receipt.frames_ahead)

    async def _say_replaced(self, frame: Frame) -> None:
        self._metrics.dropped.labels("replaced").inc()
        await self._connection.send_message(Dropped(frame=frame.frame, reason="replaced by a newer frame"))

    async def _say_too_many(self, frames: int) -> None:
        most = self._max_inflight
        reason = f"{frames} frames were sent ahead: keep at most {most} unanswered (welcome.max_inflight)"
        await self._connection.send_message(Error(reason=reason, fatal=False))


def _told(error: Exception) -> Refusal:
    """Refusal for a server error."""
    if type(error).__name__ == "MemoryError":  # OpenCL's or Python's; OpenCL is not loaded where no pipeline needs it
        return Refusal(
            TRY_LATER,
            "the server's device has no memory left for this session: ask for a larger --voxel or a smaller --volume, "
            "or try again later",
        )
    return Refusal(INTERNAL, "the server failed in this session; its log says why")


def _report(other: asyncio.Future[None]) -> None:
    """Log an error of the task (reader or worker) that ended second."""
    if other.cancelled():
        return
    error = other.exception()
    if error is not None and not isinstance(error, ClientGone | Refusal):
        log.error("a session failed while it was ending", exc_info=error)
