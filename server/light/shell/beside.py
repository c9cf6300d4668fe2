"""Work beside the frames: in a thread of its own, at lower priority than what draws."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Generic, TypeVar

from server.children.priority import yield_to_others

Result = TypeVar("Result")


class Beside(Generic[Result]):
    """One piece of work, begun when this is made."""

    def __init__(self, work: Callable[[], Result]) -> None:
        self._future: Future[Result] = Future()
        self._began_s = time.monotonic()
        threading.Thread(target=self._run, args=(work,), name="beside").start()

    @property
    def age_s(self) -> float:
        """Seconds since it was begun."""
        return time.monotonic() - self._began_s

    @property
    def is_done(self) -> bool:
        """Whether `result` does not wait."""
        return self._future.done()

    def result(self) -> Result:
        """Wait for it. Raises what the work raised."""
        return self._future.result()

    def _run(self, work: Callable[[], Result]) -> None:
        try:
            yield_to_others()
            self._future.set_result(work())
        except BaseException as error:  # raised again where the result is asked for
            self._future.set_exception(error)
