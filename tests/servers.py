"""Servers on a real socket, with fake pipelines."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from server.service.serve import BackgroundServer
from server.service.service import Service
from tests.service.fakes import FAKE_DEVICE, fake_mesh

OF_THE_SERVER = ("authenticator", "certificate", "library")
"""Options that are not the service's."""


def start_fake(build: Callable[..., object], **options: object) -> BackgroundServer:
    """A running server whose pipelines `build` makes. Other options go to the service, or to the server."""
    around = {name: options.pop(name) for name in OF_THE_SERVER if name in options}
    service = Service(FAKE_DEVICE, **{"pipeline_factory": build, "mesh_loader": fake_mesh} | options)
    return BackgroundServer(service, **around)


@contextmanager
def fake_server(build: Callable[..., object], **options: object) -> Iterator[BackgroundServer]:
    """The same, stopped at the end."""
    with start_fake(build, **options) as server:
        yield server
