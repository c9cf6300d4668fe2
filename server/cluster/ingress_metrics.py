"""Prometheus metrics of one ingress replica."""

from __future__ import annotations

from prometheus_client import Counter, Gauge, Histogram, generate_latest

from server.service.monitoring.metrics import REFUSAL_CODES, process_registry

WAIT_BUCKETS_S = (0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 20.0)


class IngressMetrics:
    """All metrics of `/metrics` of a replica. Ray's own are scraped beside them."""

    def __init__(self) -> None:
        registry = self._registry = process_registry()
        self.clients = Gauge("probeless_ingress_clients", "Sockets of clients at this replica", registry=registry)
        self.has_place = Gauge(
            "probeless_ingress_has_place",
            "1 while a new room would find a place, 0 while the cluster is full",
            registry=registry,
        )
        self.wait_s = Histogram(
            "probeless_ingress_wait_seconds",
            "Time that a client waited for its room",
            buckets=WAIT_BUCKETS_S,
            registry=registry,
        )
        self.refused = Counter("probeless_ingress_refused", "Clients refused here", ("code",), registry=registry)
        self.abandoned = Counter(
            "probeless_ingress_abandoned", "Private rooms whose client left before they were ready", registry=registry
        )
        self.has_place.set(1.0)
        for code in REFUSAL_CODES:
            self.refused.labels(str(code))

    def render(self) -> bytes:
        """All metrics in Prometheus's text format."""
        return generate_latest(self._registry)
