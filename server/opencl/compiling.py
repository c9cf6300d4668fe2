"""Compiles kernels for PoCL in a process beside the server, into the cache on disk that both share.

PoCL compiles a kernel for its work-groups when it first runs so, and holds a lock meanwhile that every other launch on
the device waits for: frames of 35 ms of another client took 640 ms. What the process beside has compiled is only loaded
here, which takes milliseconds. PoCL has no call that compiles and does not run: there the kernel runs once, with the
same numbers, on memory of the same sizes that holds zeros. Should it crash on them, it has been compiled all the same,
and the process is started again.
"""

from __future__ import annotations

import contextlib
import json
import logging
import select
import subprocess
import sys
import threading
from dataclasses import asdict, dataclass
from pathlib import Path

from server.opencl.program import Define, define_options

IDLE_S = 600.0
"""The process ends when it has had nothing to do for so long: it takes 100 MB. Who needs it again waits 1 s more."""
PATIENCE_S = 120.0
"""For one kernel; the longest takes 2 s of a processor that is free. A process that takes longer is ended."""
NICENESS = 5
"""Frames go first, but who waits for a kernel gets a third of a busy processor at least, not a tenth."""
CAN_COMPILE_BESIDE = sys.platform != "win32"
"""Where pipes can be waited for."""
_ENDING_S = 1.0
"""Until a process that closed its pipes has its exit status."""
SMALL_GRID = 65535
"""PoCL compiles anew for launches with more work-items along an axis."""
DONE = b"done\n"
"""Answer to each request."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Launch:
    """A launch as far as PoCL compiles by it."""

    kernel: str
    size: tuple[int, ...]
    local: tuple[int, ...]
    offset: tuple[int, ...] | None
    arguments: tuple[int | str | None, ...]
    """Bytes of memory; of numbers and structs their own, in hexadecimal; None: no memory."""

    @property
    def variant(self) -> tuple[object, ...]:
        """Launches that are equal in this share what is compiled."""
        return self.kernel, self.local, self.offset is None, max(self.size) < SMALL_GRID


class KernelCompiler:
    """Of one device. Thread-safe; starts its process when it is needed."""

    def __init__(self, device: str, idle_s: float = IDLE_S) -> None:
        """`device`: its name, as `open_device` takes it."""
        self._command = [sys.executable, "-P", "-c", _program(), device, str(idle_s)]
        self._process: subprocess.Popen[bytes] | None = None
        self._working = threading.Lock()
        self._known: set[tuple[object, ...]] = set()
        self.is_used = False
        """Before, whoever launches a kernel compiles it, as in a program that has the device for itself."""

    def knows(self, file: str, defines: dict[str, Define], launch: Launch | None = None) -> bool:
        """Whether it was asked for before."""
        return _key(file, defines, launch) in self._known

    def compile(self, file: str, defines: dict[str, Define], launch: Launch | None = None) -> None:
        """Compile the program of that file, and for that launch. Returns when it is done, or cannot be done there."""
        if self.is_used:
            request = {"file": file, "defines": defines, "launch": None if launch is None else asdict(launch)}
            with self._working:
                if not self.knows(file, defines, launch):
                    self._ask(json.dumps(request).encode() + b"\n")
        self._known.add(_key(file, defines, launch))

    def close(self) -> None:
        """End the process."""
        with self._working:
            if self._process is not None:
                self._process.kill()
            self._end()

    def _ask(self, request: bytes) -> None:
        try:
            process = self._process = self._process or self._start()
            if self._answered(process, request):
                return
            had_ended = self._end() == 0  # with nothing to do, just now; else the kernel crashed
            self._process = self._start()  # it is there when it is needed again
            if had_ended:
                self._answered(self._process, request)
        except OSError as error:
            log.warning("no process for compiling kernels could be started: %s", error)

    def _answered(self, process: subprocess.Popen[bytes], request: bytes) -> bool:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(request)
            process.stdin.flush()
        except OSError:
            return False
        if not select.select([process.stdout], [], [], PATIENCE_S)[0]:
            log.warning("compiling a kernel took more than %g s", PATIENCE_S)
            return False
        return process.stdout.readline() == DONE

    def _start(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            self._command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # of crashes, which are expected
            start_new_session=True,  # a terminal's Ctrl-C is for the server, which ends this process
        )

    def _end(self) -> int | None:
        """Exit status of the process; None: there was none."""
        process, self._process = self._process, None
        if process is None:
            return None
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_ENDING_S)
        process.kill()
        status = process.wait()
        for pipe in (process.stdin, process.stdout):
            assert pipe is not None
            with contextlib.suppress(OSError):  # what was not sent
                pipe.close()
        return status


def _key(file: str, defines: dict[str, Define], launch: Launch | None) -> tuple[object, ...]:
    return file, define_options(defines), None if launch is None else launch.variant


def _program() -> str:
    root = str(Path(__file__).parents[2])
    return f"import sys; sys.path.insert(0, {root!r}); from server.opencl.compiler_process import main; main()"
