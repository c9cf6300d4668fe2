"""One capturing client: the event loop reads its socket into a mailbox, one thread works on it and answers."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from concurrent.futures import CancelledError, Executor, Future

from msgspec import structs

from protocol.codec import encode
from protocol.messages import Bye, ClientMessage, Dropped, Error, Frame, Hello, Watch, Welcome
from server.service.broadcast import Broadcast
from server.service.connection import GONE, INTERNAL, POLICY, TRY_LATER, BadMessage, ClientGone, Connection, Refusal
from server.service.mailbox import Mailbox
from server.service.worker import Worker, Workshop

MAX_INFLIGHT = 2
FAR_TOO_MANY_INFLIGHT = 4 * MAX_INFLIGHT

log = logging.getLogger(__name__)


class LoopOutlet:
    """A worker's way out: hands its bytes to the event loop and waits until the socket has taken them.

    While the client's connection is lost, what is sent is lost too; the session says what has to be sent again.
    """

    def __init__(
        self, welcome: Welcome, connection: Connection, broadcast: Broadcast, *, is_kept: bool, lock: bytes = b""
    ) -> None:
        """`welcome`: but for the device. `is_kept`: a lost connection does not end the session. `lock`: of its room."""
        self._lock = lock
        self._welcome = welcome
        self._connection: Connection | None = connection
        self._broadcast = broadcast
        self._is_kept = is_kept
        self._loop = asyncio.get_running_loop()
        self._sending: Future[None] | None = None
        self._closed = False
        self.waited_s = 0.0

    @property
    def session(self) -> str:
        """Its name."""
        return self._welcome.session

    def greet(self, device_name: str) -> None:
        """Worker's thread: welcome the client and let others watch it. Raises ClientGone."""
        self._welcome = structs.replace(self._welcome, device=device_name)
        shown = structs.replace(self._welcome, key=None)  # the key is nobody else's business
        self._loop.call_soon_threadsafe(self._open_to_watchers, encode(shown))
        self.send(encode(self._welcome))

    def _open_to_watchers(self, welcome: bytes) -> None:
        if not self._closed:
            self._broadcast.open_session(self.session, welcome, self._welcome.room, self._lock)

    def send(self, data: bytes) -> None:
        """Worker's thread: send to the capturing client. Raises ClientGone where that ends the session."""
        if self._closed:
            raise ClientGone
        connection = self._connection
        if connection is None:
            return
        self._sending = asyncio.run_coroutine_threadsafe(self._send_timed(connection, data), self._loop)
        try:
            self._sending.result()
        except (CancelledError, ClientGone) as error:
            if self._closed or not self._is_kept:
                raise ClientGone from error

    async def _send_timed(self, connection: Connection, data: bytes) -> None:
        began = self._loop.time()
        try:
            await connection.send(data)
        finally:
            self.waited_s += self._loop.time() - began

    def is_watched(self) -> bool:
        """Worker's thread: whether somebody watches this session."""
        return self._broadcast.is_watched(self.session)

    def publish(self, messages: tuple[bytes, ...]) -> None:
        """Worker's thread: give the watchers their copy, without waiting."""
        self._loop.call_soon_threadsafe(self._broadcast.publish, self.session, messages)

    def detach(self) -> None:
        """Event loop's thread: the connection is lost, and a worker that is sending is let go."""
        self._connection = None
        self._let_go()

    async def attach(self, connection: Connection) -> None:
        """Event loop's thread: the client is back. Raises ClientGone if it is not."""
        await connection.send(encode(structs.replace(self._welcome, resumed=True)))
        self._connection = connection

    def close(self) -> None:
        """Event loop's thread: nothing more can be sent, and a worker that is sending is let go."""
        self._closed = True
        self._broadcast.close_session(self.session)
        self._let_go()

    def _let_go(self) -> None:
        if self._sending is not None:
            self._sending.cancel()


