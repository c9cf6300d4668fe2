"""What stands between the socket and a session's worker: a latest-wins mailbox for two threads.

A newer frame replaces an unread older one, so that a slow worker gets the newest picture; but never one of a client
that keeps to its window of unanswered frames. Control messages are never replaced and are read before every frame that
came after them.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar

from protocol.messages import Frame, MoveObject, PlaceObject, Quality, RemoveObject, RequestMesh

Control = PlaceObject | MoveObject | RemoveObject | Quality | RequestMesh
T = TypeVar("T", bound=Control)

MAX_WAITING_LETTERS = 64
MAX_WAITING_BYTES = 48 << 20


@dataclass(frozen=True)
class Letter:
    """One unread message and when it came, by `time.perf_counter`."""

    message: Frame | Control
    arrived_s: float = field(default_factory=time.perf_counter)

    @property
    def age_ms(self) -> float:
        """Milliseconds since it was posted."""
        return (time.perf_counter() - self.arrived_s) * 1e3

    @property
    def size_bytes(self) -> int:
        """Bytes of the pictures or the mesh that it carries."""
        match self.message:
            case Frame(color=color, depth=depth):
                return sum(len(picture.data) for picture in (color, depth) if picture is not None)
            case PlaceObject(data=data):
                return len(data)
        return 0


class Receipt(NamedTuple):
    """What posting a message did."""

    replaced: Frame | None
    """The unread frame that a newer one took the place of; nobody will answer it but the poster."""
    frames_ahead: int
    """How many frames the client has sent beyond the one that the worker last took."""


class Mailbox:
    """One writer (the event loop), one reader (the worker)."""

    def __init__(self, window: int | None, on_taken: Callable[[], None] | None = None) -> None:
        """`window`: how many frames may be unanswered before unread ones are replaced; None: no frame ever is.

        `on_taken` is called by the reader's thread after each letter that it takes: there may be room again.
        """
        self._window = window
        self._on_taken = on_taken
        self._unanswered = 0
        self._letters: deque[Letter] = deque()
        self._waiting_bytes = 0
        self._frames_ahead = 0
        self._closed = False
        self._changed = threading.Condition()

    def has_room(self) -> bool:
        """False where so much is unread that the writer should stop reading its socket for a while."""
        with self._changed:
            return len(self._letters) < MAX_WAITING_LETTERS and self._waiting_bytes < MAX_WAITING_BYTES

    def post(self, message: Frame | Control) -> Receipt:
        """Add a message; a frame beyond the window takes the place of the oldest unread one.

        What is posted to a closed mailbox is lost.
        """
        with self._changed:
            if self._closed:
                return Receipt(None, 0)
            replaced = self._make_way() if isinstance(message, Frame) else None
            self._letters.append(Letter(message))
            self._waiting_bytes += self._letters[-1].size_bytes
            self._changed.notify()
            return Receipt(replaced, self._frames_ahead)

    def take(self) -> Letter | None:
        """The oldest letter, waiting for one if need be; None once the mailbox is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._letters or self._closed)
            if self._closed:
                return None
            letter = self._remove(0)
            if isinstance(letter.message, Frame):
                self._frames_ahead = sum(isinstance(other.message, Frame) for other in self._letters)
        if self._on_taken is not None:
            self._on_taken()
        return letter

    def take_more(self, kind: type[T]) -> list[T]:
        """What is next, as long as it is of that kind; waits for nothing."""
        taken: list[T] = []
        with self._changed:
            while self._letters and isinstance(message := self._letters[0].message, kind):
                taken.append(message)
                self._remove(0)
        if taken and self._on_taken is not None:
            self._on_taken()
        return taken

    def note_answered(self) -> None:
        """The reader is about to answer the frame it took last: from now on the client may send another."""
        with self._changed:
            self._unanswered -= 1

    def close(self) -> None:
        """Throw away what is unread and let the reader go."""
        with self._changed:
            self._closed = True
            self._letters.clear()
            self._changed.notify_all()

    def _make_way(self) -> Frame | None:
        """Count a frame that is coming; beyond the window, take out the one that it replaces."""
        self._frames_ahead += 1
        self._unanswered += 1
        if self._window is None or self._unanswered <= self._window:
            return None
        for place, letter in enumerate(self._letters):
            if isinstance(letter.message, Frame):
                self._remove(place)
                self._unanswered -= 1
                return letter.message
        return None

    def _remove(self, place: int) -> Letter:
        letter = self._letters[place]
        del self._letters[place]
        self._waiting_bytes -= letter.size_bytes
        return letter
