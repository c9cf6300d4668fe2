"""What a frame costs a session outside of the pipeline: reading, encoding and sending."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from typing import Protocol

from server.service.frame_reader import FrameReader
from server.service.monitoring.metrics import Metrics


class Sends(Protocol):
    """What messages leave by."""

    @property
    def waited_s(self) -> float:
        """Total time spent waiting for the socket."""


class Overhead:
    """Time that one frame takes outside of the pipeline: wall time without waiting for the socket, and CPU time.

    Some of it goes on beside the pipeline, with another frame.
    """

    def __init__(self, outbox: Sends, metrics: Metrics, frames: FrameReader) -> None:
        self._outbox, self._metrics, self._frames = outbox, metrics, frames
        self._wall_s = self._cpu_s = 0.0

    @contextlib.contextmanager
    def measured(self, *, sends: bool = False) -> Iterator[None]:
        """Context that is counted. `sends`: waiting for the socket is not; nothing else is sent meanwhile."""
        wall_s, cpu_s, waited_s = time.perf_counter(), time.thread_time(), self._outbox.waited_s
        try:
            yield
        finally:
            self._wall_s += time.perf_counter() - wall_s - (self._outbox.waited_s - waited_s if sends else 0.0)
            self._cpu_s += time.thread_time() - cpu_s

    def record(self) -> None:
        """Record both times; call when the frame is answered."""
        self._metrics.overhead_s.observe(self._wall_s)
        self._metrics.overhead_cpu_s.observe(self._cpu_s + self._frames.take_cpu_s())
