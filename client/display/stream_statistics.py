"""Statistics of a running stream: frames and bits per second, and the latency of each stage of a frame.

All times are of the client's clock. `way` is the round trip minus the times that the server reports.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

STAGES = ("encode", "way", "wait", "compute", "show", "whole")
"""encode: captured to sent. way: sent to returned, minus wait and compute. wait, compute: reported by the server.
show: returned to shown. whole: captured to shown."""
KEPT = 512
RATE_S = 5.0


@dataclass
class _Frame:
    captured_s: float
    sent_s: float


@dataclass
class StreamStatistics:
    """Collects times of frames, in seconds of one clock."""

    milliseconds: dict[str, deque[float]] = field(default_factory=lambda: {name: deque(maxlen=KEPT) for name in STAGES})
    _in_flight: dict[int, _Frame] = field(default_factory=dict)
    _sent: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=KEPT))
    _answered: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=KEPT))

    def note_sent(self, number: int, captured_s: float, sent_s: float, size_bytes: int) -> None:
        """A frame was sent; `sent_s`: time of its first byte."""
        self._in_flight[number] = _Frame(captured_s, sent_s)
        self._sent.append((sent_s, size_bytes))

    def note_answer(
        self,
        number: int,
        returned_s: float,
        shown_s: float,
        computed_s: float,
        size_bytes: int,
        waited_s: float = 0.0,
    ) -> None:
        """An answer was shown. `waited_s`: waiting on the server before computing."""
        self._answered.append((returned_s, size_bytes))
        frame = self._in_flight.pop(number, None)
        if frame is None:
            return
        way_s = max(returned_s - frame.sent_s - waited_s - computed_s, 0.0)
        whole_s = shown_s - frame.captured_s
        times = (frame.sent_s - frame.captured_s, way_s, waited_s, computed_s, shown_s - returned_s, whole_s)
        for name, seconds in zip(STAGES, times, strict=True):
            self.milliseconds[name].append(1e3 * seconds)

    def forget(self, number: int) -> None:
        """The frame was dropped."""
        self._in_flight.pop(number, None)

    def percentiles(self, stage: str) -> tuple[float, float] | None:
        """p50 and p99 over the last frames in milliseconds; None without frames."""
        values = self.milliseconds[stage]
        return (float(np.percentile(values, 50)), float(np.percentile(values, 99))) if values else None

    def rates(self, now_s: float) -> tuple[float, float, float, float]:
        """Sent frames/s and Mbit/s, answered frames/s and Mbit/s, over the last RATE_S seconds."""
        return *_rates(self._sent, now_s), *_rates(self._answered, now_s)


def _rates(events: deque[tuple[float, int]], now_s: float) -> tuple[float, float]:
    """Frames/s and Mbit/s."""
    recent = [(at_s, size) for at_s, size in events if now_s - at_s < RATE_S]
    if len(recent) < 2:
        return 0.0, 0.0
    seconds = max(now_s - recent[0][0], 1e-3)
    return len(recent) / seconds, 8e-6 * sum(size for _, size in recent) / seconds
