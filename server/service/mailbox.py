"""Latest-wins queue between the socket and a session's worker thread.

If a client exceeds its window of unanswered frames, a newer frame replaces the oldest unread one, so that a slow worker
gets recent pictures. Frames within the window are never replaced. Control messages are never replaced, and their order
relative to later frames is kept. The window is of one connection: what came over a connection that was lost is still
worked on, does not count and is not replaced.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar

from protocol.messages import (
    Acknowledged,
    Frame,
    MoveObject,
    PanoramaFormat,
    PlaceObject,
    Quality,
    RemoveObject,
    RequestMesh,
    RequestPanorama,
    Vector3,
)

ObjectRequest = PlaceObject | MoveObject | RemoveObject


@dataclass(frozen=True)
class PanoramaOrder:
    """A request for a panorama that did not come over the session's socket (panorama_routes.py)."""

    format: PanoramaFormat
    position_m: Vector3 | None
    answer: Future[bytes] = field(default_factory=Future)
    """The file, or ValueError with one line; cancelled if the session ends first."""


@dataclass(frozen=True)
class WatcherRequest:
    """A request of a client that watches, for the objects of the session."""

    message: ObjectRequest
    answer: Future[Acknowledged] = field(default_factory=Future)
    """Cancelled if the session ends first."""


Order = PanoramaOrder | WatcherRequest
"""What did not come over the session's socket."""
Control = ObjectRequest | Quality | RequestMesh | RequestPanorama | Order
T = TypeVar("T", bound=Control)

MAX_QUEUED_MESSAGES = 64
MAX_QUEUED_BYTES = 48 << 20


@dataclass(frozen=True)
class QueuedMessage:
    """One unread message and its arrival time by `time.perf_counter`."""

    message: Frame | Control
    connection: int = 0
    """Number of the session's connection over which it came."""
    arrived_s: float = field(default_factory=time.perf_counter)

    @property
    def age_ms(self) -> float:
        """Milliseconds since arrival."""
        return (time.perf_counter() - self.arrived_s) * 1e3

    @property
    def size_bytes(self) -> int:
        """Size of the images or the mesh in the message."""
        match self.message:
            case Frame(color=color, depth=depth):
                return sum(len(picture.data) for picture in (color, depth) if picture is not None)
            case PlaceObject(data=data) | WatcherRequest(message=PlaceObject(data=data)):
                return len(data)
        return 0


class Receipt(NamedTuple):
    """Result of posting a message."""

    replaced: Frame | None
    """The unread frame that was replaced. The caller has to answer it."""
    frames_ahead: int
    """Frames received since the one that the worker took last."""


class Mailbox:
    """One writer (the event loop), one reader (the worker)."""

    def __init__(self, window: int | None, on_taken: Callable[[], None] | None = None) -> None:
        """`window`: unanswered frames above which unread ones are replaced; None: frames are never replaced.

        `on_taken` is called in the reader's thread after each message taken, when there may be space again.
        """
        self._window = window
        self._on_taken = on_taken
        self._unanswered = 0
        self._connection = self._taken_from = 0
        """Number of the present connection, and of the one over which the message taken last came."""
        self._messages: deque[QueuedMessage] = deque()
        self._queued_bytes = 0
        self._frames_ahead = 0
        self._closed = False
        self._is_reader_busy = False
        self._changed = threading.Condition()

    def has_room(self) -> bool:
        """False if so much is unread that the writer should pause reading its socket."""
        with self._changed:
            return len(self._messages) < MAX_QUEUED_MESSAGES and self._queued_bytes < MAX_QUEUED_BYTES

    def post(self, message: Frame | Control) -> Receipt:
        """Add a message; a frame beyond the window replaces the oldest unread one.

        Messages posted to a closed mailbox are discarded; orders are cancelled.
        """
        with self._changed:
            if self._closed:
                cancel_order(message)
                return Receipt(None, 0)
            replaced = self._replace_unread() if isinstance(message, Frame) else None
            self._messages.append(QueuedMessage(message, self._connection))
            self._queued_bytes += self._messages[-1].size_bytes
            self._changed.notify()
            return Receipt(replaced, self._frames_ahead)

    def take(self) -> QueuedMessage | None:
        """Wait for the oldest message and remove it; None once the mailbox is closed."""
        with self._changed:
            self._is_reader_busy = False
            self._changed.wait_for(lambda: self._messages or self._closed)
            if self._closed:
                return None
            self._is_reader_busy = True
            queued = self._remove(0)
            self._taken_from = queued.connection
            if isinstance(queued.message, Frame):
                self._frames_ahead = sum(self._is_replaceable(other) for other in self._messages)
        if self._on_taken is not None:
            self._on_taken()
        return queued

    def take_while(self, kind: type[T]) -> list[T]:
        """Remove the next messages while they are of type `kind` and of the last one's connection. Does not wait."""
        taken: list[T] = []
        with self._changed:
            while self._messages and isinstance(message := self._messages[0].message, kind):
                if self._messages[0].connection != self._taken_from:
                    break
                taken.append(message)
                self._remove(0)
        if taken and self._on_taken is not None:
            self._on_taken()
        return taken

    def show_next_frame(self, to: Callable[[Frame], None]) -> None:
        """Any thread: `to` is called with the oldest unread frame, if any, which is not taken before it returns."""
        with self._changed:
            for queued in self._messages:
                if isinstance(queued.message, Frame):
                    to(queued.message)
                    return

    def wait_or(self, other: Future[None]) -> None:
        """The reader waits until `take` would not wait, or `other` is done."""
        other.add_done_callback(lambda _: self._wake())
        with self._changed:
            self._changed.wait_for(lambda: self._messages or self._closed or other.done())

    def is_idle(self) -> bool:
        """Whether nothing is unread and the reader has finished the last message: it waits for another one."""
        with self._changed:
            return not self._messages and not self._is_reader_busy

    def note_answered(self, connection: int) -> None:
        """Call before answering a frame that was taken, which came over that connection: the client may then send
        another."""
        with self._changed:
            if connection == self._connection:
                self._unanswered -= 1

    def begin_connection(self) -> None:
        """The connection is lost; what comes from now on comes over another one, with a window of its own."""
        with self._changed:
            self._connection += 1
            self._unanswered = self._frames_ahead = 0

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify()

    def close(self) -> None:
        """Discard unread messages and wake the reader."""
        with self._changed:
            self._closed = True
            for queued in self._messages:
                cancel_order(queued.message)
            self._messages.clear()
            self._changed.notify_all()

    def _replace_unread(self) -> Frame | None:
        """Count a new frame; beyond the window, remove and return the oldest unread one."""
        self._frames_ahead += 1
        self._unanswered += 1
        if self._window is None or self._unanswered <= self._window:
            return None
        for index, queued in enumerate(self._messages):
            if self._is_replaceable(queued):
                self._remove(index)
                self._unanswered -= 1
                assert isinstance(queued.message, Frame)
                return queued.message
        return None

    def _is_replaceable(self, queued: QueuedMessage) -> bool:
        return isinstance(queued.message, Frame) and queued.connection == self._connection

    def _remove(self, index: int) -> QueuedMessage:
        queued = self._messages[index]
        del self._messages[index]
        self._queued_bytes -= queued.size_bytes
        return queued


def cancel_order(message: Frame | Control) -> None:
    """Tell whoever waits for an order that nobody fills it. Other messages are left as they are."""
    if isinstance(message, PanoramaOrder | WatcherRequest):
        message.answer.cancel()