class CaptureSession:
    """From a client's hello to its end, whoever ends it; its connection may be lost in between."""

    def __init__(self, connection: Connection, hello: Hello, workshop: Workshop, outlet: LoopOutlet) -> None:
        self._connection = connection
        self._keep_s = hello.keep_s
        self._metrics = workshop.metrics
        self._outlet = outlet
        self._loop = asyncio.get_running_loop()
        self._room = asyncio.Event()
        self._told_of_window = False
        self._mailbox = Mailbox(None if hello.wishes.lossless else MAX_INFLIGHT, self._wake_reader)
        self._worker = Worker(workshop, hello, self._mailbox, outlet)
        self._returned: asyncio.Future[Connection] | None = None
        """While the connection is lost: the one by which the client comes back."""
        self._has_ended = False
        self._done_with: dict[Connection, asyncio.Event] = {}
        """Connections that resumed this session, and whether it has no more use for them."""

    async def run(self, threads: Executor) -> None:
        """Serve the client until it leaves, must leave, or the worker fails. Returns when the worker has ended."""
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
            self._outlet.close()
            read.cancel()
            await asyncio.wait((work, read))
            for done in self._done_with.values():
                done.set()
        _report(other)

    async def resume(self, connection: Connection) -> None:
        """Go on with a client that is back by another connection. Returns when that is not needed any more.

        Where the old connection has not been found lost yet, it is now. Raises Refusal where the session is ending.
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

    def give_up(self) -> None:
        """Wait no more for a client that is away, now or later."""
        self._keep_s = 0.0
        if self._returned is not None:
            self._returned.cancel()

    def _is_lost(self, read: asyncio.Task[None]) -> bool:
        """Whether the reader has ended by a connection that broke, which this session outlives."""
        if self._keep_s <= 0 or read.cancelled():
            return False
        error = read.exception()
        return isinstance(error, ClientGone) or (error is None and self._connection.is_lost)

    async def _wait_for_return(self, work: asyncio.Future[None]) -> bool:
        """Whether the client is back."""
        log.info("connection lost, session kept", extra={"seconds": self._keep_s})
        self._outlet.detach()
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
            await self._outlet.attach(self._connection)
        log.info("session resumed")
        return True

    def _wake_reader(self) -> None:
        self._loop.call_soon_threadsafe(self._room.set)

    async def _end(self, ended: asyncio.Future[None]) -> None:
        """Close the socket with what the reader or the worker ended with."""
        try:
            ended.result()
            await self._connection.close()
        except ClientGone:
            log.info("a client left")
        except Refusal as refusal:
            await self._connection.refuse(refusal)
        except Exception as error:  # reported to both sides: a fault of this session must not reach another
            log.exception("a session failed")
            await self._connection.refuse(_told(error))

    async def _read(self) -> None:
        """Post what the client sends until it leaves; stops reading while too much is unread."""
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
        while not self._mailbox.has_room():
            self._room.clear()
            await self._room.wait()
        receipt = self._mailbox.post(message)
        if receipt.replaced is not None:
            await self._say_replaced(receipt.replaced)
        if receipt.frames_ahead > FAR_TOO_MANY_INFLIGHT and not self._told_of_window:
            self._told_of_window = True
            await self._say_too_many(receipt.frames_ahead)

    async def _say_replaced(self, frame: Frame) -> None:
        self._metrics.dropped.labels("replaced").inc()
        await self._connection.send_message(Dropped(frame=frame.frame, reason="replaced by a newer frame"))

    async def _say_too_many(self, frames: int) -> None:
        reason = f"{frames} frames were sent ahead: keep at most {MAX_INFLIGHT} unanswered (welcome.max_inflight)"
        await self._connection.send_message(Error(reason=reason, fatal=False))


def _told(error: Exception) -> Refusal:
    """What a client is told of a fault that is not its own."""
    if type(error).__name__ == "MemoryError":  # OpenCL's or Python's; OpenCL is not loaded where no pipeline needs it
        return Refusal(
            TRY_LATER,
            "the server's device has no memory left for this session: ask for a larger --voxel or a smaller --volume, "
            "or try again later",
        )
    return Refusal(INTERNAL, "the server failed in this session; its log says why")


def _report(other: asyncio.Future[None]) -> None:
    """Log what the second of reader and worker to end was stopped by, unless that was the first one's ending."""
    if other.cancelled():
        return
    error = other.exception()
    if error is not None and not isinstance(error, ClientGone | Refusal):
        log.error("a session failed while it was ending", exc_info=error)
