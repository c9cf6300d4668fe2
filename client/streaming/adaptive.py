"""What a link carries: JPEG quality, picture size and rate, from the round trips of the frames that were answered.

A frame's time on the way is its round trip less the server's computing and less what it waited there: behind the frame
before it, or for a device that others use too.
What exceeds the link's own delay is transfer, from which throughput follows. Three decisions rest on it:

- *rate*: the next frame is sent when the slowest of computing, sending and returning is done with the one before, so
  that no frame waits in a queue and grows old there; the client takes its newest frame at that moment.
- *quality*: the highest rung of `LADDER` whose transfer keeps below `SHARE` of a frame's time at the wanted rate, or at
  the server's where that is slower, but not for longer than a person would see.
- *going back*: a rung that proved too heavy is tried again later and later; a link that eases is found out all
  the same.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

from client.streaming.coding import Coding

LADDER = (
    Coding(90),
    Coding(80, depth_level=6),
    Coding(65, depth_level=6),
    Coding(50, depth_level=6),
    Coding(75, 2, depth_level=6),
    Coding(50, 2, depth_level=6),
)
"""From the best to the cheapest. Depth is exact on every rung, or rounded as asked for."""
SHARE = 0.9
"""Of the time between frames that the busier way may take."""
LONGEST_TRANSFER_S = 0.2
"""Where the server is slower still, quality costs nothing but age: a way may not take more than a share of this."""
SMOOTHING = 0.25
"""Weight of the newest measurement."""
BAD_ANSWERS = 2
"""So many frames in a row that took too long: one rung down."""
GOOD_ANSWERS, MOST_GOOD_ANSWERS = 8, 128
"""So many in a row with time to spare: one up. Doubled each time that it was wrong."""
SPARE = 0.8
"""A rung up is tried where transfer takes less than this share of what it may."""
WINDOW = 32


@dataclass(frozen=True)
class Measured:
    """One answered frame; times of one clock, in seconds."""

    sent_s: float
    """Before its first byte went."""
    answered_s: float
    computed_s: float
    """Of it, in the server's pipeline."""
    bytes_up: int
    bytes_down: int
    waited_s: float | None = None
    """At the server, before it was computed; None: the server does not say it."""


class Adaptive:
    """Pure logic: told of answers, asked for the rung and for when the next frame may go."""

    def __init__(
        self, wanted_interval_s: float, delay_s: float = math.inf, depth_noise_per_m: float | None = None
    ) -> None:
        """`wanted_interval_s`: of the source's frames. `delay_s`: round trip of an empty message, where measured."""
        self._ladder = tuple(replace(rung, depth_noise_per_m=depth_noise_per_m) for rung in LADDER)
        self._wanted_s = wanted_interval_s
        self._delay_s = delay_s
        self._rung = 0
        self._ways: deque[float] = deque(maxlen=WINDOW)
        self._last_answer_s, self._last_computed_s = -math.inf, 0.0
        self._computed_s = self._way_s = 0.0
        self._transfer_s = 0.0
        self._bytes_up = self._bytes_down = 0.0
        self._bad = self._good = 0
        self._patience = GOOD_ANSWERS
        self._climbed = False
        self._told = 0
        self._stepped_s = -math.inf

    @property
    def rung(self) -> int:
        """Position in `LADDER`."""
        return self._rung

    @property
    def coding(self) -> Coding:
        """How the next frame is to be sent."""
        return self._ladder[self._rung]

    @property
    def bytes_per_s(self) -> float | None:
        """What the link was seen to carry, both ways together; None where it was never the limit."""
        total = self._bytes_up + self._bytes_down
        return total / self._transfer_s if self._transfer_s > 1e-3 else None

    @property
    def busy_s(self) -> float:
        """Of the slowest stage that a frame passes: the next one would wait there. Stages overlap and do not add."""
        one_way_s = self._transfer_s * _greater_share(self._bytes_up, self._bytes_down)
        return max(self._computed_s, one_way_s)

    def may_send(self, now_s: float, last_sent_s: float, unanswered: int) -> bool:
        """Whether a frame sent now would wait for nobody. The source's own rate is the caller's to keep."""
        # The frame on the way was begun when it was sent, or when the answer before it left the server.
        begun_s = max(last_sent_s, self._last_answer_s - self._way_s)
        return unanswered == 0 or (unanswered == 1 and now_s - begun_s >= self.busy_s)

    def note(self, frame: Measured) -> None:
        """A frame was answered."""
        waited_s = frame.waited_s
        if waited_s is None:  # while the one before was computed, which was not answered yet when this one went
            waited_s = min(max(self._last_answer_s - frame.sent_s, 0.0), self._last_computed_s)
        way_s = max(frame.answered_s - frame.sent_s - frame.computed_s - waited_s, 0.0)
        self._last_answer_s, self._last_computed_s = frame.answered_s, frame.computed_s
        self._ways.append(way_s)
        transfer_s = max(way_s - min(self._delay_s, *self._ways), 0.0)
        self._told += 1
        weight = max(SMOOTHING, 1 / self._told)
        self._way_s += weight * (way_s - self._way_s)
        self._computed_s += weight * (frame.computed_s - self._computed_s)
        self._transfer_s += weight * (transfer_s - self._transfer_s)
        self._bytes_up += weight * (frame.bytes_up - self._bytes_up)
        self._bytes_down += weight * (frame.bytes_down - self._bytes_down)
        if frame.sent_s >= self._stepped_s:  # those that were under way then tell of the rung before
            self._choose(transfer_s * _greater_share(frame.bytes_up, frame.bytes_down), frame.answered_s)

    def note_lost(self) -> None:
        """The connection was restored: what was measured before says nothing of it, and a rung down is safe."""
        self._ways.clear()
        self._last_answer_s = -math.inf
        self._step(+1, -math.inf)

    def _choose(self, one_way_s: float, now_s: float) -> None:
        most_s = SHARE * min(max(self._wanted_s, self._computed_s), max(self._wanted_s, LONGEST_TRANSFER_S))
        self._bad = self._bad + 1 if one_way_s > most_s else 0
        self._good = self._good + 1 if one_way_s < SPARE * most_s else 0
        if self._bad >= BAD_ANSWERS:
            if self._climbed:
                self._patience = min(2 * self._patience, MOST_GOOD_ANSWERS)
            self._step(+1, now_s)
        elif self._good >= self._patience:
            if self._climbed:  # the last step up has held
                self._patience = GOOD_ANSWERS
            self._step(-1, now_s)
            self._climbed = True

    def _step(self, down: int, now_s: float) -> None:
        self._rung = min(max(self._rung + down, 0), len(LADDER) - 1)
        self._bad = self._good = 0
        self._climbed = False
        self._stepped_s = now_s


def _greater_share(up: float, down: float) -> float:
    """Of both ways' bytes, that of the busier one: the ways carry at the same time."""
    return max(up, down) / max(up + down, 1.0)
