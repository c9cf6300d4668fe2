"""What an operator says of the cluster; `args` of the application in Serve's configuration."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from msgspec import Meta, Struct

from server.cluster.capacity import Policy

Share = Annotated[float, Meta(gt=0)]


class ClusterSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Fields of the same names."""

    data: str
    """Folder that rooms are kept in; every node sees the same one."""
    device: str | None = None
    """A part of the name of the OpenCL device that hosts take; None: the best that they find."""
    place: dict[str, Share] = msgspec.field(default_factory=lambda: {"CPU": 1.0, "room": 1.0})
    """What one room takes of its node, in Ray's names; `room` counts the places of a node."""
    sessions_per_room: Annotated[int, Meta(ge=1)] = 16
    volume_mib: Annotated[int, Meta(ge=16)] = 512
    """Device memory of one volume."""
    close_after_s: Annotated[float, Meta(ge=0)] = 60.0
    """A room that nobody has been in for so long is saved and gives its place back."""
    policy: Policy = Policy()
    ingress_replicas: Annotated[int, Meta(ge=1)] = 1
    """At least."""
    most_ingress_replicas: Annotated[int, Meta(ge=1)] = 8
    sockets_per_replica: Annotated[int, Meta(ge=1)] = 32
    """Aimed at; a replica takes twice as many while others start."""
    ingress_cpus: Annotated[float, Meta(ge=0)] = 0.5


def read_settings(args: dict[str, Any]) -> ClusterSettings:
    """Raises ValueError naming the field."""
    try:
        return msgspec.convert(args, ClusterSettings)
    except msgspec.ValidationError as error:
        raise ValueError(f"args of the application: {error}") from error
