"""Who gets into a room when: clients that stream as fast as they can share it, and what comes between waits shortly."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from server.opencl.device import Device
from server.room.room import Room
from server.service.scheduler import Scheduler
from tests.scenes.rooms import wishes
from tests.service.fakes import PATIENCE_S

FRAME_S = 0.002
"""Much more than it takes to hand a lock over."""
TURNS = 300
SHARE = 0.2
"""By which the shares of three clients may differ from a third."""


@contextmanager
def at_work(works: list[Callable[[], None]]) -> Iterator[None]:
    """Each again and again in a thread of its own, while it lasts."""
    stop = threading.Event()

    def run(work: Callable[[], None]) -> None:
        while not stop.is_set():
            work()

    threads = [threading.Thread(target=run, args=(work,)) for work in works]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join(PATIENCE_S)
    assert not any(thread.is_alive() for thread in threads)


def busy(seconds: float) -> None:
    end_s = time.perf_counter() + seconds
    while time.perf_counter() < end_s:
        pass


def until(holds: Callable[[], bool]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < end_s
        time.sleep(0.005)


@pytest.fixture
def room(device: Device) -> Iterator[Room]:
    room = Room(device, wishes("given"), "study")
    yield room
    room.close()


def test_clients_of_a_room_get_equal_shares_and_what_is_asked_between_waits_for_few_frames(room: Room) -> None:
    """As in the service: frames by the scheduler's turns; moves and saves by the lock alone."""
    scheduler, had, waited_s = Scheduler(), Counter[int](), list[float]()
    had_s = dict.fromkeys(range(3), 0.0)

    def frame_of(client: int) -> Callable[[], None]:
        share = scheduler.join("study")

        def frame() -> None:
            with scheduler.acquire(share):
                began = time.perf_counter()
                with room.lock:
                    busy(FRAME_S)
                had_s[client] += time.perf_counter() - began  # what it is charged: a busy machine makes it long
                had[client] += 1

        return frame

    def move() -> None:
        began = time.perf_counter()
        with room.lock:
            waited_s.append(time.perf_counter() - began)
        time.sleep(FRAME_S)

    def shares_are_equal() -> bool:
        return all(abs(3 * seconds - sum(had_s.values())) < SHARE * sum(had_s.values()) for seconds in had_s.values())

    with at_work([frame_of(client) for client in range(3)] + [move]):
        # one that a busy machine kept away is behind, and has its time back later
        until(lambda: sum(had.values()) >= TURNS and shares_are_equal())
    assert len(waited_s) > TURNS / 10
    frame_s = sum(had_s.values()) / sum(had.values())
    assert sorted(waited_s)[len(waited_s) // 2] < 5 * frame_s
