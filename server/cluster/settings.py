"""Cluster settings: `args` of the application in Serve's configuration."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from msgspec import Meta, Struct

from server.cluster.capacity import Policy

Share = Annotated[float, Meta(gt=0)]


class ClusterSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings by field name."""

    data: str
    """Folder of saved rooms; must be shared by all nodes."""
    device: str | None = None
    """Part of the name of the OpenCL device that hosts use; None: the best available one."""
    place: dict[str, Share] = msgspec.field(default_factory=lambda: {"CPU": 1.0, "room": 1.0})
    """Ray resources that one room takes; `room` counts the places of a node."""
    sessions_per_room: Annotated[int, Meta(ge=1)] = 16
    volume_mib: Annotated[int, Meta(ge=16)] = 512
    """Device memory for one volume."""
    close_after_s: Annotated[float, Meta(ge=0)] = 60.0
    """A room that has been empty for this time is saved and closed."""
    policy: Policy = Policy()
    ingress_replicas: Annotated[int, Meta(ge=1)] = 1
    """Minimum number of replicas."""
    most_ingress_replicas: Annotated[int, Meta(ge=1)] = 8
    sockets_per_replica: Annotated[int, Meta(ge=1)] = 32
    """Target; a replica accepts up to twice as many while others start."""
    rooms_per_client: Annotated[int, Meta(ge=1)] = 4
    """Rooms that clients of one address may have opened; see `quota.client_of`."""
    trusted_proxies: list[str] = []
    """ADDRESS or ADDRESS/BITS of the proxies between clients and replicas, whose X-Forwarded-For is believed."""
    ingress_cpus: Annotated[float, Meta(ge=0)] = 0.5


def read_settings(args: dict[str, Any]) -> ClusterSettings:
    """Raises ValueError that names the invalid field."""
    try:
        return msgspec.convert(args, ClusterSettings)
    except msgspec.ValidationError as error:
        raise ValueError(f"args of the application: {error}") from error
