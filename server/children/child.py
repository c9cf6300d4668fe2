"""Children that do one job apart from the server: `python -m server.children.child MODULE:FUNCTION MIB SECONDS`.

The process loads the function and forks children over a socket, its standard input (nursery.py): a message with
descriptors (requests, answers and memory shared with the server) is answered by the id of a new child or minus an error
number, one with a child's id by its wait status once it has ended. It ends when the socket is closed.

A child answers requests until input ends. A request is an 8-byte length and a body. An answer is a status byte (0:
done, 1: refused, with one line), an 8-byte length and a body. The function maps a request body to an answer body;
ValueError refuses the request.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import mmap
import os
import signal
import socket
import struct
import sys
from collections.abc import Callable
from typing import BinaryIO

REQUEST, ANSWER, NUMBER = struct.Struct("<Q"), struct.Struct("<BQ"), struct.Struct("<q")
DONE, REFUSED = 0, 1
READY = b"\x01"

Job = Callable[[bytes], bytes]


_shared: list[mmap.mmap] = []


def shared_memory() -> mmap.mmap:
    """Memory shared with the server. Only in a child that was given some."""
    return _shared[0]


def main(arguments: list[str]) -> None:
    """Load the function and fork children until the server closes the socket."""
    module, _, function = arguments[0].partition(":")
    job: Job = getattr(importlib.import_module(module), function)
    gc.freeze()  # else each child copies the pages of all that is loaded
    with socket.socket(fileno=0) as control:
        control.send(READY)
        while True:
            command, descriptors, _, _ = socket.recv_fds(control, NUMBER.size, 3)
            if not command:
                return
            if descriptors:
                answer = _forked(job, int(arguments[1]), float(arguments[2]), control, descriptors)
            else:
                (pid,) = NUMBER.unpack(command)
                answer = os.waitpid(pid, 0)[1]
            control.send(NUMBER.pack(answer))


def _forked(job: Job, memory_mib: int, seconds: float, control: socket.socket, descriptors: list[int]) -> int:
    """The id of a child, or minus an error number."""
    try:
        pid = os.fork()
    except OSError as error:
        pid = -(error.errno or 1)
    if pid == 0:
        try:
            control.close()
            _live(job, memory_mib, seconds, *descriptors)
        finally:
            os._exit(1)
    for descriptor in descriptors:
        os.close(descriptor)
    return pid


def _live(job: Job, memory_mib: int, seconds: float, requests: int, answers: int, memory: int | None = None) -> None:
    """The life of a child. Does not return."""
    if memory is not None:
        _shared.append(mmap.mmap(memory, 0))
    limit(memory_mib)
    with os.fdopen(requests, "rb") as read, os.fdopen(answers, "wb") as write:
        answer_all(job, read, write, seconds)
    os._exit(0)


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
    from server.children.child import main  # use the module instance that jobs import, not `__main__`

    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # decoders' messages about invalid input are not useful
    main(sys.argv[1:])
