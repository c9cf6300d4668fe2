"""Runs the service: in the foreground for the command line, or in a thread for the demo and the tests."""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING

import uvicorn

from protocol.limits import MAX_MESSAGE_BYTES
from protocol.local_keys import LocalKey, key_left
from server.service.app import create_app
from server.service.edge.acceptor import Acceptor, TimedHttp
from server.service.edge.authenticator import Authenticator, new_token
from server.service.edge.gate import Gate, Place, max_connections
from server.service.edge.lingering_close import LingeringCloseWebSocket
from server.service.edge.listening import ServeError, listen
from server.service.edge.tls import Certificate
from server.service.edge.trusted_proxies import TrustedProxies
from server.service.limits import DEFAULT_LIMITS, Limits
from server.service.monitoring.console import print_line
from server.service.routes.object_library import ObjectLibrary
from server.service.service import Service
from server.service.ways_in import WaysIn, url_of

if TYPE_CHECKING:
    from server.opencl.device import Device
    from server.service.keeper import Kept

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8080
STOP_PATIENCE_S = 10
"""Time limit from the signal to the end of the process."""
DRAIN_PATIENCE_S = 7
"""Part of it in which sessions end and rooms are saved."""
CRASHES = ("SIGSEGV", "SIGBUS", "SIGILL", "SIGABRT")
"""Not SIGFPE: PoCL has a handler for divisions by zero in kernels."""
NO_AUTHENTICATION = Authenticator()

log = logging.getLogger(__name__)


def serve(
    host: str = DEFAULT_HOST,
    port: int = DEFAULT_PORT,
    device_name: str | None = None,
    *,
    limits: Limits = DEFAULT_LIMITS,
    authenticator: Authenticator | None = None,
    certificate: Certificate | None = None,
    data: Path | None = None,
    objects: Path | None = None,
    say: Callable[[str], None] = print_line,
    shows_token: bool = True,
    keeper: Kept | None = None,
    draws_code: bool = False,
) -> int:
    """Serve until interrupted and return the exit status. `say` receives each line for the user (default: stdout).

    `shows_token`: whether the token is in one of these lines. `keeper`: whose listening socket is used. `draws_code`:
    whether lines may draw a code for a phone.

    `authenticator` None: a new token is required. `certificate` None: no TLS. `data`: folder in which rooms are saved.
    `objects`: folder of models that clients may place; None: only the vase.
    A port in use, a missing device or kernels that do not build print one line on standard error and return 1.
    """
    authenticator = authenticator or Authenticator(new_token())
    try:
        listener = listen(host, port) if keeper is None else keeper.listener
        with listener:
            service = open_service(device_name, limits=limits, data=data)
            library = ObjectLibrary(objects)
            ready = keeper.tell_ready if keeper is not None else lambda: None
            shown = {"shows_token": shows_token, "draws_code": draws_code}
            return serve_on(listener, service, say, authenticator, certificate, library, tell_ready=ready, **shown)
    except ServeError as error:
        sys.stderr.write(f"probeless: {error}\n")
        return 1


def open_service(
    device_name: str | None = None, *, limits: Limits = DEFAULT_LIMITS, data: Path | None = None
) -> Service:
    """A service on the device whose name contains `device_name`. Raises ServeError."""
    from server.opencl.device import DeviceError, open_device

    try:
        device = open_device(device_name)
    except DeviceError as error:
        raise ServeError(str(error)) from error
    device.volume_bytes = limits.volume_bytes
    return Service(device, warm_up=_warm_up, limits=limits, data=data)


def serve_on(
    listener: socket.socket,
    service: Service,
    say: Callable[[str], None],
    authenticator: Authenticator = NO_AUTHENTICATION,
    certificate: Certificate | None = None,
    library: ObjectLibrary | None = None,
    *,
    shows_token: bool = True,
    tell_ready: Callable[[], None] = lambda: None,
    draws_code: bool = False,
) -> int:
    """Serve until interrupted and return the exit status. Raises ServeError if the warm-up fails.

    `tell_ready` is called when clients are welcome.
    """
    server = _server(service, authenticator, certificate, library)
    with _key_left(listener, authenticator, certificate) as is_left:

        def on_prepared() -> None:
            if service.failure is None:
                _leave_out_of_collections()
                _end_by_crashes()
                service.compile_beside()
                tell_ready()  # before people are told: from then on a crash must not be the end
                ways = WaysIn(listener, authenticator, certificate, is_left, shows_token)
                for line in [*ways.lines(), *(ways.code() if draws_code else ())]:
                    say(line)
            else:
                server.should_exit = True

        service.on_prepared = on_prepared
        say(f"probeless serves at {url_of(listener, certificate)} on {service.device_name}; preparing its kernels")
        try:
            with _ended_like_interrupted():
                server.run(sockets=[listener])
        except KeyboardInterrupt:  # uvicorn raises it again after its shutdown
            say("stopped")
    if service.failure is not None:
        raise ServeError(service.failure)
    return 0


