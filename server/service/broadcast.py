"""Sends a capturing session's pictures to its watchers, and takes what they ask of its objects.

A slow watcher misses pictures and delays nobody.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Iterator
from hmac import compare_digest
from typing import NamedTuple

from protocol.codec import encode
from protocol.messages import Acknowledged, Bye, MoveObject, PlaceObject, RemoveObject
from server.service.edge.connection import POLICY, BadMessage, Connection, Refusal
from server.service.mailbox import ObjectRequest

AskSession = Callable[[str | None, ObjectRequest], Awaitable[Acknowledged]]
WATCHERS_SEND = "a watching client sends requests for objects and bye"


class Watcher:
    """Pending messages of one watching client: only the latest of each kind is kept."""

    def __init__(self, session: str | None, room: str | None = None, lock: bytes = b"") -> None:
        """`session` None follows any session (in `room`, if given). `lock`: digest of the client's room key."""
        self.follows_any = session is None
        self.room = room
        self.lock = lock
        self.session = session
        self._news: dict[str, tuple[bytes, ...]] = {}
        self._answers: list[bytes] = []
        """To its own requests; one at a time is under way."""
        self._ended = False
        self._changed = asyncio.Event()

    def post(self, kind: str, messages: tuple[bytes, ...]) -> None:
        """Queue encoded messages; unread ones of the same kind are replaced."""
        self._news[kind] = messages
        self._changed.set()

    def answer(self, message: bytes) -> None:
        """Queue an encoded answer to the watcher's own request."""
        self._answers.append(message)
        self._changed.set()

    def attach(self, session: str | None, welcome: bytes) -> None:
        """Follow `session` from now on and drop pending pictures of another one."""
        self.session = session
        self._news.pop("pictures", None)
        self.post("welcome", (welcome,))

    def end(self) -> None:
        """Mark the watched session as ended."""
        self._ended = True
        self._changed.set()

    async def take(self) -> tuple[bytes, ...]:
        """Wait for unread messages and return them; empty once the watched session has ended."""
        await self._changed.wait()
        self._changed.clear()
        messages = (*self._answers, *(message for group in self._news.values() for message in group))
        self._news.clear()
        self._answers.clear()
        if self._ended:
            self._changed.set()
        return messages


class _Place(NamedTuple):
    room: str | None
    lock: bytes


class Broadcast:
    """Maps watchers to sessions. All methods except `is_watched` must be called on the event loop."""

    def __init__(self) -> None:
        self._welcomes: dict[str, bytes] = {}
        self._places: dict[str, _Place] = {}
        self._watchers: list[Watcher] = []
        self._watched: frozenset[str | None] = frozenset()

    def is_watched(self, session: str) -> bool:
        """Whether anybody watches this session. Thread-safe."""
        return session in self._watched

    def open_session(self, name: str, welcome: bytes, room: str | None = None, lock: bytes = b"") -> None:
        """Let clients with the room's key watch the session. Each first receives `welcome`."""
        self._welcomes[name], self._places[name] = welcome, _Place(room, lock)
        for watcher in self._watchers:
            if watcher.session is None and self._shows(name, watcher):
                watcher.attach(name, welcome)
        self._note_watched()

    def close_session(self, name: str) -> None:
        """End the session. Watchers of any session move on to the newest one left; the others end."""
        if self._welcomes.pop(name, None) is None:
            return
        del self._places[name]
        for watcher in self._watchers:
            if watcher.session == name:
                self._move_on(watcher)
        self._note_watched()

    def find(self, session: str | None, room: str | None = None, lock: bytes = b"") -> str | None:
        """The named session, or the newest one (in `room`), if it may be seen with this key; None if there is none."""
        watcher = Watcher(session, room, lock)
        if session is None:
            return self._newest(watcher)
        return session if session in self._welcomes and self._shows(session, watcher) else None

    @contextlib.contextmanager
    def watcher(
        self, session: str | None, waiting: bytes, room: str | None = None, lock: bytes = b""
    ) -> Iterator[Watcher]:
        """A watcher of the named session, or of the newest one (in `room`).

        It first receives `waiting` if there is no session yet. Raises Refusal if `session` does not exist or may not
        be seen with this key.
        """
        watcher = Watcher(session, room, lock)
        seen = [name for name in self._welcomes if self._shows(name, watcher)]
        if session is not None and session not in seen:
            raise Refusal(
                POLICY, f"there is no session {session!r} to watch; sessions now: {', '.join(seen) or 'none'}"
            )
        name = session or self._newest(watcher)
        watcher.attach(name, self._welcomes[name] if name else waiting)
        self._watchers.append(watcher)
        self._note_watched()
        try:
            yield watcher
        finally:
            self._watchers.remove(watcher)
            self._note_watched()

    def publish(self, session: str, messages: tuple[bytes, ...]) -> None:
        """Send one frame's encoded light and composite to the session's watchers."""
        for watcher in self._watchers:
            if watcher.session == session:
                watcher.post("pictures", messages)

    def _newest(self, watcher: Watcher) -> str | None:
        return next((name for name in reversed(self._welcomes) if self._shows(name, watcher)), None)

    def _shows(self, name: str, watcher: Watcher) -> bool:
        """Whether the watcher may see this session: same room, and the room's key fits."""
        place = self._places[name]
        has_key = not place.lock or compare_digest(place.lock, watcher.lock)
        return has_key and watcher.room in (None, place.room)

    def _move_on(self, watcher: Watcher) -> None:
        heir = self._newest(watcher)
        if not watcher.follows_any:
            watcher.end()
        elif heir is None:
            watcher.session = None
        else:
            watcher.attach(heir, self._welcomes[heir])

    def _note_watched(self) -> None:
        self._watched = frozenset(watcher.session for watcher in self._watchers)


async def serve_watcher(connection: Connection, watcher: Watcher, ask: AskSession) -> None:
    """Send messages to a watcher until it leaves or its session ends. Raises Refusal, ClientGone.

    `ask`: has the watched session apply a request.
    """
    forward = asyncio.create_task(_forward(connection, watcher))
    listen = asyncio.create_task(_listen(connection, watcher, ask))
    try:
        ended, _ = await asyncio.wait((forward, listen), return_when=asyncio.FIRST_COMPLETED)
        for task in ended:
            task.result()
    finally:
        forward.cancel()
        listen.cancel()
    await connection.close()


async def _forward(connection: Connection, watcher: Watcher) -> None:
    while messages := await watcher.take():
        for message in messages:
            await connection.send(message)
    await connection.send_message(Bye(reason="the session is over"))


async def _listen(connection: Connection, watcher: Watcher, ask: AskSession) -> None:
    """Take requests one after the other, until the watcher leaves."""
    while True:
        try:
            message = await connection.receive()
        except BadMessage as bad:
            if not isinstance(bad.answer, Acknowledged):
                raise Refusal(POLICY, WATCHERS_SEND) from bad
            watcher.answer(encode(bad.answer))
            continue
        if message is None or isinstance(message, Bye):
            return
        if not isinstance(message, PlaceObject | MoveObject | RemoveObject):
            raise Refusal(POLICY, f"{WATCHERS_SEND}, not {type(message).__name__.lower()}")
        watcher.answer(encode(await ask(watcher.session, message)))
