"""The server's side: a few children that each do one job at a time, and are replaced when they die or take too long."""

from __future__ import annotations

import contextlib
import fcntl
import mmap
import os
import queue
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from server.parsing.child import ANSWER, DONE, READY, REQUEST

IS_SUPPORTED = hasattr(os, "memfd_create") and hasattr(fcntl, "F_ADD_SEALS")
"""Whether this system has what it takes."""
PIPE_BYTES = 1 << 20
LOADING_TIMEOUT_S = 60.0
STOPPED = "was stopped: the server ends"


class ChildDied(Exception):
    """The child ended, or was ended, in the middle of a request; what happened, as the rest of a sentence."""


@dataclass(frozen=True)
class JobSpec:
    """What children of one kind do, and what each may take."""

    job: str
    """`module:function`, as server.parsing.child runs it."""
    memory_mib: int
    """Of address space."""
    timeout_s: float
    """For one request."""
    max_answer_bytes: int
    """Bytes."""
    shared_bytes: int = 0
    """Of memory that the child writes and the server reads."""


class ChildProcess:
    """One process. Used by one thread at a time."""

    def __init__(self, work: JobSpec) -> None:
        self._work = work
        arguments = [sys.executable, "-P", "-m", "server.parsing.child", work.job]
        arguments += [str(work.memory_mib), str(work.timeout_s)]
        self.shared: mmap.mmap | None = None
        self._is_ready = False
        descriptors: list[int] = []
        if work.shared_bytes:
            descriptors.append(_sealed_memory(work.shared_bytes))
            self.shared = mmap.mmap(descriptors[0], work.shared_bytes, prot=mmap.PROT_READ)
            arguments.append(str(descriptors[0]))
        self.process = subprocess.Popen(
            arguments,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            pass_fds=descriptors,
            env=_environment(),
            start_new_session=True,  # Ctrl-C is for the server
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self._requests, self._answers = self.process.stdin.fileno(), self.process.stdout.fileno()
        for pipe in (self._requests, self._answers):
            os.set_blocking(pipe, False)
            with contextlib.suppress(OSError):  # a user's pipes may be limited together
                fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        for descriptor in descriptors:
            os.close(descriptor)

    @property
    def is_alive(self) -> bool:
        """Whether it can be asked."""
        return self.process.poll() is None

    def ask(self, request: bytes) -> bytearray:
        """The answer. Raises ValueError with the child's line, ChildDied; then it is dead."""
        if not self._is_ready:
            self._is_ready = self._read(len(READY), time.monotonic() + LOADING_TIMEOUT_S) == READY
        deadline_s = time.monotonic() + self._work.timeout_s
        self._write(memoryview(REQUEST.pack(len(request))), deadline_s)
        self._write(memoryview(request), deadline_s)
        state, size = ANSWER.unpack(self._read(ANSWER.size, deadline_s))
        if size > self._work.max_answer_bytes:
            self.kill()
            raise ChildDied("was stopped: it made more of it than may be")
        body = self._read(size, deadline_s)
        if state != DONE:
            raise ValueError(body[:2000].decode(errors="replace"))
        return body

    def kill(self) -> None:
        """End it now; its memory and pipes are given back."""
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
            raise ChildDied(f"was stopped: it took more than {self._work.timeout_s:g} s")

    def _raise_died(self) -> None:
        """Raises ChildDied with how it ended."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(1.0)
        code = self.process.returncode
        self.kill()
        raise ChildDied("died on it" if code is None or code >= 0 else f"died on it (signal {-code})")


class ProcessPool:
    """Of one kind, for any number of threads; the one that worked last works next, so that few are ever needed."""

    def __init__(self, work: JobSpec, most: int, on_death: Callable[[], None] = lambda: None) -> None:
        """Starts none of them yet. `on_death` is called, by the thread that asked, for each that dies at work."""
        self._work = work
        self._on_death = on_death
        self._idle: queue.LifoQueue[ChildProcess | None] = queue.LifoQueue()
        self._all: set[ChildProcess] = set()
        self._stopped = False
        for _ in range(most):
            self._idle.put(None)

    @property
    def pids(self) -> list[int]:
        """Of those that live."""
        return [child.process.pid for child in tuple(self._all) if child.is_alive]

    def start_one(self) -> None:
        """So that the first request need not wait for the child to load what it works with."""
        with self._borrowed():
            pass

    @contextlib.contextmanager
    def _borrowed(self) -> Iterator[ChildProcess]:
        child = self._idle.get()
        try:
            if self._stopped:
                raise ChildDied(STOPPED)
            if child is None or not child.is_alive:
                child = self._replaced(child)
            yield child
        finally:
            self._idle.put(child)

    def _replaced(self, child: ChildProcess | None) -> ChildProcess:
        if child is not None:
            self._all.discard(child)
            child.kill()
        try:
            new = ChildProcess(self._work)
        except OSError as error:
            raise ChildDied(f"could not be started ({error.strerror})") from error
        self._all.add(new)
        if self._stopped:  # meanwhile
            new.kill()
            raise ChildDied(STOPPED)
        return new

    def ask(self, request: bytes, take: Callable[[bytearray, mmap.mmap | None], object] | None = None) -> object:
        """The answer, or what `take` makes of it and of the shared memory. Raises ValueError, ChildDied."""
        with self._borrowed() as child:
            try:
                answer = child.ask(request)
            except ChildDied:
                self._on_death()
                raise
            return answer if take is None else take(answer, child.shared)

    def stop(self) -> None:
        """End them all, also those at work: whoever waits for one is told that it died."""
        self._stopped = True
        for child in tuple(self._all):
            child.process.kill()
            child.process.wait()
        idle: list[ChildProcess | None] = []
        with contextlib.suppress(queue.Empty):
            while True:
                idle.append(self._idle.get_nowait())
        for slot in idle:
            if slot is not None:
                slot.kill()
            self._idle.put(None)


def _sealed_memory(size: int) -> int:
    """A descriptor of memory that a child cannot make smaller under the server's eyes."""
    descriptor = os.memfd_create("probeless", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(descriptor, size)
    fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
    return descriptor


def _environment() -> dict[str, str]:
    """What Python needs, and nothing that a stranger's file should meet, such as a token."""
    kept = {name: os.environ[name] for name in ("PATH", "LD_LIBRARY_PATH", "LANG", "TMPDIR") if name in os.environ}
    threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
    # A picture's memory is kept for the next one: to get it anew from the system takes as long as to decode.
    memory = {"MALLOC_MMAP_THRESHOLD_": str(64 << 20), "MALLOC_TRIM_THRESHOLD_": str(128 << 20)}
    return {**kept, **threads, **memory, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
