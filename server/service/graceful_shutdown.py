"""Graceful shutdown: refuse new clients, answer what has arrived, notify the clients, end sessions, save the rooms."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable, Iterator

from server.service.edge.connection import RESTART, TRY_LATER, Connection, Refusal

GOODBYE = "the server is stopping: connect again in a while"
DRAINING = "this server is draining, it takes nobody new: connect again in a while"
SHARE_OF_SESSIONS = 0.5
"""Share of the time limit in which sessions may end; the rest is for saving."""

ANSWER_PATIENCE_S = 2.0
"""Time limit for answering the frames that have arrived, at most `SHARE_OF_ANSWERS` of all: most take far less, and
the rest of the time is for the clients' goodbye and for saving."""
SHARE_OF_ANSWERS = 0.3

log = logging.getLogger(__name__)


class GracefulShutdown:
    """Shutdown of one service. Must be used on its event loop."""

    def __init__(self) -> None:
        self.is_draining = False
        self.save_hooks: list[Callable[[], Awaitable[None]]] = []
        """Awaited together after the sessions have ended, to save what must not be lost."""
        self.begin_hooks: list[Callable[[], None]] = []
        """Called first, so that nothing waits for clients that will not return."""
        self.answer_hooks: list[Callable[[], Awaitable[None]]] = []
        """Awaited together before the clients are dismissed, until they have been answered."""
        self._connections: set[Connection] = set()

    @contextlib.contextmanager
    def registered(self, connection: Connection) -> Iterator[None]:
        """Context in which the client is notified of a shutdown. Raises Refusal while draining."""
        if self.is_draining:
            raise Refusal(TRY_LATER, DRAINING)
        self._connections.add(connection)
        try:
            yield
        finally:
            self._connections.discard(connection)

    async def drain(self, patience_s: float) -> None:
        """Dismiss all clients, wait until their sessions have ended, save. Takes at most `patience_s`."""
        if self.is_draining:
            return
        self.is_draining = True
        for let_go in self.begin_hooks:
            let_go()
        log.info("draining", extra={"connections": len(self._connections)})
        start_s = asyncio.get_running_loop().time()
        await self._answer(min(ANSWER_PATIENCE_S, SHARE_OF_ANSWERS * patience_s))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(SHARE_OF_SESSIONS * patience_s):
                await asyncio.gather(*(connection.dismiss(RESTART, GOODBYE) for connection in tuple(self._connections)))
                while self._connections:
                    await asyncio.sleep(0.01)
        if self._connections:
            log.warning("sessions have not ended in time", extra={"connections": len(self._connections)})
        await self._save(patience_s - (asyncio.get_running_loop().time() - start_s))

    async def _answer(self, patience_s: float) -> None:
        try:
            async with asyncio.timeout(patience_s):
                await asyncio.gather(*(answer() for answer in self.answer_hooks), return_exceptions=True)
        except TimeoutError:
            log.warning("frames were given up, they took too long", extra={"limit_s": patience_s})

    async def _save(self, patience_s: float) -> None:
        tasks = [asyncio.ensure_future(save()) for save in self.save_hooks]
        if not tasks:
            return
        done, late = await asyncio.wait(tasks, timeout=max(patience_s, 0.0))
        for task in done:
            if not task.cancelled() and (error := task.exception()) is not None:
                log.error("what must not be lost could not be saved", exc_info=error)
        for task in late:
            task.cancel()
        if late:
            log.error("saving took too long and was given up", extra={"unsaved": len(late)})
