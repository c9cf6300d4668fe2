"""Prometheus metrics of one service, in a registry of its own."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

from protocol.messages import TIMING_ROWS, Timings

if TYPE_CHECKING:
    from server.service.room_persistence import RoomPersistence

BUCKETS_MS = (0.5, 1, 2, 5, 10, 20, 35, 50, 75, 100, 150, 250, 500, 1000, 2500, 5000)
STAGES = (*TIMING_ROWS, "total", "host")


class Metrics:
    """All metrics of `/metrics`. Prometheus types are thread-safe, so workers update them directly."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        self.stage_ms = self._histogram("stage_ms", "Milliseconds of each stage of the pipeline", ("stage",))
        self.decode_ms = self._histogram("decode_ms", "Milliseconds to decode a frame's colour and depth")
        self.encode_ms = self._histogram("encode_ms", "Milliseconds to encode a composite")
        self.queue_age_ms = self._histogram("queue_age_ms", "Milliseconds a frame waited before its worker took it")
        self.turn_ms = self._histogram("turn_ms", "Milliseconds a frame waited for its turn on the device")
        self.overhead_ms = self._histogram(
            "overhead_ms",
            "Milliseconds of a frame outside of the pipeline, waiting for its turn or the socket left out",
        )
        self.overhead_cpu_ms = self._histogram(
            "overhead_cpu_ms", "Milliseconds of the processor that a session's thread took outside of the pipeline"
        )
        self.launches = Counter("probeless_launches", "Kernels of all frames", registry=self._registry)
        self.reads = Counter(
            "probeless_reads", "Times that frames waited for memory of the device", registry=self._registry
        )
        self.read_bytes = Counter("probeless_read_bytes", "Bytes of these reads", registry=self._registry)
        self.processed = Counter("probeless_frames_processed", "Frames composited", registry=self._registry)
        self.dropped = Counter("probeless_frames_dropped", "Frames dropped", ("reason",), registry=self._registry)
        self.sessions = Gauge("probeless_sessions", "Capturing sessions", registry=self._registry)
        self.watchers = Gauge("probeless_watchers", "Watching clients", registry=self._registry)
        self.refused = Counter("probeless_refused", "Connections refused", ("code",), registry=self._registry)
        self.device_memory = Gauge(
            "probeless_device_memory_bytes", "Device memory held by sessions and objects", registry=self._registry
        )
        self.ready = Gauge("probeless_ready", "1 once clients are welcome, 0 before and after", registry=self._registry)
        self.parser_deaths = Counter(
            "probeless_parser_deaths",
            "Processes that died reading a stranger's bytes",
            ("kind",),
            registry=self._registry,
        )
        self._rooms = Gauge("probeless_rooms", "Rooms that somebody is in", registry=self._registry)
        for kind in ("mesh", "picture", "video"):
            self.parser_deaths.labels(kind)
        for stage in STAGES:
            self.stage_ms.labels(stage)
        for reason in ("replaced", "refused", "unreadable", "invalid"):
            self.dropped.labels(reason)

    def _histogram(self, name: str, help_text: str, labels: tuple[str, ...] = ()) -> Histogram:
        return Histogram(f"probeless_{name}", help_text, labels, buckets=BUCKETS_MS, registry=self._registry)

    def add_room_gauges(self, count: Callable[[], int], persistence: RoomPersistence | None) -> None:
        """Add metrics of open rooms and, with `persistence`, of rooms on disk."""
        self._rooms.set_function(lambda: float(count()))
        if persistence is not None:
            rows: dict[str, tuple[str, Callable[[], float]]] = {
                "kept_rooms": ("Rooms on disk", lambda: persistence.storage.rooms),
                "kept_bytes": ("Bytes that rooms take on disk", lambda: persistence.storage.space_bytes),
                "kept_removed": (
                    "Rooms and damaged saves removed for age or space",
                    lambda: persistence.storage.removed,
                ),
                "unsaved_rooms": ("Rooms whose last save failed", lambda: persistence.unsaved),
            }
            for name, (help_text, value) in rows.items():
                Gauge(f"probeless_{name}", help_text, registry=self._registry).set_function(value)

    def observe_stages(self, timings: Timings) -> None:
        """Add what one frame cost."""
        for stage in STAGES:
            self.stage_ms.labels(stage).observe(getattr(timings, stage))
        self.launches.inc(timings.launches)
        self.reads.inc(timings.reads)
        self.read_bytes.inc(timings.read_bytes)

    def render(self) -> bytes:
        """All metrics in Prometheus's text format."""
        return generate_latest(self._registry)
