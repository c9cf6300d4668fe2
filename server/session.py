"""One capturing client: the event loop reads its socket into a mailbox, one thread works on it and answers."""

from __future__ import annotations

import asyncio
import logging
from concurrent.futures import CancelledError, Executor, Future

from protocol.codec import encode
from protocol.messages import Bye, ClientMessage, Dropped, Error, Frame, Hello, Watch, Welcome
from server.broadcast import Broadcast
from server.connection import INTERNAL, POLICY, BadMessage, ClientGone, Connection, Refusal
from server.mailbox import Mailbox
from server.worker import Worker, Workshop

MAX_INFLIGHT = 2
FAR_TOO_MANY_INFLIGHT = 4 * MAX_INFLIGHT

log = logging.getLogger(__name__)


class LoopOutlet:
    """A worker's way out: hands its bytes to the event loop and waits until the socket has taken them."""

    def __init__(self, session: str, server_name: str, connection: Connection, broadcast: Broadcast) -> None:
        self._session = session
        self._server_name = server_name
        self._connection = connection
        self._broadcast = broadcast
        self._loop = asyncio.get_running_loop()
        self._sending: Future[None] | None = None
        self._closed = False

    def greet(self, device_name: str) -> None:
        """Worker's thread: welcome the client and let others watch it. Raises ClientGone."""
        welcome = encode(
            Welcome(session=self._session, server=self._server_name, device=device_name, max_inflight=MAX_INFLIGHT)
        )
        self._loop.call_soon_threadsafe(self._open_to_watchers, welcome)
        self.send(welcome)

    def _open_to_watchers(self, welcome: bytes) -> None:
        if not self._closed:
            self._broadcast.open_session(self._session, welcome)

    def send(self, data: bytes) -> None:
        """Worker's thread: send to the capturing client. Raises ClientGone."""
        if self._closed:
            raise ClientGone
        self._sending = asyncio.run_coroutine_threadsafe(self._connection.send(data), self._loop)
        try:
            self._sending.result()
        except CancelledError as error:
            raise ClientGone from error

    def is_watched(self) -> bool:
        """Worker's thread: whether somebody watches this session."""
        return self._broadcast.is_watched(self._session)

    def publish(self, messages: tuple[bytes, ...]) -> None:
        """Worker's thread: give the watchers their copy, without waiting."""
        self._loop.call_soon_threadsafe(self._broadcast.publish, self._session, messages)

    def close(self) -> None:
        """Event loop's thread: nothing more can be sent, and a worker that is sending is let go."""
        self._closed = True
        self._broadcast.close_session(self._session)
        if self._sending is not None:
            self._sending.cancel()


class CaptureSession:
    """From a client's hello to its end, whoever ends it."""

    def __init__(self, connection: Connection, hello: Hello, workshop: Workshop, outlet: LoopOutlet) -> None:
        self._connection = connection
        self._metrics = workshop.metrics
        self._outlet = outlet
        self._loop = asyncio.get_running_loop()
        self._room = asyncio.Event()
        self._told_of_window = False
        self._mailbox = Mailbox(None if hello.wishes.lossless else MAX_INFLIGHT, self._wake_reader)
        self._worker = Worker(workshop, hello, self._mailbox, outlet)

    async def run(self, threads: Executor) -> None:
        """Serve the client until it leaves, must leave, or the worker fails. Returns when the worker has ended."""
        work = self._loop.run_in_executor(threads, self._worker.run)
        read = asyncio.create_task(self._read())
        try:
            await asyncio.wait((work, read), return_when=asyncio.FIRST_COMPLETED)
            ended, other = (work, read) if work.done() else (read, work)
            await self._end(ended)
        finally:
            self._mailbox.close()
            self._outlet.close()
            read.cancel()
            await asyncio.wait((work, read))
        _report(other)

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
        except Exception:  # reported to both sides: a fault of this session must not reach another
            log.exception("a session failed")
            await self._connection.refuse(Refusal(INTERNAL, "the server failed in this session; its log says why"))

    async def _read(self) -> None:
        """Post what the client sends until it leaves; stops reading while too much is unread."""
        while True:
            try:
                message = await self._connection.receive()
            except BadMessage as bad:
                await self._connection.send_message(bad.answer)
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


def _report(other: asyncio.Future[None]) -> None:
    """Log what the second of reader and worker to end was stopped by, unless that was the first one's ending."""
    if other.cancelled():
        return
    error = other.exception()
    if error is not None and not isinstance(error, ClientGone | Refusal):
        log.error("a session failed while it was ending", exc_info=error)
