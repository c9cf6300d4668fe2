"""How a server leaves in order: nobody new, everybody told, what is kept saved."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable, Iterator

from server.service.connection import RESTART, TRY_LATER, Connection, Refusal

GOODBYE = "the server is stopping: connect again in a while"
DRAINING = "this server is draining, it takes nobody new: connect again in a while"
SHARE_OF_SESSIONS = 0.5
"""Of the patience, for sessions to end; the rest is for saving."""

log = logging.getLogger(__name__)


class Departure:
    """Of one service, on its event loop."""

    def __init__(self) -> None:
        self.has_begun = False
        self.saving: list[Callable[[], Awaitable[None]]] = []
        """Awaited, all at once, when the sessions have ended: what must not be lost is to be saved by then."""
        self.on_begin: list[Callable[[], None]] = []
        """Called first: who waits for a client that may not come is let go."""
        self._present: set[Connection] = set()

    @contextlib.contextmanager
    def present(self, connection: Connection) -> Iterator[None]:
        """While it lasts, the client is told when the server leaves. Raises Refusal once it is leaving."""
        if self.has_begun:
            raise Refusal(TRY_LATER, DRAINING)
        self._present.add(connection)
        try:
            yield
        finally:
            self._present.discard(connection)

    async def drain(self, patience_s: float) -> None:
        """Tell all clients, wait until their sessions have ended, save. Takes no longer than `patience_s`."""
        if self.has_begun:
            return
        self.has_begun = True
        for let_go in self.on_begin:
            let_go()
        log.info("draining", extra={"connections": len(self._present)})
        start_s = asyncio.get_running_loop().time()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(SHARE_OF_SESSIONS * patience_s):
                await asyncio.gather(*(connection.dismiss(RESTART, GOODBYE) for connection in tuple(self._present)))
                while self._present:
                    await asyncio.sleep(0.01)
        if self._present:
            log.warning("sessions have not ended in time", extra={"connections": len(self._present)})
        await self._save(patience_s - (asyncio.get_running_loop().time() - start_s))

    async def _save(self, patience_s: float) -> None:
        tasks = [asyncio.ensure_future(save()) for save in self.saving]
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
