"""Each contestant in a process of its own: their thread pools and compilers must not meet, and a crash stays theirs."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from multiprocessing import get_context
from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray

from protocol.frames import RgbdFrame
from server.opencl.device import list_devices
from tests.bench.peers.contestant import Contestant, Scene, Turn

REST_S = 0.03
"""Before each turn: thread pools of the one before stop spinning within it."""


def device_name(kind: str) -> str | None:
    """What to open for the first usable device of a kind, CPU or GPU."""
    found = [info for info in list_devices() if info.kind == kind and info.usable is None]
    return f"{found[0].platform} / {found[0].name}" if found else None


class ContestantLostError(RuntimeError):
    """One line that says why it cannot go on."""


@dataclass(frozen=True)
class Entry:
    """Who takes part, and where it is."""

    name: str
    module: str
    attribute: str
    needs: str = ""
    """The package without which it is left out."""
    kind: str = ""
    """The kind of OpenCL device it runs on, where it runs on one: CPU or GPU."""

    def absence(self) -> str | None:
        """Why it cannot take part here, in one line."""
        if self.needs and find_spec(self.needs) is None:
            return f"{self.needs} is not installed: make install-bench"
        if self.kind and device_name(self.kind) is None:
            return f"no usable OpenCL {self.kind} here"
        return None


class Worker:
    """A contestant's process. Use as a context."""

    def __init__(self, entry: Entry, scene: Scene) -> None:
        self.entry = entry
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, entry, scene), daemon=True)
        self._process.start()
        theirs.close()

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *error: object) -> None:
        self._pipe.close()
        self._process.join(timeout=5)
        self._process.terminate()

    def process(self, frame: RgbdFrame) -> Turn:
        """Play one turn. Raises ContestantLostError."""
        turn = self._ask("process", frame)
        assert isinstance(turn, Turn)
        return turn

    def depth(self, frame: RgbdFrame) -> NDArray[np.float32] | None:
        """The surface from the frame's view. Raises ContestantLostError."""
        answer = self._ask("depth", frame)
        assert answer is None or isinstance(answer, np.ndarray)
        return answer

    def _ask(self, action: str, frame: RgbdFrame) -> object:
        time.sleep(REST_S)
        try:
            self._pipe.send((action, frame))
            answer: object = self._pipe.recv()
        except (EOFError, OSError) as error:
            self._process.join(timeout=5)
            raise ContestantLostError(f"its process ended with status {self._process.exitcode}") from error
        if isinstance(answer, Exception):
            raise ContestantLostError(f"{type(answer).__name__}: {answer}".splitlines()[0])
        return answer


def _serve(pipe: Connection, entry: Entry, scene: Scene) -> None:
    os.dup2(2, 1)  # libraries that print must not write into our result
    contestant: Contestant | None = None
    while True:
        try:
            action, frame = pipe.recv()
        except EOFError:
            return
        try:
            if contestant is None:
                contestant = getattr(import_module(entry.module), entry.attribute)(scene)
            pipe.send(_answer(contestant, action, frame))
        except Exception as error:
            pipe.send(RuntimeError(f"{type(error).__name__}: {error}"))


def _answer(contestant: Contestant, action: str, frame: RgbdFrame) -> object:
    if action == "depth":
        return contestant.depth(frame)
    turn = Turn()
    contestant.process(frame, turn)
    return turn
