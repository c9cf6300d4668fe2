"""Answers are written in order beside what is shown; a slow disk neither holds them up nor fills memory."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import partial

import pytest

from client.errors import OutputError
from client.results.write_behind import MOST_WAITING, WriteBehind


@pytest.fixture
def disk() -> Iterator[threading.Event]:
    """A disk that writes nothing until it is set."""
    ready = threading.Event()
    yield ready
    ready.set()


def test_all_is_written_in_order() -> None:
    written: list[int] = []
    with WriteBehind() as behind:
        for number in range(50):
            behind.begin(partial(written.append, number))
    assert written == list(range(50))


def test_nothing_is_due_until_too_much_waits(disk: threading.Event) -> None:
    with WriteBehind() as behind:
        for _ in range(MOST_WAITING):
            behind.begin(lambda: disk.wait() and None)
            assert behind.due() is None
        behind.begin(lambda: None)
        oldest = behind.due()
        assert oldest is not None
        assert not oldest.done()
        disk.set()
        oldest.result(10.0)


def test_what_is_refused_is_told_with_the_next_answer() -> None:
    behind = WriteBehind()
    behind.begin(_refuse)
    while (written := behind.due()) is None:
        pass
    with pytest.raises(OutputError, match="the disk is full"):
        written.result()


def test_the_last_that_is_refused_is_told_at_the_end() -> None:
    with pytest.raises(OutputError, match="the disk is full"), WriteBehind() as behind:
        behind.begin(_refuse)


def test_an_error_before_it_is_the_one_to_tell() -> None:
    written: list[int] = []

    def fail() -> None:
        with WriteBehind() as behind:
            behind.begin(_refuse)
            behind.begin(partial(written.append, 1))
            raise RuntimeError("earlier")

    with pytest.raises(RuntimeError, match="earlier"):
        fail()
    assert written == [1]


def _refuse() -> None:
    raise OutputError("the disk is full")