def _end_by_crashes() -> None:
    """Take the handlers away that LLVM, PoCL's compiler, has left. They return, since a fault then happens again and
    ends the process; where another process sent the signal, nothing would end."""
    if threading.current_thread() is threading.main_thread():
        for name in CRASHES:
            if hasattr(signal, name):  # not all systems have each
                signal.signal(getattr(signal, name), signal.SIG_DFL)


def _leave_out_of_collections() -> None:
    """Do not look through modules, kernels and the like for garbage again: a collection of all stops every thread for
    60 ms (two cores of an AMD EPYC) with them."""
    gc.collect()
    gc.freeze()


@contextlib.contextmanager
def _ended_like_interrupted() -> Iterator[None]:
    """Make SIGTERM and SIGINT raise KeyboardInterrupt after uvicorn's shutdown.

    By default SIGTERM would end the process at once, and a background shell makes its children ignore SIGINT.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def _key_left(listener: socket.socket, authenticator: Authenticator, certificate: Certificate | None) -> Iterator[bool]:
    """Context in which this user's programs on this machine find the token; yields whether it could be stored."""
    if authenticator.token is None and certificate is None:
        yield True  # no token is needed
        return
    fingerprint = None if certificate is None else certificate.fingerprint
    key = LocalKey(token=authenticator.token, fingerprint=fingerprint, pid=os.getpid())
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(key_left(listener.getsockname()[1], key))
        except OSError as error:
            log.warning("programs of this machine must be given the token too, it cannot be kept for them: %s", error)
            yield False
        else:
            yield True


class BackgroundServer:
    """A server in a thread of this process (port 0: a free port). A context manager that stops it on exit."""

    def __init__(
        self,
        service: Service,
        host: str = DEFAULT_HOST,
        port: int = 0,
        authenticator: Authenticator = NO_AUTHENTICATION,
        certificate: Certificate | None = None,
        library: ObjectLibrary | None = None,
    ) -> None:
        """Start the server and wait until it accepts connections. Raises ServeError."""
        self._listener = listen(host, port)
        self.url = url_of(self._listener, certificate)
        self.way_in = f"{self.url}{authenticator.query}"
        """URL with the token, for a browser."""
        self.service = service
        self._server = _server(service, authenticator, certificate, library)
        self._key = _key_left(self._listener, authenticator, certificate)
        self._key.__enter__()
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
            self._key.__exit__(None, None, None)
            self._server.accepting.set()

    def stop(self) -> None:
        """Close all connections (code 1012) and wait until the server has stopped."""
        self._server.should_exit = True
        self._thread.join()

    def __enter__(self) -> BackgroundServer:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.stop()


class _Server(uvicorn.Server):
    """uvicorn server that signals when it accepts connections and shuts down gracefully."""

    def __init__(self, config: uvicorn.Config, service: Service, proxies: TrustedProxies) -> None:
        super().__init__(config)
        self.accepting = threading.Event()
        self._service = service
        self._proxies = proxies
        self._acceptors: list[Acceptor] = []

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Drain the service while new clients still get an answer, then close."""
        await self._service.shutdown.drain(DRAIN_PATIENCE_S)
        for acceptor in self._acceptors:
            await acceptor.stop()
        await super().shutdown(sockets)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start without uvicorn's own listening, which accepts without limits."""
        await super().startup([])
        limits = self._service.limits
        most = max_connections(limits)
        gate = Gate(most, max(1, min(2 * limits.connections_per_address, most // 2)), self._proxies.__contains__)
        self._acceptors = [Acceptor(s, gate, self.config, self._open_protocol) for s in sockets or []]
        self.accepting.set()

    def _open_protocol(self, place: Place) -> TimedHttp:
        protocol = TimedHttp(self.config, self.server_state, self.lifespan.state)
        protocol.place, protocol.header_s = place, self._service.limits.header_s
        return protocol


def _server(
    service: Service, authenticator: Authenticator, certificate: Certificate | None, library: ObjectLibrary | None
) -> _Server:
    config = uvicorn.Config(
        create_app(
            service,
            authenticator=authenticator,
            library=library,
            authority=None if certificate is None else certificate.authority,
        ),
        ssl_certfile=None if certificate is None else certificate.certificate,
        ssl_keyfile=None if certificate is None else certificate.key,
        log_level="warning",
        access_log=False,
        http=TimedHttp,
        proxy_headers=bool(authenticator.proxies),
        forwarded_allow_ips=authenticator.proxies.for_uvicorn,
        ws=LingeringCloseWebSocket,
        ws_per_message_deflate=False,  # costs 10 ms a message; images are compressed already
        ws_max_size=MAX_MESSAGE_BYTES,
        ws_max_queue=2,
        log_config=None,
        timeout_graceful_shutdown=STOP_PATIENCE_S - DRAIN_PATIENCE_S,
    )
    return _Server(config, service, authenticator.proxies)


def _warm_up(device: Device) -> None:
    from server.service.warm_up import warm_up

    warm_up(device)
