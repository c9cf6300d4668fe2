"""The process of one room: an ordinary service on its node's device, reached by the ingress over the cluster's network.

A Ray actor. When its node dies Ray starts it anew on another one, where the service loads the room as it was saved.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import urlsplit

from prometheus_client.parser import text_string_to_metric_families

from server.cluster.node_warm_up import warm_up_node
from server.cluster.room_directory import Address
from server.cluster.settings import ClusterSettings
from server.service.authenticator import Authenticator, new_token
from server.service.limits import DEFAULT_LIMITS, MIB, Limits
from server.service.serve import BackgroundServer
from server.service.service import Service

FOR_ALL = 1 << 30
"""Of limits by address, which the ingress would fill alone."""
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class HostStatus:
    """What the keeper wants to know."""

    clients: int
    idle_s: float
    """Since the last client."""
    queue_age_s: float
    """Of frames since the status before, in the mean; 0 where there was none."""
    node: str
    """Its id in the cluster."""


class RoomHost:
    """One room's, or one session's that named no room. Methods are called by Ray, one after the other."""

    def __init__(self, service: Service, address: str, node: str = "") -> None:
        """`address`: of its machine within the cluster; `node`: its id there."""
        token = new_token()
        self._node = node
        self._service = service
        self._server = BackgroundServer(service, host=address, authenticator=Authenticator(token))
        self._address = Address(f"ws://{urlsplit(self._server.url).netloc}", token)
        self._last_client_s = time.monotonic()
        self._aged = (0.0, 0.0)

    def address(self) -> Address:
        """Where clients are relayed to."""
        return self._address

    def status(self) -> HostStatus:
        """Asked every few seconds."""
        values = {
            sample.name: sample.value
            for family in text_string_to_metric_families(self._service.metrics.render().decode())
            for sample in family.samples
        }
        now_s = time.monotonic()
        clients = int(values["probeless_sessions"] + values["probeless_watchers"])
        if clients:
            self._last_client_s = now_s
        aged = values["probeless_queue_age_ms_sum"] / 1e3, values["probeless_queue_age_ms_count"]
        age_s, frames = aged[0] - self._aged[0], aged[1] - self._aged[1]
        self._aged = aged
        return HostStatus(clients, now_s - self._last_client_s, age_s / frames if frames else 0.0, self._node)

    def leave(self) -> bool:
        """Save the room and end its service, unless somebody has come; whether it has ended."""
        if self.status().clients:
            return False
        self._server.stop()
        return True


def open_room_host(settings: ClusterSettings) -> RoomHost:
    """On this node's device. Raises ServeError, DeviceError."""
    import ray

    from server.opencl.device import open_device
    from server.service.warm_up import warm_up

    device = open_device(settings.device)
    limits = limits_of(settings)
    device.volume_bytes = limits.volume_bytes
    service = Service(
        device, warm_up=lambda warmed: warm_up_node(warmed, warm_up), limits=limits, data=Path(settings.data)
    )
    return RoomHost(service, ray.util.get_node_ip_address(), ray.get_runtime_context().get_node_id())


def limits_of(settings: ClusterSettings) -> Limits:
    """Of one host: all of its clients come from the ingress's addresses."""
    return replace(
        DEFAULT_LIMITS,
        sessions=settings.sessions_per_room,
        sessions_per_address=FOR_ALL,
        connections_per_address=FOR_ALL,
        volume_bytes=settings.volume_mib * MIB,
    )
