"""Process pool: children that process one request at a time and are replaced when they die or exceed a limit."""

from __future__ import annotations

import contextlib
import mmap
import os
import select
import signal
import threading
import time
from collections.abc import Callable, Iterator

from server.children.child import ANSWER, DONE, REQUEST
from server.children.nursery import ChildDied, JobSpec, Nursery
from server.children.turns import Turn

try:
    import fcntl
except ImportError:  # Windows
    IS_SUPPORTED = False
else:
    IS_SUPPORTED = hasattr(os, "memfd_create") and hasattr(fcntl, "F_ADD_SEALS")
"""Whether this system supports sealed shared memory."""
PIPE_BYTES = 1 << 20
STOPPED = "was stopped: the server ends"


class ChildProcess:
    """One process. Used by one thread; others may end it."""

    def __init__(self, nursery: Nursery, spec: JobSpec) -> None:
        """Raises ChildDied if it cannot be started."""
        self._nursery, self._spec = nursery, spec
        self._ending = threading.Lock()
        self._has_ended = False
        self._status: int | None = None
        """Exit status once it is reaped, if that is known."""
        self.shared: mmap.mmap | None = None
        theirs: list[int] = []
        requests, self._requests = os.pipe()
        self._answers, answers = os.pipe()
        theirs += (requests, answers)
        if spec.shared_bytes:
            theirs.append(_sealed_memory(spec.shared_bytes))
            self.shared = mmap.mmap(theirs[-1], spec.shared_bytes, prot=mmap.PROT_READ)
        for pipe in (self._requests, self._answers):
            os.set_blocking(pipe, False)
            with contextlib.suppress(OSError):  # the per-user limit on pipe memory may be reached
                fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        try:
            self.pid = nursery.fork(*theirs)
        except ChildDied:
            self._has_ended = True
            self._close()
            raise
        finally:
            for descriptor in theirs:
                os.close(descriptor)

    @property
    def is_alive(self) -> bool:
        """Whether the process is running."""
        with self._ending:
            if self._has_ended or self._answers < 0:
                return False
            told = select.poll()
            told.register(self._answers, 0)  # the end of its pipe, which comes with its own
            return not told.poll(0)

    def ask(self, request: bytes) -> bytearray:
        """Send a request and wait for the answer. Raises ValueError with the child's line, or ChildDied."""
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

    def end(self) -> None:
        """End the process; whoever waits for its answer is told. From any thread."""
        with self._ending:
            if self._has_ended:
                return
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)
            self._status = self._nursery.reap(self.pid)
            self._has_ended = True

    def leave(self) -> None:
        """Close the pipes: it ends once it has answered. Takes no lock, so that a finaliser may call it."""
        self._close()

    def kill(self) -> None:
        """End the process and free its memory and pipes."""
        self.end()
        self._close()

    def _close(self) -> None:
        for pipe in (self._requests, self._answers):
            if pipe >= 0:
                os.close(pipe)
        self._requests = self._answers = -1
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
        self.kill()
        code = self._status
        raise ChildDied("died on it" if code is None or code >= 0 else f"died on it (signal {-code})")


class ProcessPool:
    """Pool of one kind of child. Thread-safe. Few are started: those that live are used first."""

    def __init__(
        self,
        spec: JobSpec,
        most: int,
        on_death: Callable[[], None] = lambda: None,
        nursery: Nursery | None = None,
    ) -> None:
        """Starts no process yet. `on_death` is called in the requesting thread when a child dies.

        `nursery`: that of pools which have the same job; None: one of its own.
        """
        self._spec = spec
        self._on_death = on_death
        self._owns_nursery = nursery is None
        self._nursery = nursery or Nursery(spec)
        self._idle: list[ChildProcess | None] = [None] * most
        """A place for each child that is not in use; None: not started."""
        self._returned = threading.Condition()
        self._all: set[ChildProcess] = set()
        self._stopped = False

    @property
    def pids(self) -> list[int]:
        """Process ids of running children."""
        return [child.pid for child in tuple(self._all) if child.is_alive]

    def load(self) -> None:
        """Load what the children need in the background, so that the first request does not wait for it."""
        self._nursery.load()

    @contextlib.contextmanager
    def _borrowed(self) -> Iterator[ChildProcess]:
        child = self._take()
        try:
            if self._stopped:
                raise ChildDied(STOPPED)
            if child is None or not child.is_alive:
                child = self._replaced(child)
            yield child
        finally:
            with self._returned:
                self._idle.append(child)
                self._returned.notify()

    def _take(self) -> ChildProcess | None:
        """Wait for a place and take it: of a child that lives, else of the last one that came back."""
        with self._returned:
            while not self._idle:
                self._returned.wait()
            alive = [k for k, child in enumerate(self._idle) if child is not None and child.is_alive]
            return self._idle.pop(alive[-1] if alive else -1)

    def _replaced(self, child: ChildProcess | None) -> ChildProcess:
        if child is not None:
            self._all.discard(child)
            child.kill()
        new = ChildProcess(self._nursery, self._spec)
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
                if turn is not None:
                    turn.set_interrupt(child.end)
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
            child.end()
        with self._returned:
            for slot in self._idle:
                if slot is not None:
                    slot.kill()
            self._idle = [None] * len(self._idle)
        if self._owns_nursery:
            self._nursery.stop()


def _sealed_memory(size: int) -> int:
    """Descriptor of shared memory that the child cannot shrink or grow."""
    descriptor = os.memfd_create("probeless", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(descriptor, size)
    fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
    return descriptor
