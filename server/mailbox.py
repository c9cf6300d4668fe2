"""What stands between the socket and a session's worker: a latest-wins mailbox for two threads.

A newer frame replaces an unread older one, so that a slow worker always gets the newest picture. Control messages are
never replaced and are read before every frame that came after them.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from protocol.messages import Frame, MoveObject, PlaceObject, Quality, RemoveObject

Control = PlaceObject | MoveObject | RemoveObject | Quality

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
                return len(color.data) + len(depth.data)
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
    """One writer (the event loop), one reader (the worker). With `lossless`, no frame is ever replaced."""

    def __init__(self, lossless: bool = False, on_taken: Callable[[], None] | None = None) -> None:
        """`on_taken` is called by the reader's thread after each letter that it takes: there may be room again."""
        self._lossless = lossless
        self._on_taken = on_taken
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
        """Add a message; a frame takes the place of the unread frame, if any. Posting to a closed mailbox is lost."""
        with self._changed:
            if self._closed:
                return Receipt(None, 0)
            is_frame = isinstance(message, Frame)
            replaced = self._take_out_unread_frame() if is_frame and not self._lossless else None
            self._add(Letter(message))
            self._frames_ahead += is_frame
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

    def close(self) -> None:
        """Throw away what is unread and let the reader go."""
        with self._changed:
            self._closed = True
            self._letters.clear()
            self._changed.notify_all()

    def _take_out_unread_frame(self) -> Frame | None:
        for place, letter in enumerate(self._letters):
            if isinstance(letter.message, Frame):
                self._remove(place)
                return letter.message
        return None

    def _add(self, letter: Letter) -> None:
        self._letters.append(letter)
        self._waiting_bytes += letter.size_bytes

    def _remove(self, place: int) -> Letter:
        letter = self._letters[place]
        del self._letters[place]
        self._waiting_bytes -= letter.size_bytes
        return letter
