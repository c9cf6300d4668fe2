"""Who reads a mesh when: nobody waits for another session's large file."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace

import pytest

from server.children.turns import MAX_INTERRUPTIONS, Account, Overdrawn, Turns
from server.parsing.parsers import MESH_CHILDREN, MESH_JOB, Parsers
from server.scene.limits import MeshError
from tests.service.fakes import PATIENCE_S

STUBBORN = replace(MESH_JOB, job="tests.service.jobs:read_mesh", timeout_s=10 * PATIENCE_S)


class Clock:
    """A time that the test turns."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def until(holds: Callable[[], bool]) -> None:
    """Wait for a condition."""
    end_s = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < end_s
        time.sleep(0.01)


def account(used_s: float) -> Account:
    """One that has used so much."""
    made = Account(burst_s=1000.0, rate=0.0)
    made.spend(used_s)
    return made


def test_who_has_used_least_goes_first() -> None:
    turns, order = Turns(1), []

    def take(name: str, used_s: float) -> threading.Thread:
        def run() -> None:
            with turns.taken(account(used_s)):
                order.append(name)

        thread = threading.Thread(target=run)
        thread.start()
        return thread

    with turns.taken(account(0.0)):
        threads = []
        for name, used_s in (("much", 9.0), ("little", 1.0), ("some", 4.0), ("little, later", 1.0)):
            threads.append(take(name, used_s))
            until(lambda: turns.waiting == len(threads))
    for thread in threads:
        thread.join(PATIENCE_S)
    assert order == ["little", "little, later", "some", "much"]


@pytest.fixture
def parsers() -> Iterator[Parsers]:
    """Whose files may hang."""
    made = Parsers(STUBBORN)
    made.mesh_turns = Turns(MESH_CHILDREN, slice_s=0.01)
    yield made
    made.stop()


def hogs(parsers: Parsers, said: list[str]) -> list[threading.Thread]:
    """A session at each reader whose file takes forever."""

    def run() -> None:
        try:
            parsers.load_mesh(b"hang", "ply", account(10.0))
        except MeshError as error:
            said.append(str(error))

    threads = [threading.Thread(target=run) for _ in range(MESH_CHILDREN)]
    for thread in threads:
        thread.start()
    until(lambda: at_work(parsers) == MESH_CHILDREN)
    return threads


def at_work(parsers: Parsers) -> int:
    """Sessions whose files are being read."""
    return sum(turn.interrupt is not None for turn in tuple(parsers.mesh_turns._running))


def test_another_session_does_not_wait_for_files_that_take_long(parsers: Parsers) -> None:
    """Without turns, it would wait for ten times the time limit of a test."""
    deaths: list[str] = []
    parsers.on_death = deaths.append
    threads = hogs(parsers, said := [])
    assert len(parsers.load_mesh(b"tiny", "ply", account(0.0)).vertices) == 3
    assert said == []
    assert deaths == []
    until(lambda: at_work(parsers) == MESH_CHILDREN)  # who was interrupted has begun again
    parsers.stop()
    for thread in threads:
        thread.join(PATIENCE_S)


def test_who_is_interrupted_too_often_is_told(parsers: Parsers) -> None:
    threads = hogs(parsers, said := [])
    for _ in range(MESH_CHILDREN * (1 + MAX_INTERRUPTIONS)):
        assert parsers.load_mesh(b"tiny", "ply", account(0.0)).triangles.shape == (1, 3)
        until(lambda: bool(said) or at_work(parsers) == MESH_CHILDREN)
        if said:
            break
    assert "other sessions needed the reader" in said[0]
    parsers.stop()
    for thread in threads:
        thread.join(PATIENCE_S)


def test_reading_time_is_a_budget_that_refills() -> None:
    clock = Clock()
    session = Account(burst_s=10.0, rate=0.5, clock=clock)
    session.spend(14.0)
    with pytest.raises(Overdrawn, match=r"used its 10 s of reading: try again in 8 s"):
        session.check()
    clock.now_s = 8.0
    session.check()
    clock.now_s = 100.0
    assert session.used_s == 0.0


def test_a_turn_is_charged_to_its_session() -> None:
    clock = Clock()
    turns, session = Turns(1, clock), Account(10.0, 0.5, clock)
    with suppress(ValueError), turns.taken(session):
        clock.now_s = 12.0
        raise ValueError
    assert session.used_s == 12.0
    with pytest.raises(Overdrawn), turns.taken(session):
        pass


def test_a_session_over_its_budget_is_told_by_its_reader(parsers: Parsers) -> None:
    poor = Account(burst_s=1.0, rate=0.001)
    poor.spend(2.0)
    with pytest.raises(MeshError, match="used its 1 s of reading"):
        parsers.load_mesh(b"tiny", "ply", poor)
    assert parsers.mesh_loader()(b"tiny", "ply").triangles.shape == (1, 3)
