"""The child: `python -m server.parsing.child MODULE:FUNCTION MIB SECONDS [FD]` answers requests until its input ends.

Once it has loaded what it works with it says so with one byte. A request is 8 bytes of length and a body; an answer
1 byte (0: done, 1: refused with one line), 8 bytes of length and a body. The function turns a body into an answer's;
ValueError refuses. FD: memory that it shares with the server.
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
    """What the server sees too; in a child that was given some."""
    return _shared[0]


def main(arguments: list[str]) -> None:
    """Load the job, limit what it may take, answer."""
    module, _, function = arguments[0].partition(":")
    job: Job = getattr(importlib.import_module(module), function)
    if len(arguments) > 3:
        _shared.append(mmap.mmap(int(arguments[3]), 0))
    limit(int(arguments[1]))
    sys.stdout.buffer.write(READY)
    sys.stdout.buffer.flush()
    answer_all(job, sys.stdin.buffer, sys.stdout.buffer, float(arguments[2]))


def limit(memory_mib: int) -> None:
    """No more address space than that, no files, no processes; where the system knows such limits."""
    with contextlib.suppress(ImportError):
        import resource

        limits = {"RLIMIT_AS": memory_mib << 20, "RLIMIT_FSIZE": 0, "RLIMIT_NPROC": 0, "RLIMIT_CORE": 0}
        for name, most in limits.items():
            with contextlib.suppress(AttributeError, ValueError, OSError):  # macOS has no RLIMIT_AS that works
                resource.setrlimit(getattr(resource, name), (most, most))


def answer_all(job: Job, requests: BinaryIO, answers: BinaryIO, seconds: float) -> None:
    """One answer to each request, in order. The kernel ends a child whose server is no longer there to do so."""
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
    from server.parsing.child import main  # the module that jobs import, not a second one of it

    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # what decoders mutter about strangers' bytes is no news
    main(sys.argv[1:])
