"""Adaptation to the link: JPEG quality, picture size and frame rate from the round trips of answered frames.

Network time of a frame = round trip - computing on the server - waiting on the server (behind the previous frame, or
for a device that other sessions use). The part above the link's delay is transfer time; it gives the throughput.

- *Rate*: the next frame is sent when the slowest of computing, sending and returning has finished the previous frame.
  So no frame ages in a queue, and the client always sends its newest frame. Over a far link several are under way.
- *Quality*: the highest rung of `LADDER` whose transfer takes less than `SHARE` of the frame interval (of the source,
  or of the server if that is slower), and at most `SHARE * LONGEST_TRANSFER_S`.
- *Recovery*: after a failed step up, the next attempt waits longer, up to `MOST_GOOD_ANSWERS` frames.
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
"""From best to cheapest. Depth is exact on every rung unless rounding is requested."""
SHARE = 0.9
"""Share of the frame interval that the busier direction may use."""
LONGEST_TRANSFER_S = 0.2
"""Limits the age of frames if the server is slow: a direction may take at most `SHARE` of this."""
SMOOTHING = 0.25
"""Weight of the newest measurement."""
BAD_ANSWERS = 2
"""Consecutive slow frames before a step down."""
GOOD_ANSWERS, MOST_GOOD_ANSWERS = 8, 128
"""Consecutive fast frames before a step up; doubled after each step up that failed, up to the second value."""
SPARE = 0.8
"""A frame is fast if its transfer takes less than this share of the limit."""
WINDOW = 32


@dataclass(frozen=True)
class AnsweredFrame:
    """Times and sizes of one answered frame; seconds of one clock."""

    sent_s: float
    """Before the first byte was sent."""
    answered_s: float
    computed_s: float
    """Duration of computing on the server."""
    bytes_up: int
    bytes_down: int
    waited_s: float | None = None
    """Duration of waiting on the server before computing; None: not reported."""


class Adaptive:
    """Chooses the rung and the time of the next frame."""

    def __init__(
        self, source_interval_s: float, delay_s: float = math.inf, depth_noise_per_m: float | None = None
    ) -> None:
        """`source_interval_s`: between frames of the source. `delay_s`: round trip of an empty message."""
        self._ladder = tuple(replace(rung, depth_noise_per_m=depth_noise_per_m) for rung in LADDER)
        self._source_interval_s = source_interval_s
        self._delay_s = delay_s
        self._rung = 0
        self._network_times: deque[float] = deque(maxlen=WINDOW)
        self._last_answer_s, self._last_computed_s = -math.inf, 0.0
        self._computed_s = self._network_s = 0.0
        self._transfer_s = self._turn_s = 0.0
        self._bytes_up = self._bytes_down = 0.0
        self._bad = self._good = 0
        self._patience = GOOD_ANSWERS
        self._is_last_step_up = False
        self._answers = 0
        self._stepped_s = -math.inf

    @property
    def rung(self) -> int:
        """Position in `LADDER`."""
        return self._rung

    @property
    def coding(self) -> Coding:
        """Coding of the next frame."""
        return self._ladder[self._rung]

    @property
    def bytes_per_s(self) -> float | None:
        """Measured throughput of both directions together; None if the link was never the limit."""
        total = self._bytes_up + self._bytes_down
        return total / self._transfer_s if self._transfer_s > 1e-3 else None

    @property
    def busy_s(self) -> float:
        """Duration of the slowest stage. Stages overlap, so their durations do not add; computing has the turn of
        others before it."""
        one_way_s = self._transfer_s * _greater_share(self._bytes_up, self._bytes_down)
        return max(self._computed_s + self._turn_s, one_way_s)

    @property
    def most_in_flight(self) -> int:
        """Frames under way while one is computed and answered, if each is sent in its turn; at least 2.

        An answer that is late is no reason to send more.
        """
        return max(2, math.ceil((self._network_s + self.busy_s) / max(self._source_interval_s, self.busy_s)))

    def may_send(self, now_s: float, last_sent_s: float, unanswered: int) -> bool:
        """Whether a frame sent now would wait in no queue. The caller keeps the source's frame rate and the window."""
        if unanswered == 0:
            return True
        if unanswered >= self.most_in_flight:
            return False
        # The server began the last frame when it was sent, or when those before it were done, one after another, since
        # the last answer left.
        begun_s = max(last_sent_s, self._last_answer_s - self._network_s + (unanswered - 1) * self.busy_s)
        return now_s - begun_s >= self.busy_s

    def note(self, frame: AnsweredFrame) -> None:
        """Take the measurement of an answered frame and choose the rung."""
        waited_s = frame.waited_s
        if waited_s is None:  # behind the previous frame, if that was unanswered when this one was sent
            waited_s = min(max(self._last_answer_s - frame.sent_s, 0.0), self._last_computed_s)
        network_s = max(frame.answered_s - frame.sent_s - frame.computed_s - waited_s, 0.0)
        behind_s = max(self._last_answer_s - self._network_s - frame.sent_s, 0.0)  # frames of its own
        turn_s = 0.0 if frame.waited_s is None else max(frame.waited_s - behind_s, 0.0)
        self._last_answer_s, self._last_computed_s = frame.answered_s, frame.computed_s
        self._network_times.append(network_s)
        transfer_s = max(network_s - min(self._delay_s, *self._network_times), 0.0)
        self._answers += 1
        weight = max(SMOOTHING, 1 / self._answers)
        self._network_s += weight * (network_s - self._network_s)
        self._computed_s += weight * (frame.computed_s - self._computed_s)
        self._turn_s += weight * (turn_s - self._turn_s)
        self._transfer_s += weight * (transfer_s - self._transfer_s)
        self._bytes_up += weight * (frame.bytes_up - self._bytes_up)
        self._bytes_down += weight * (frame.bytes_down - self._bytes_down)
        if frame.sent_s >= self._stepped_s:  # earlier ones were sent with the previous rung
            self._choose(transfer_s * _greater_share(frame.bytes_up, frame.bytes_down), frame.answered_s)

    def note_reconnection(self) -> None:
        """The connection was restored: discard measurements of the old one and step down."""
        self._network_times.clear()
        self._last_answer_s = -math.inf
        self._step(+1, -math.inf)

    def _choose(self, one_way_s: float, now_s: float) -> None:
        most_s = SHARE * min(
            max(self._source_interval_s, self._computed_s), max(self._source_interval_s, LONGEST_TRANSFER_S)
        )
        self._bad = self._bad + 1 if one_way_s > most_s else 0
        self._good = self._good + 1 if one_way_s < SPARE * most_s else 0
        if self._bad >= BAD_ANSWERS:
            if self._is_last_step_up:
                self._patience = min(2 * self._patience, MOST_GOOD_ANSWERS)
            self._step(+1, now_s)
        elif self._good >= self._patience:
            if self._is_last_step_up:  # the last step up succeeded
                self._patience = GOOD_ANSWERS
            self._step(-1, now_s)
            self._is_last_step_up = True

    def _step(self, down: int, now_s: float) -> None:
        self._rung = min(max(self._rung + down, 0), len(LADDER) - 1)
        self._bad = self._good = 0
        self._is_last_step_up = False
        self._stepped_s = now_s


def _greater_share(up: float, down: float) -> float:
    """Share of the busier direction in all bytes; both directions transfer at the same time."""
    return max(up, down) / max(up + down, 1.0)
