"""The process from which the children of one job are forked: it has loaded what they need, so that a child is there
after milliseconds, also where one was killed so that another session has its turn.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
from contextlib import suppress
from dataclasses import dataclass

from server.children.child import NUMBER, READY

LOADING_TIMEOUT_S = 60.0
KEPT = ("PATH", "LD_LIBRARY_PATH", "LANG", "TMPDIR")
"""Variables of the environment that children have too."""
KEPT_PREFIXES = ("OPENBLAS_", "NPY_")
"""Which kernels of a processor OpenBLAS and NumPy use: a child's results are this process's to the bit."""


class ChildDied(Exception):
    """The child died or was killed during a request. The message completes a sentence such as "the reader ..."."""


@dataclass(frozen=True)
class JobSpec:
    """Job and resource limits of one kind of child."""

    job: str
    """`module:function`, see server.children.child."""
    memory_mib: int
    """Address space limit."""
    timeout_s: float
    """Time limit for one request."""
    max_answer_bytes: int
    """Largest answer in bytes."""
    shared_bytes: int = 0
    """Size of the memory that the child writes and the server reads."""


class Nursery:
    """Forks children of one job; nothing that clients send comes to it. Thread-safe."""

    def __init__(self, spec: JobSpec) -> None:
        """Starts no process yet."""
        self._spec = spec
        self._using = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self._is_ready = False

    def load(self) -> None:
        """Start its process, which loads in the background. Raises ChildDied."""
        with self._using:
            self._start()

    def fork(self, *descriptors: int) -> int:
        """Process id of a new child, with copies of these: requests, answers and shared memory, if any.

        Raises ChildDied if there can be none.
        """
        with self._using:
            for _ in range(2):  # its process may have died since it was used last
                self._start()
                pid = self._asked(b"fork", descriptors)
                if pid is not None and pid > 0:
                    return pid
                if pid is not None:
                    raise ChildDied(f"could not be started ({os.strerror(-pid)})")
                self._end()
        raise ChildDied("could not be started: the process that forks it has ended")

    def reap(self, pid: int) -> int | None:
        """Wait for the end of a child; its exit status as `subprocess` gives it, None where it is not known.

        Until then no other process has its id.
        """
        with self._using:
            status = self._asked(NUMBER.pack(pid), ())
        return None if status is None else os.waitstatus_to_exitcode(status)

    def stop(self) -> None:
        """End its process."""
        with self._using:
            self._end()

    def _start(self) -> None:
        if self._process is not None and self._process.poll() is None:
            return
        self._end()
        control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        control.settimeout(LOADING_TIMEOUT_S)
        spec = self._spec
        arguments = ["-P", "-m", "server.children.child", spec.job, str(spec.memory_mib), str(spec.timeout_s)]
        with theirs:
            try:
                self._process = subprocess.Popen(
                    [sys.executable, *arguments],
                    stdin=theirs.fileno(),
                    stdout=subprocess.DEVNULL,
                    env=_environment(),
                    start_new_session=True,  # Ctrl-C must reach only the server
                )
            except OSError as error:
                control.close()
                raise ChildDied(f"could not be started ({error.strerror})") from error
        self._control, self._is_ready = control, False

    def _asked(self, command: bytes, descriptors: tuple[int, ...]) -> int | None:
        """The number that its process answers, once it has loaded; None where it has died."""
        if self._control is None:
            return None
        try:
            if not self._is_ready:
                self._is_ready = self._control.recv(len(READY)) == READY
            socket.send_fds(self._control, [command], descriptors)
            answer = self._control.recv(NUMBER.size)
        except OSError:  # TimeoutError is one
            return None
        return int(NUMBER.unpack(answer)[0]) if answer else None

    def _end(self) -> None:
        if self._control is not None:
            self._control.close()
        if self._process is not None:
            self._process.kill()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(LOADING_TIMEOUT_S)
        self._control = self._process = None


def _environment() -> dict[str, str]:
    """Minimal environment for the children, without secrets such as the token."""
    kept = {name: value for name, value in os.environ.items() if name in KEPT or name.startswith(KEPT_PREFIXES)}
    threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
    # Keep freed image memory in the process: allocating it again from the system takes as long as decoding.
    memory = {"MALLOC_MMAP_THRESHOLD_": str(64 << 20), "MALLOC_TRIM_THRESHOLD_": str(128 << 20)}
    return {**kept, **threads, **memory, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
