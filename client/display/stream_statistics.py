"""What a stream is like while it runs: frames and bits a second, and milliseconds of each stage of a frame's way.

All by the client's clock. `way` is the round trip less what the server says of its own: there and back.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

STAGES = ("encode", "way", "wait", "compute", "show", "whole")
"""Captured to sent; sent to returned, less the next two; received to computing, and computing, as the server says;
returned to shown; captured to shown."""
KEPT = 512
RATE_S = 5.0


@dataclass
class _Frame:
    captured_s: float
    sent_s: float


@dataclass
class StreamFigures:
    """Told of each frame as it passes; times in seconds of one clock."""

    milliseconds: dict[str, deque[float]] = field(default_factory=lambda: {name: deque(maxlen=KEPT) for name in STAGES})
    _under_way: dict[int, _Frame] = field(default_factory=dict)
    _sent: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=KEPT))
    _answered: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=KEPT))

    def note_sent(self, number: int, captured_s: float, sent_s: float, size_bytes: int) -> None:
        """A frame went out; `sent_s`: as its first byte did."""
        self._under_way[number] = _Frame(captured_s, sent_s)
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
        """Its answer is here, and on show. `waited_s`: at the server, before it was computed."""
        self._answered.append((returned_s, size_bytes))
        frame = self._under_way.pop(number, None)
        if frame is None:
            return
        way_s = max(returned_s - frame.sent_s - waited_s - computed_s, 0.0)
        whole_s = shown_s - frame.captured_s
        times = (frame.sent_s - frame.captured_s, way_s, waited_s, computed_s, shown_s - returned_s, whole_s)
        for name, seconds in zip(STAGES, times, strict=True):
            self.milliseconds[name].append(1e3 * seconds)

    def forget(self, number: int) -> None:
        """It was dropped."""
        self._under_way.pop(number, None)

    def percentiles(self, stage: str) -> tuple[float, float] | None:
        """p50 and p99 in milliseconds of the last frames; None before the first."""
        values = self.milliseconds[stage]
        return (float(np.percentile(values, 50)), float(np.percentile(values, 99))) if values else None

    def rates(self, now_s: float) -> tuple[float, float, float, float]:
        """Frames sent and answered a second, Mbit/s up and down, over the last seconds."""
        return *_rates(self._sent, now_s), *_rates(self._answered, now_s)


def _rates(events: deque[tuple[float, int]], now_s: float) -> tuple[float, float]:
    """Frames and Mbit a second."""
    recent = [(at_s, size) for at_s, size in events if now_s - at_s < RATE_S]
    if len(recent) < 2:
        return 0.0, 0.0
    seconds = max(now_s - recent[0][0], 1e-3)
    return len(recent) / seconds, 8e-6 * sum(size for _, size in recent) / seconds
