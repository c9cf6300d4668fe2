"""Progress bars and notes on standard error, results on standard output."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

T = TypeVar("T")


class FramesPerSecond(ProgressColumn):
    """Column with recent frames per second."""

    def render(self, task: Task) -> Text:
        return Text(f"{task.speed:.1f} frames/s" if task.speed else "- frames/s")


def track(items: Iterable[T], total: int | None) -> Iterator[T]:
    """The items, with a progress bar if standard error is a terminal. `total`: None: unknown."""
    columns = (BarColumn(), MofNCompleteColumn(), FramesPerSecond(), TextColumn("left"), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("", total=total)
        for item in items:
            yield item
            progress.advance(task)


@contextmanager
def progress_bar(name: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar if standard error is a terminal; yields a function of (done, total) that updates it."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(name, total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)


class Stopwatch:
    """Counts frames and measures their time."""

    def __init__(self) -> None:
        self._start_s = time.perf_counter()
        self.frames = 0

    def summary(self) -> str:
        """`60 frames in 12.3 s (4.9 frames/s)`."""
        seconds = max(time.perf_counter() - self._start_s, 1e-9)
        return f"{self.frames} frames in {seconds:.1f} s ({self.frames / seconds:.1f} frames/s)"


def say(text: str) -> None:
    """Print a line of result on standard output."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def note(text: str) -> None:
    """Print a note on standard error."""
    sys.stderr.write(f"probeless: {text}\n")
    sys.stderr.flush()
