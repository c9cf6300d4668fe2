"""Keeps a server running: a small parent process starts it again where it crashes. docs/operating.md has the reasons.

What a device's driver does with a kernel is not ours to check: PoCL ends the process where it cannot link one, say
because the disk is full. The parent loads no driver and reads nothing of clients. It holds the listening socket, so
that clients who connect meanwhile wait instead of being refused, and the token, so that it stays the same.
"""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import NoReturn, cast

from server.service.edge.listening import listen
from server.service.monitoring.event_log import LogFormat, log_events

KEPT = "PROBELESS_KEPT"
"""Environment of a kept server: numbers of its listening socket and of its link to the parent."""
CAN_KEEP = sys.platform != "win32"
"""Where sockets can be handed down by their numbers."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 30.0
CALM_S = 60.0
"""A server that ran for so long has not crashed in a row."""
_TOKEN_BYTES = 4096
_READY = b"r"

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Kept:
    """What a kept server has from its parent."""

    listener: socket.socket
    token: str
    """For a server that would make one up."""
    link: socket.socket

    def tell_ready(self) -> None:
        """Tell the parent that the server is ready: from now on it is started again."""
        with contextlib.suppress(OSError):  # the parent is gone
            self.link.sendall(_READY)


def kept() -> Kept | None:
    """In a server that a parent keeps; None elsewhere, and in whatever this server starts."""
    numbers = os.environ.pop(KEPT, None)
    if numbers is None:
        return None
    listener, link = (socket.socket(fileno=int(number)) for number in numbers.split(","))
    for inherited in (listener, link):
        inherited.set_inheritable(False)
    _die_with_parent()
    return Kept(listener, link.recv(_TOKEN_BYTES).decode(), link)


class Keeper:
    """Starts a server again after each crash, until it ends by itself or is told to stop."""

    def __init__(
        self,
        command: Sequence[str],
        listener: socket.socket,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`command`: of the server. `listener`: its socket. `clock`: in seconds."""
        self._command = list(command)
        self._listener = listener
        self._token = secrets.token_urlsafe(24)
        self._clock = clock
        self._process: subprocess.Popen[bytes] | None = None
        self._stopping = threading.Event()
        self.crashes = 0

    def run(self) -> int:
        """Exit status of the server, once it ends by itself. A crash before it was ever ready is its end, too."""
        pause_s = FIRST_PAUSE_S / 2
        with self._signals_passed_on():
            while not self._stopping.is_set():
                began_s = self._clock()
                status, was_ready = self._run_once()
                if status >= 0:
                    return status
                if self._stopping.is_set() or not (was_ready or self.crashes):
                    return 128 - status
                self.crashes += 1
                pause_s = FIRST_PAUSE_S if self._clock() - began_s > CALM_S else min(2 * pause_s, LONGEST_PAUSE_S)
                name = signal.Signals(-status).name
                log.error("the server crashed and is started again", extra={"signal": name, "pause_s": pause_s})
                self._stopping.wait(pause_s)
        return 0

    def _run_once(self) -> tuple[int, bool]:
        """Run the server to its end: its status (below 0: a signal), and whether it was ready."""
        ours, theirs = socket.socketpair()
        with ours:
            with theirs:
                numbers = (self._listener.fileno(), theirs.fileno())
                environment = os.environ | {KEPT: ",".join(map(str, numbers))}
                self._process = subprocess.Popen(self._command, env=environment, pass_fds=numbers)
            if self._stopping.is_set():  # the signal came before there was a process to pass it on to
                self._process.terminate()
            with contextlib.suppress(OSError):  # it has crashed already
                ours.sendall(self._token.encode())
            status = self._process.wait()
            ours.setblocking(False)
            try:
                return status, ours.recv(1) == _READY
            except OSError:  # it said nothing
                return status, False

    def stop(self, number: int, _frame: FrameType | None = None) -> None:
        """Pass a signal on; the server is not started again."""
        self._stopping.set()
        if self._process is not None and self._process.poll() is None:
            # SIGINT may have come from a terminal, which sends it to both: a second one would end the server at once.
            self._process.send_signal(signal.SIGTERM if number == signal.SIGINT else number)

    @contextlib.contextmanager
    def _signals_passed_on(self) -> Iterator[None]:
        before = {number: signal.signal(number, self.stop) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def keep(host: str, port: int, log_format: LogFormat) -> NoReturn:
    """Become the parent of a server with this process's command line. Raises ServeError.

    The parent is a program of its own: what was loaded to understand the command line would take 70 MB.
    """
    listener = listen(host, port)
    listener.set_inheritable(True)
    program = f"import sys; sys.path.insert(0, {str(Path(__file__).parents[2])!r}); from {__name__} import main; main()"
    server = [sys.executable, *sys.orig_argv[1:]]
    sys.stdout.flush()
    sys.stderr.flush()
    words = [str(listener.fileno()), log_format, *server]
    os.execv(sys.executable, [sys.executable, "-P", "-c", program, *words])


def main() -> None:
    """The parent: `LISTENER LOG COMMAND...`."""
    number, log_format, *server = sys.argv[1:]
    log_events(cast(LogFormat, log_format))
    with socket.socket(fileno=int(number)) as listener:
        sys.exit(Keeper(server, listener).run())


def _die_with_parent() -> None:
    """A server whose parent was killed drains and ends, so that a new one finds its port free. Linux only."""
    if sys.platform != "linux":
        return
    import ctypes

    set_death_signal = 1  # PR_SET_PDEATHSIG of prctl(2)
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(set_death_signal, signal.SIGTERM)
