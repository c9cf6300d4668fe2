"""What the user sees while frames are processed: a bar on standard error, a line at the end."""

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
    """Frames in a second, over the last few."""

    def render(self, task: Task) -> Text:
        return Text(f"{task.speed:.1f} frames/s" if task.speed else "- frames/s")


def track(items: Iterable[T], total: int | None) -> Iterator[T]:
    """The items, with a bar on standard error where that is a terminal. `total`: None where they have no end."""
    columns = (BarColumn(), MofNCompleteColumn(), FramesPerSecond(), TextColumn("left"), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("", total=total)
        for item in items:
            yield item
            progress.advance(task)


@contextmanager
def progress_bar(name: str) -> Iterator[Callable[[int, int], None]]:
    """A bar on standard error, where that is a terminal, moved by calls with what is done and what there is in all."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(name, total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)


class Stopwatch:
    """Counts frames and the seconds they took."""

    def __init__(self) -> None:
        self._start_s = time.perf_counter()
        self.frames = 0

    def summary(self) -> str:
        """`60 frames in 12.3 s (4.9 frames/s)`."""
        seconds = max(time.perf_counter() - self._start_s, 1e-9)
        return f"{self.frames} frames in {seconds:.1f} s ({self.frames / seconds:.1f} frames/s)"


def say(text: str) -> None:
    """A line of result on standard output."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def note(text: str) -> None:
    """A line of comment on standard error."""
    sys.stderr.write(f"probeless: {text}\n")
    sys.stderr.flush()
