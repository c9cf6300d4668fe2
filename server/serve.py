"""Running the service: in the foreground for the command line, or in a thread for the demo and the tests."""

from __future__ import annotations

import errno
import logging
import socket
import sys
import threading
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING

import uvicorn

from protocol.limits import MAX_MESSAGE_BYTES
from server.app import create_app
from server.linger import LingeringWebSocket
from server.service import DEFAULT_MAX_SESSIONS, Service

if TYPE_CHECKING:
    from server.opencl.device import Device

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8080
STOP_PATIENCE_S = 10
EVERYWHERE = ("0.0.0.0", "::", "")

log = logging.getLogger(__name__)


class ServeError(Exception):
    """The server cannot start; one line that says why and what to do."""


def serve(
    host: str = DEFAULT_HOST,
    port: int = DEFAULT_PORT,
    device_name: str | None = None,
    *,
    max_sessions: int = DEFAULT_MAX_SESSIONS,
    say: Callable[[str], None] | None = None,
) -> int:
    """Serve until interrupted; the exit status. `say` is given each line for the user (default: standard output).

    A port in use, a missing device or kernels that do not build end in one line on standard error and status 1.
    """
    say = say or _print_line
    try:
        listener = listen(host, port)
        with listener:
            return serve_on(listener, open_service(device_name, max_sessions=max_sessions), say)
    except ServeError as error:
        sys.stderr.write(f"probeless: {error}\n")
        return 1


def open_service(device_name: str | None = None, *, max_sessions: int = DEFAULT_MAX_SESSIONS) -> Service:
    """The real service on the device whose name contains `device_name`. Raises ServeError."""
    from server.opencl.device import DeviceError, open_device

    try:
        device = open_device(device_name)
    except DeviceError as error:
        raise ServeError(str(error)) from error
    return Service(device, warm_up=_warm_up, max_sessions=max_sessions)


def listen(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 takes a free one. Raises ServeError for a port in use or a host that is not here."""
    if not 0 <= port <= 65535:
        raise ServeError(f"there is no port {port}: choose --port from 1 to 65535")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise ServeError(f"port {port} of {host} is in use: stop what uses it or choose another --port") from error
        why = error.strerror or str(error)
        raise ServeError(f"cannot listen on {host} port {port} ({why}): choose another --host or --port") from error


def url_of(listener: socket.socket) -> str:
    """The address a browser on this machine opens."""
    host, port = listener.getsockname()[:2]
    if host in EVERYWHERE:
        host = "localhost"
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def serve_on(listener: socket.socket, service: Service, say: Callable[[str], None]) -> int:
    """Serve a service until interrupted; the exit status. Raises ServeError if its warm-up fails."""
    server = _server(service)
    url = url_of(listener)

    def on_prepared() -> None:
        if service.failure is None:
            say(f"ready: open {url} or run: probeless stream SOURCE --server {url}")
        else:
            server.should_exit = True

    service.on_prepared = on_prepared
    say(f"probeless serves at {url} on {service.device_name}; preparing its kernels")
    try:
        server.run(sockets=[listener])
    except KeyboardInterrupt:  # uvicorn raises it again after it has shut down in order
        say("stopped")
    if service.failure is not None:
        raise ServeError(service.failure)
    return 0


class BackgroundServer:
    """A server in a thread of this process; also a context manager that stops it."""

    def __init__(self, service: Service, host: str = DEFAULT_HOST, port: int = 0) -> None:
        """Start and wait until it accepts connections. Raises ServeError."""
        self._listener = listen(host, port)
        self.url = url_of(self._listener)
        self.service = service
        self._server = _server(service)
        self._thread = threading.Thread(target=self._run, name="probeless-server", daemon=True)
        self._thread.start()
        self._server.accepting.wait()
        if not self._server.started:
            raise ServeError(f"the server at {self.url} did not start; its log says why")

    def _run(self) -> None:
        try:
            self._server.run(sockets=[self._listener])
        finally:
            self._listener.close()
            self._server.accepting.set()

    def stop(self) -> None:
        """End every connection (close code 1012) and wait until the server has stopped."""
        self._server.should_exit = True
        self._thread.join()

    def __enter__(self) -> BackgroundServer:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.stop()


def start_in_background(service: Service, host: str = DEFAULT_HOST, port: int = 0) -> BackgroundServer:
    """Serve `service` from a thread; `.url` says where (port 0: a free one), `.stop()` ends it. Raises ServeError."""
    return BackgroundServer(service, host, port)


class _Server(uvicorn.Server):
    """A uvicorn server that says when it accepts connections."""

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self.accepting = threading.Event()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self.accepting.set()


def _server(service: Service) -> _Server:
    config = uvicorn.Config(
        create_app(service),
        log_level="warning",
        access_log=False,
        ws=LingeringWebSocket,
        ws_per_message_deflate=False,  # costs 10 ms a message and gains nothing on compressed pictures
        ws_max_size=MAX_MESSAGE_BYTES,
        ws_max_queue=2,
        timeout_graceful_shutdown=STOP_PATIENCE_S,
    )
    return _Server(config)


def _warm_up(device: Device) -> None:
    from server.warm_up import warm_up

    warm_up(device)


def _print_line(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
