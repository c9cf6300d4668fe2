"""Child process: `python -m server.parsing.child MODULE:FUNCTION MIB SECONDS [FD]` answers requests until input ends.

It writes one byte when it is ready. A request is an 8-byte length and a body. An answer is a status byte (0: done,
1: refused, with one line), an 8-byte length and a body. The function maps a request body to an answer body; ValueError
refuses the request. FD: memory shared with the server.
"""

from __future__ import annotations

import contextlib
import importlib
import mmap
import os
import signal
import struct
import sys
from collections.abc import Callable
from typing import BinaryIO

REQUEST, ANSWER = struct.Struct("<Q"), struct.Struct("<BQ")
DONE, REFUSED = 0, 1
READY = b"\x01"

Job = Callable[[bytes], bytes]


_shared: list[mmap.mmap] = []


def shared_memory() -> mmap.mmap:
    """Memory shared with the server. Only in a child that was started with FD."""
    return _shared[0]


def main(arguments: list[str]) -> None:
    """Load the function, set resource limits, answer requests."""
    module, _, function = arguments[0].partition(":")
    job: Job = getattr(importlib.import_module(module), function)
    if len(arguments) > 3:
        _shared.append(mmap.mmap(int(arguments[3]), 0))
    limit(int(arguments[1]))
    sys.stdout.buffer.write(READY)
    sys.stdout.buffer.flush()
    answer_all(job, sys.stdin.buffer, sys.stdout.buffer, float(arguments[2]))


def limit(memory_mib: int) -> None:
    """Limit address space; forbid writing files and starting processes. Skips limits that the system does not have."""
    with contextlib.suppress(ImportError):
        import resource

        limits = {"RLIMIT_AS": memory_mib << 20, "RLIMIT_FSIZE": 0, "RLIMIT_NPROC": 0, "RLIMIT_CORE": 0}
        for name, most in limits.items():
            with contextlib.suppress(AttributeError, ValueError, OSError):  # macOS has no RLIMIT_AS that works
                resource.setrlimit(getattr(resource, name), (most, most))


def answer_all(job: Job, requests: BinaryIO, answers: BinaryIO, seconds: float) -> None:
    """Answer requests in order. An alarm ends a child that hangs after its server has died."""
    while len(head := requests.read(REQUEST.size)) == REQUEST.size:
        body = requests.read(*REQUEST.unpack(head))
        signal.setitimer(signal.ITIMER_REAL, 2 * seconds)
        state, answer = _answer(job, body)
        signal.setitimer(signal.ITIMER_REAL, 0)
        answers.write(ANSWER.pack(state, len(answer)))
        answers.write(answer)
        answers.flush()


def _answer(job: Job, body: bytes) -> tuple[int, bytes]:
    try:
        return DONE, job(body)
    except MemoryError:
        return REFUSED, b"reading it takes too much memory: make it smaller"
    except ValueError as error:
        return REFUSED, str(error).encode(errors="replace")


if __name__ == "__main__":
    from server.parsing.child import main  # use the module instance that jobs import, not `__main__`

    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # decoders' messages about invalid input are not useful
    main(sys.argv[1:])
