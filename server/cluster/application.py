"""The Ray Serve application: `import_path: server.cluster.application:build`; `args` are the ClusterSettings.

The environment variable PROBELESS_TOKEN must hold the clients' token, or `none` to allow every client.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any

from fastapi import FastAPI
from ray import serve

from server.cluster.ingress import Ingress, create_ingress_app
from server.cluster.ray_directory import RayRoomDirectory
from server.cluster.room_supervisor import RoomSupervisor
from server.cluster.settings import ClusterSettings, read_settings
from server.service.edge.authenticator import Authenticator, is_token
from server.service.edge.trusted_proxies import TrustedProxies

TOKEN = "PROBELESS_TOKEN"


class IngressReplica:
    """One ingress replica."""

    def __init__(self, settings: ClusterSettings, authenticator: Authenticator, _supervisor: object) -> None:
        """`_supervisor`: an argument so that Serve deploys it."""
        self._ingress = Ingress(RayRoomDirectory(settings), authenticator)

    def __serve_build_asgi_app__(self) -> FastAPI:
        """Called by Serve."""
        return create_ingress_app(self._ingress)


def build(args: dict[str, Any]) -> Any:
    """Build the application. Raises ValueError for an invalid setting."""
    settings = read_settings(args)
    supervisor = serve.deployment(
        RoomSupervisor,
        name="room-supervisor",
        num_replicas=1,
        ray_actor_options={"num_cpus": 0.1},
        graceful_shutdown_timeout_s=5.0,
    )
    ingress = serve.deployment(
        serve.ingress()(IngressReplica),
        name="ingress",
        max_ongoing_requests=2 * settings.sockets_per_replica,
        autoscaling_config={
            "min_replicas": settings.ingress_replicas,
            "max_replicas": settings.most_ingress_replicas,
            "target_ongoing_requests": settings.sockets_per_replica,
        },
        ray_actor_options={"num_cpus": settings.ingress_cpus},
        graceful_shutdown_timeout_s=10.0,
    )
    return ingress.bind(settings, authenticator_from_environment(settings.trusted_proxies), supervisor.bind(settings))


def authenticator_from_environment(trusted_proxies: Iterable[str] = ()) -> Authenticator:
    """Raises ValueError if the token is missing or invalid, or a proxy is no address."""
    token, proxies = os.environ.get(TOKEN, ""), TrustedProxies(trusted_proxies)
    if token == "none":
        return Authenticator(None, proxies=proxies)
    if not is_token(token):
        raise ValueError(f"set {TOKEN} to a secret of yours (openssl rand -hex 24), or to none to let everybody in")
    return Authenticator(token, proxies=proxies)
