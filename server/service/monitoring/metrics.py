"""Prometheus metrics of one service, in a registry of its own, in base units."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.metadata import version
from typing import TYPE_CHECKING

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    Info,
    PlatformCollector,
    ProcessCollector,
    disable_created_metrics,
    generate_latest,
)
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from protocol.messages import TIMING_ROWS, Timings
from server.service.edge import connection

if TYPE_CHECKING:
    from server.service.saving.room_persistence import RoomPersistence

BUCKETS_S = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.035, 0.05, 0.075, 0.1, 0.15, 0.25, 0.5, 1.0, 2.5, 5.0)
STAGES = (*TIMING_ROWS, "total", "host")
REFUSAL_CODES = (
    *(connection.PROTOCOL, connection.UNSUPPORTED, connection.INVALID, connection.POLICY, connection.INTERNAL),
    *(connection.TRY_LATER, connection.UNAUTHORIZED, connection.FORBIDDEN, connection.GONE),
)
"""There from the start: the rate of a series that begins with the first refusal leaves that one out."""

# Without this there is a series beside each counter and histogram, which promlint takes for one without a unit.
disable_created_metrics()  # type: ignore[no-untyped-call]


def process_registry() -> CollectorRegistry:
    """A registry with what every process of the server tells: memory, descriptors, Python and the version."""
    registry = CollectorRegistry()
    ProcessCollector(registry=registry)
    PlatformCollector(registry=registry)
    Info("probeless_build", "Version of the server", registry=registry).info({"version": version("probeless")})
    return registry


class Metrics:
    """All metrics of `/metrics`. Prometheus types are thread-safe, so workers update them directly."""

    def __init__(self) -> None:
        self._registry = process_registry()
        self.stage_s = self._histogram("stage_seconds", "Time of each stage of the pipeline", ("stage",))
        self.decode_s = self._histogram("decode_seconds", "Time to decode a frame's colour and depth")
        self.encode_s = self._histogram("encode_seconds", "Time to encode a composite")
        self.queue_age_s = self._histogram("queue_age_seconds", "Time that a frame waited before its worker took it")
        self.turn_s = self._histogram("turn_seconds", "Time that a frame waited for its turn on the device")
        self.overhead_s = self._histogram(
            "overhead_seconds", "Time of a frame outside of the pipeline, waiting for its turn or the socket left out"
        )
        self.overhead_cpu_s = self._histogram(
            "overhead_cpu_seconds", "Time of the processor that a session's threads took outside of the pipeline"
        )
        self.launches = self._counter("launches", "Kernels of all frames")
        self.reads = self._counter("reads", "Times that frames waited for memory of the device")
        self.read_bytes = self._counter("read_bytes", "Bytes of these reads")
        self.copies = self._counter("copies", "Copies to, from and on the device")
        self.processed = self._counter("frames_processed", "Frames composited")
        self.dropped = self._counter("frames_dropped", "Frames dropped", ("reason",))
        self.refused = self._counter("refused", "Connections refused", ("code",))
        self.parser_deaths = self._counter("parser_deaths", "Processes that died reading a stranger's bytes", ("kind",))
        self.sessions = self._gauge("sessions", "Capturing sessions")
        self.watchers = self._gauge("watchers", "Watching clients")
        self.device_memory = self._gauge("device_memory_bytes", "Device memory held by sessions and objects")
        self.ready = self._gauge("ready", "1 once clients are welcome, 0 before and after")
        self._rooms = self._gauge("rooms", "Rooms that somebody is in")
        for kind in ("mesh", "picture", "video"):
            self.parser_deaths.labels(kind)
        for stage in STAGES:
            self.stage_s.labels(stage)
        for code in REFUSAL_CODES:
            self.refused.labels(str(code))
        for reason in ("replaced", "refused", "unreadable", "invalid"):
            self.dropped.labels(reason)

    def _counter(self, name: str, help_text: str, labels: tuple[str, ...] = ()) -> Counter:
        """Its samples are called `probeless_<name>_total`."""
        return Counter(f"probeless_{name}", help_text, labels, registry=self._registry)

    def _gauge(self, name: str, help_text: str) -> Gauge:
        return Gauge(f"probeless_{name}", help_text, registry=self._registry)

    def _histogram(self, name: str, help_text: str, labels: tuple[str, ...] = ()) -> Histogram:
        return Histogram(f"probeless_{name}", help_text, labels, buckets=BUCKETS_S, registry=self._registry)

    def add_room_metrics(self, count: Callable[[], int], persistence: RoomPersistence | None) -> None:
        """Add metrics of open rooms and, with `persistence`, of rooms on disk."""
        self._rooms.set_function(lambda: float(count()))
        if persistence is not None:
            self._registry.register(_KeptRooms(persistence))

    def observe_stages(self, timings: Timings) -> None:
        """Add what one frame cost."""
        for stage in STAGES:
            self.stage_s.labels(stage).observe(getattr(timings, stage) / 1e3)
        self.launches.inc(timings.launches)
        self.reads.inc(timings.reads)
        self.read_bytes.inc(timings.read_bytes)
        self.copies.inc(timings.copies)

    def render(self) -> bytes:
        """All metrics in Prometheus's text format."""
        return generate_latest(self._registry)


class _KeptRooms(Collector):
    """Rooms on disk, as counted at the last check."""

    def __init__(self, persistence: RoomPersistence) -> None:
        self._persistence = persistence

    def collect(self) -> Iterator[Metric]:
        """The current values."""
        storage = self._persistence.storage
        yield GaugeMetricFamily("probeless_kept_rooms", "Rooms on disk", storage.rooms)
        yield GaugeMetricFamily("probeless_kept_bytes", "Bytes that rooms take on disk", storage.space_bytes)
        yield CounterMetricFamily(
            "probeless_kept_removed", "Rooms and damaged saves removed for age or space", storage.removed
        )
        unsaved = self._persistence.unsaved
        yield GaugeMetricFamily("probeless_unsaved_rooms", "Rooms whose last save failed", unsaved)
