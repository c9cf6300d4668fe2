"""Process pool: children that process one request at a time and are replaced when they die or exceed a limit."""

from __future__ import annotations

import contextlib
import fcntl
import mmap
import os
import select
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from server.parsing.child import ANSWER, DONE, READY, REQUEST
from server.parsing.turns import Turn

IS_SUPPORTED = hasattr(os, "memfd_create") and hasattr(fcntl, "F_ADD_SEALS")
"""Whether this system supports sealed shared memory."""
PIPE_BYTES = 1 << 20
LOADING_TIMEOUT_S = 60.0
STOPPED = "was stopped: the server ends"


class ChildDied(Exception):
    """The child died or was killed during a request. The message completes a sentence such as "the reader ..."."""


@dataclass(frozen=True)
class JobSpec:
    """Job and resource limits of one kind of child."""

    job: str
    """`module:function`, see server.parsing.child."""
    memory_mib: int
    """Address space limit."""
    timeout_s: float
    """Time limit for one request."""
    max_answer_bytes: int
    """Largest answer in bytes."""
    shared_bytes: int = 0
    """Size of the memory that the child writes and the server reads."""


class ChildProcess:
    """One process. Not thread-safe."""

    def __init__(self, spec: JobSpec) -> None:
        self._spec = spec
        arguments = [sys.executable, "-P", "-m", "server.parsing.child", spec.job]
        arguments += [str(spec.memory_mib), str(spec.timeout_s)]
        self.shared: mmap.mmap | None = None
        self._is_ready = False
        descriptors: list[int] = []
        if spec.shared_bytes:
            descriptors.append(_sealed_memory(spec.shared_bytes))
            self.shared = mmap.mmap(descriptors[0], spec.shared_bytes, prot=mmap.PROT_READ)
            arguments.append(str(descriptors[0]))
        self.process = subprocess.Popen(
            arguments,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            pass_fds=descriptors,
            env=_environment(),
            start_new_session=True,  # Ctrl-C must reach only the server
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self._requests, self._answers = self.process.stdin.fileno(), self.process.stdout.fileno()
        for pipe in (self._requests, self._answers):
            os.set_blocking(pipe, False)
            with contextlib.suppress(OSError):  # the per-user limit on pipe memory may be reached
                fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        for descriptor in descriptors:
            os.close(descriptor)

    @property
    def is_ready(self) -> bool:
        """Whether it has loaded and is running. Only while it is not in use."""
        if not self.is_alive:
            return False
        said = select.poll()
        said.register(self._answers, select.POLLIN)
        return self._is_ready or bool(said.poll(0))

    @property
    def is_alive(self) -> bool:
        """Whether the process is running."""
        return self.process.poll() is None

    def wait_until_ready(self) -> None:
        """Wait until a new child has loaded. Raises ChildDied."""
        if not self._is_ready:
            self._is_ready = self._read(len(READY), time.monotonic() + LOADING_TIMEOUT_S) == READY

    def ask(self, request: bytes) -> bytearray:
        """Send a request and wait for the answer. Raises ValueError with the child's line, or ChildDied."""
        self.wait_until_ready()
        deadline_s = time.monotonic() + self._spec.timeout_s
        self._write(memoryview(REQUEST.pack(len(request))), deadline_s)
        self._write(memoryview(request), deadline_s)
        state, size = ANSWER.unpack(self._read(ANSWER.size, deadline_s))
        if size > self._spec.max_answer_bytes:
            self.kill()
            raise ChildDied("was stopped: its answer was too large")
        body = self._read(size, deadline_s)
        if state != DONE:
            raise ValueError(body[:2000].decode(errors="replace"))
        return body

    def kill(self) -> None:
        """Kill the process and free its memory and pipes."""
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            with contextlib.suppress(OSError):
                if pipe is not None:
                    pipe.close()
        if self.shared is not None:
            self.shared.close()

    def _write(self, data: memoryview, deadline_s: float) -> None:
        while data:
            self._wait(self._requests, select.POLLOUT, deadline_s)
            try:
                data = data[os.write(self._requests, data) :]
            except BlockingIOError:
                continue
            except BrokenPipeError:
                self._raise_died()

    def _read(self, size: int, deadline_s: float) -> bytearray:
        data = bytearray(size)
        rest = memoryview(data)
        while rest:
            self._wait(self._answers, select.POLLIN, deadline_s)
            try:
                count = os.readv(self._answers, [rest])
            except BlockingIOError:
                continue
            if not count:
                self._raise_died()
            rest = rest[count:]
        return data

    def _wait(self, pipe: int, event: int, deadline_s: float) -> None:
        poll = select.poll()
        poll.register(pipe, event)
        left_s = deadline_s - time.monotonic()
        if left_s <= 0 or not poll.poll(left_s * 1e3):
            self.kill()
            raise ChildDied(f"was stopped: it took more than {self._spec.timeout_s:g} s")

    def _raise_died(self) -> None:
        """Raise ChildDied with the exit status."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(1.0)
        code = self.process.returncode
        self.kill()
        raise ChildDied("died on it" if code is None or code >= 0 else f"died on it (signal {-code})")


class ProcessPool:
    """Pool of one kind of child. Thread-safe. Children that have loaded are used first, so that few are started."""

    def __init__(
        self, spec: JobSpec, most: int, on_death: Callable[[], None] = lambda: None, *, has_spare: bool = False
    ) -> None:
        """Starts no process yet. `on_death` is called in the requesting thread when a child dies.

        `has_spare`: the last child is started as soon as all others are in use: it has loaded when it is needed.
        """
        self._spec = spec
        self._on_death = on_death
        self._has_spare = has_spare
        self._idle: list[ChildProcess | None] = [None] * most
        """A place for each child that is not in use; None: not started."""
        self._returned = threading.Condition()
        self._all: set[ChildProcess] = set()
        self._stopped = False

    @property
    def pids(self) -> list[int]:
        """Process ids of running children."""
        return [child.process.pid for child in tuple(self._all) if child.is_alive]

    def start_one(self) -> None:
        """Start a child, so that the first request does not wait for it to load."""
        with self._borrowed():
            pass

    @contextlib.contextmanager
    def _borrowed(self) -> Iterator[ChildProcess]:
        child = self._take()
        try:
            if self._stopped:
                raise ChildDied(STOPPED)
            if child is None or not child.is_alive:
                child = self._replaced(child)
            if self._has_spare:
                self._start_spare()
            yield child
        finally:
            with self._returned:
                self._idle.append(child)
                self._returned.notify()

    def _take(self) -> ChildProcess | None:
        """Wait for a place and take it: of a child that is ready, else of the last one that came back."""
        with self._returned:
            while not self._idle:
                self._returned.wait()
            ready = [k for k, child in enumerate(self._idle) if child is not None and child.is_ready]
            return self._idle.pop(ready[-1] if ready else -1)

    def _start_spare(self) -> None:
        """If one child is left that is not in use, start it and let it load; the next request waits less for it."""
        with self._returned:
            if len(self._idle) != 1 or self._stopped:
                return
            (child,) = self._idle
            if child is None or not child.is_alive:
                with contextlib.suppress(ChildDied):
                    self._idle[0] = self._replaced(child)

    def _replaced(self, child: ChildProcess | None) -> ChildProcess:
        if child is not None:
            self._all.discard(child)
            child.kill()
        try:
            new = ChildProcess(self._spec)
        except OSError as error:
            raise ChildDied(f"could not be started ({error.strerror})") from error
        self._all.add(new)
        if self._stopped:  # meanwhile
            new.kill()
            raise ChildDied(STOPPED)
        return new

    def ask(
        self,
        request: bytes,
        read: Callable[[bytearray, mmap.mmap | None], object] | None = None,
        turn: Turn | None = None,
    ) -> object:
        """Returns the answer, or `read(answer, shared memory)`. Raises ValueError, ChildDied.

        `turn`: the child is killed, and ChildDied raised, when it is interrupted.
        """
        with self._borrowed() as child:
            try:
                child.wait_until_ready()
                if turn is not None:
                    turn.set_interrupt(child.process.kill)
                answer = child.ask(request)
            except ChildDied:
                if turn is None or not turn.is_interrupted:
                    self._on_death()
                raise
            finally:
                if turn is not None:
                    turn.set_interrupt(None)
            return answer if read is None else read(answer, child.shared)

    def stop(self) -> None:
        """Kill all children. Requests in progress raise ChildDied."""
        self._stopped = True
        for child in tuple(self._all):
            child.process.kill()
            child.process.wait()
        with self._returned:
            for slot in self._idle:
                if slot is not None:
                    slot.kill()
            self._idle = [None] * len(self._idle)


def _sealed_memory(size: int) -> int:
    """Descriptor of shared memory that the child cannot shrink or grow."""
    descriptor = os.memfd_create("probeless", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(descriptor, size)
    fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
    return descriptor


def _environment() -> dict[str, str]:
    """Minimal environment for the child, without secrets such as the token."""
    kept = {name: os.environ[name] for name in ("PATH", "LD_LIBRARY_PATH", "LANG", "TMPDIR") if name in os.environ}
    threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
    # Keep freed image memory in the process: allocating it again from the system takes as long as decoding.
    memory = {"MALLOC_MMAP_THRESHOLD_": str(64 << 20), "MALLOC_TRIM_THRESHOLD_": str(128 << 20)}
    return {**kept, **threads, **memory, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
