"""The process of one room: an ordinary service on its node's device, which the ingress connects to.

It runs as a Ray actor. If its node fails, Ray restarts it on another one, where the service loads the saved room.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import urlsplit

from prometheus_client.parser import text_string_to_metric_families

from server.cluster.node_warm_up import warm_up_node
from server.cluster.room_directory import Address
from server.cluster.settings import ClusterSettings
from server.service.edge.authenticator import Authenticator, new_token
from server.service.limits import DEFAULT_LIMITS, MIB, Limits
from server.service.serve import BackgroundServer
from server.service.service import Service

FOR_ALL = 1 << 30
"""Limit per address; effectively none, since all clients come from the ingress's addresses."""
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class HostStatus:
    """Status for the room supervisor."""

    clients: int
    idle_s: float
    """Time since the last client left."""
    queue_age_s: float
    """Mean queue age of frames since the previous status; 0 without frames."""
    node: str
    """Node id in the cluster."""
    is_private: bool = False
    """The room of one session, which nobody else can enter and which is not saved."""
    is_new: bool = False
    """No client has come yet."""


class RoomHost:
    """Host of one room, or of one session without a room name. Ray calls its methods one at a time."""

    def __init__(self, service: Service, address: str, node: str = "", *, is_private: bool = False) -> None:
        """`address`: of the machine in the cluster's network. `node`: its id. `is_private`: see HostStatus."""
        token = new_token()
        self._node = node
        self._is_private, self._is_new = is_private, True
        self._service = service
        self._server = BackgroundServer(service, host=address, authenticator=Authenticator(token))
        self._address = Address(f"ws://{urlsplit(self._server.url).netloc}", token)
        self._last_client_s = time.monotonic()
        self._aged = (0.0, 0.0)

    def address(self) -> Address:
        """Address for the ingress."""
        return self._address

    def status(self) -> HostStatus:
        """Current status; polled every few seconds."""
        values = {
            sample.name: sample.value
            for family in text_string_to_metric_families(self._service.metrics.render().decode())
            for sample in family.samples
        }
        now_s = time.monotonic()
        clients = int(values["probeless_sessions"] + values["probeless_watchers"])
        if clients:
            self._last_client_s, self._is_new = now_s, False
        aged = values["probeless_queue_age_seconds_sum"], values["probeless_queue_age_seconds_count"]
        age_s, frames = aged[0] - self._aged[0], aged[1] - self._aged[1]
        self._aged = aged
        waited_s = age_s / frames if frames else 0.0
        idle_s = now_s - self._last_client_s
        return HostStatus(clients, idle_s, waited_s, self._node, self._is_private, self._is_new)

    def leave(self, *, even_with_clients: bool = False) -> bool:
        """Save the room and stop its service, unless a session or a client is there. Returns whether it stopped.

        `even_with_clients`: they are told to come again (1012), for a node that is drained.
        """
        if self.status().clients and not even_with_clients:
            return False
        self._server.stop()
        return True


def open_room_host(settings: ClusterSettings, *, is_private: bool) -> RoomHost:
    """Create a host on this node's device, or on the GPU that Ray has given it. Raises ServeError, DeviceError."""
    import ray

    from server.opencl.device import open_device
    from server.service.warm_up import warm_up

    context = ray.get_runtime_context()
    gpus = context.get_accelerator_ids().get("GPU", [])
    device = open_device(settings.device, number=gpu_number(gpus))
    limits = limits_of(settings)
    device.volume_bytes = limits.volume_bytes
    service = Service(
        device, warm_up=lambda warmed: warm_up_node(warmed, warm_up), limits=limits, data=Path(settings.data)
    )
    return RoomHost(service, ray.util.get_node_ip_address(), context.get_node_id(), is_private=is_private)


def gpu_number(ids: Sequence[str]) -> int:
    """Which of a node's GPUs a host uses, from the ids that Ray has given it; 0 where these are no numbers.

    Ray sets CUDA_VISIBLE_DEVICES besides. A driver that keeps to it shows one GPU only, which every number means.
    """
    return int(ids[0]) if ids and ids[0].isdecimal() else 0


def limits_of(settings: ClusterSettings) -> Limits:
    """Limits of one host, without limits per address: all clients come from the ingress's addresses."""
    return replace(
        DEFAULT_LIMITS,
        sessions=settings.sessions_per_room,
        sessions_per_address=FOR_ALL,
        connections_per_address=FOR_ALL,
        volume_bytes=settings.volume_mib * MIB,
    )
