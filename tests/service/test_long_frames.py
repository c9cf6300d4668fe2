"""A frame that takes long: other clients go first in between, and nobody works for a client that has left."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from protocol.messages import Composite, Hello, Welcome
from server.service.scheduler import (
    LEAST_QUANTUM_S,
    NEXT_QUANTUM_S,
    QUANTUM_S,
    REQUEST_QUANTUM_S,
    Scheduler,
    SessionShare,
    Turn,
)
from server.service.serve import BackgroundServer
from tests.service.fakes import CAMERA, PATIENCE_S, Lab, frame_message
from tests.service.wire import Wire


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def scheduler(clock: Clock) -> Scheduler:
    return Scheduler(clock=clock)


def until(holds: Callable[[], object]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < end_s
        time.sleep(0.002)


class Frame:
    """A frame of another session, in a thread; it ends when it is told to."""

    def __init__(self, scheduler: Scheduler, share: SessionShare, name: str, order: list[str]) -> None:
        self._scheduler, self._share, self._name, self._order = scheduler, share, name, order
        self._end = threading.Event()
        self.thread = threading.Thread(target=self._run)
        self.thread.start()
        until(lambda: share in scheduler._waiting or share in scheduler._working)

    def _run(self) -> None:
        with self._scheduler.acquire(self._share):
            self._order.append(self._name)
            assert self._end.wait(PATIENCE_S)

    def end(self) -> None:
        self._end.set()
        self.thread.join(PATIENCE_S)


@pytest.fixture
def long_turn(scheduler: Scheduler, clock: Clock) -> Iterator[Turn]:
    """Of a frame in the room "study" that has had its quantum."""
    with scheduler.acquire(scheduler.join("study")) as turn:
        clock.now_s += QUANTUM_S
        yield turn


def test_a_frame_that_is_alone_is_not_interrupted(long_turn: Turn) -> None:
    assert not long_turn.is_due()


def test_a_usual_frame_is_not_interrupted(scheduler: Scheduler, clock: Clock) -> None:
    with scheduler.acquire(scheduler.join()) as turn:
        other = Frame(scheduler, scheduler.join(), "other", [])
        clock.now_s += 0.9 * QUANTUM_S
        assert not turn.is_due()
        clock.now_s += 0.2 * QUANTUM_S
        assert turn.is_due()
    other.end()


def test_a_frame_that_takes_longer_than_those_of_another_session_lets_it_go_first(
    scheduler: Scheduler, clock: Clock
) -> None:
    short, equal = scheduler.join(), scheduler.join()
    short.cost_s, equal.cost_s = 0.03, 0.1
    with scheduler.acquire(scheduler.join()) as turn:
        others = [Frame(scheduler, equal, "equal", [])]
        clock.now_s += 0.11
        assert not turn.is_due(), "of a session whose frames take as long"
        others.append(Frame(scheduler, short, "short", []))
        assert turn.is_due()
        short.used_s = 10.0
        assert not turn.is_due(), "it has used more"
    for other in others:
        threading.Timer(0.01, other.end).start()


def test_no_frame_is_interrupted_before_its_device_is_well_in_use(scheduler: Scheduler, clock: Clock) -> None:
    tiny = scheduler.join()
    tiny.cost_s = 0.001
    with scheduler.acquire(scheduler.join()) as turn:
        other = Frame(scheduler, tiny, "tiny", [])
        clock.now_s += 0.9 * LEAST_QUANTUM_S
        assert not turn.is_due()
        clock.now_s += 0.2 * LEAST_QUANTUM_S
        assert turn.is_due()
    other.end()


def test_a_long_frame_lets_others_go_first(scheduler: Scheduler, long_turn: Turn) -> None:
    order: list[str] = []
    other = Frame(scheduler, scheduler.join(), "other", order)
    assert long_turn.is_due()
    threading.Timer(0.05, other.end).start()  # while this frame is interrupted
    long_turn.give_way()
    assert order == ["other"]
    assert not long_turn.is_due()
    assert long_turn.spent_s == QUANTUM_S


def test_once_interrupted_it_lets_others_go_first_sooner(scheduler: Scheduler, clock: Clock, long_turn: Turn) -> None:
    for _ in range(3):
        other = Frame(scheduler, scheduler.join(), "other", [])
        threading.Timer(0.05, other.end).start()
        long_turn.give_way()
        later = Frame(scheduler, scheduler.join(), "later", [])
        clock.now_s += 0.9 * NEXT_QUANTUM_S
        assert not long_turn.is_due()
        clock.now_s += 0.2 * NEXT_QUANTUM_S
        assert long_turn.is_due()
        threading.Timer(0.05, later.end).start()
        long_turn.give_way()


def test_a_request_lets_frames_go_first_at_once(scheduler: Scheduler, clock: Clock) -> None:
    with scheduler.acquire(scheduler.join(), REQUEST_QUANTUM_S) as turn:
        other = Frame(scheduler, scheduler.join(), "other", [])
        assert not turn.is_due()
        clock.now_s += 1.1 * REQUEST_QUANTUM_S
        assert turn.is_due()
        threading.Timer(0.05, other.end).start()
        turn.give_way()
        assert turn.quantum_s == REQUEST_QUANTUM_S


def test_it_goes_on_before_those_that_have_used_more(scheduler: Scheduler, clock: Clock, long_turn: Turn) -> None:
    greedy = scheduler.join()
    greedy.used_s = 100.0
    other = Frame(scheduler, greedy, "other", [])
    clock.now_s += 50.0
    assert not long_turn.is_due()
    clock.now_s += 51.0
    assert long_turn.is_due()
    threading.Timer(0.05, other.end).start()
    long_turn.give_way()


def test_nobody_enters_the_room_of_an_interrupted_frame(scheduler: Scheduler, clock: Clock) -> None:
    order: list[str] = []
    with scheduler.acquire(scheduler.join("study")) as turn:
        same = Frame(scheduler, scheduler.join("study"), "same room", order)
        clock.now_s += QUANTUM_S
        assert not turn.is_due(), "it would wait for a room that nobody leaves"
        other = Frame(scheduler, scheduler.join("attic"), "other room", order)
        assert turn.is_due()
        threading.Timer(0.05, other.end).start()
        turn.give_way()
        order.append("goes on")
    same.end()
    assert order == ["other room", "goes on", "same room"]


def test_what_happens_while_it_is_released_is_not_its_time(scheduler: Scheduler, clock: Clock) -> None:
    share = scheduler.join("study")
    with scheduler.acquire(share) as turn:
        clock.now_s += 1.0
        with turn.released():
            other = Frame(scheduler, scheduler.join(), "other", order := [])
            until(lambda: order)
            clock.now_s += 50.0
            other.end()
        clock.now_s += 1.0
    assert share.used_s == 2.0


def test_all_its_time_is_charged(scheduler: Scheduler, clock: Clock) -> None:
    share, others = scheduler.join(), scheduler.join()
    for _ in range(2):  # the first frame of a session tells nothing of its costs
        with scheduler.acquire(share) as turn:
            clock.now_s += 3.0
            other = Frame(scheduler, others, "other", [])
            assert turn.is_due()
            threading.Timer(0.05, other.end).start()
            turn.give_way()
            clock.now_s += 4.0
    assert share.cost_s == 7.0
    assert share.used_s == pytest.approx(14.0, abs=0.6)


def begin(server: BackgroundServer, lab: Lab, index: int, **said: object) -> Wire:
    """A client whose frame is being worked on."""
    wire = Wire(server.url)
    wire.say(Hello(client="test", camera=CAMERA, **said))
    assert isinstance(wire.hear(), Welcome)
    wire.say(frame_message(index))
    assert lab.next_entered() == index
    return wire


def test_another_client_is_answered_while_a_long_frame_is_worked_on(server: BackgroundServer, lab: Lab) -> None:
    lab.hold = lab.slices = True
    slow = begin(server, lab, 1000)
    lab.hold = False
    quick = Wire(server.url)
    quick.greet()
    for index in range(3):
        quick.say(frame_message(index))
        assert quick.hear_until(Composite)[-1].frame == index
    lab.release()
    assert slow.hear_until(Composite)[-1].frame == 1000
    for wire in (slow, quick):
        wire.hang_up()


def test_sampling_that_takes_long_is_granted_to_those_who_are_alone(server: BackgroundServer, lab: Lab) -> None:
    lab.predicted_s = {"art8": 200.0}
    wire = Wire(server.url)
    wire.greet(preset="art8")
    wire.say(frame_message(0))
    wire.hear_until(Composite)
    assert ("preset", "gr15fast", None, None) not in lab.log
    other = Wire(server.url)
    other.greet()
    other.say(frame_message(1))
    other.hear_until(Composite)
    wire.say(frame_message(2))
    wire.hear_until(Composite)
    assert lab.log.index(("preset", "gr15fast", None, None)) < lab.log.index(("frame", 2))
    for one in (wire, other):
        one.hang_up()


def test_a_frame_is_given_up_when_its_client_has_left(server: BackgroundServer, lab: Lab) -> None:
    lab.hold = lab.slices = True
    begin(server, lab, 0).hang_up()
    assert lab.closed.wait(PATIENCE_S)  # nobody has released it
    until(lambda: server.service.sessions == 0)


def test_a_frame_is_worked_on_while_its_client_may_come_back(server: BackgroundServer, lab: Lab) -> None:
    lab.hold = lab.slices = True
    wire = begin(server, lab, 0, keep_s=PATIENCE_S)
    wire.socket.socket.shutdown(socket.SHUT_RDWR)  # a connection that is lost, not closed
    until(lambda: server.service._resumable_sessions and not lab.closed.wait(0.3))
    lab.release()
