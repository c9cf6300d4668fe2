"""Sessions share a device by its time: equal ones alike, heavy ones at their own cost, rooms one frame at a time."""

from __future__ import annotations

import threading
from collections import Counter

import pytest

from protocol.messages import Wishes
from server.service.load_shedding import FRAMES_BEFORE_CHEAPER, FRAMES_BEFORE_FINER, LoadShedding, SamplingRequest
from server.service.scheduler import AWAY_S, CREDIT_S, Scheduler, SessionShare


class Clock:
    """A device whose time is what frames are said to take."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class Device:
    """Sessions that always have a frame, served as the scheduler says; no threads, so nothing depends on their luck."""

    def __init__(
        self, costs: dict[str, float], rooms: dict[str, str] | None = None, concurrent_frames: int = 1
    ) -> None:
        self.clock = Clock()
        self.scheduler = Scheduler(concurrent_frames, self.clock)
        self.costs = costs
        self.shares = {name: self.scheduler.join((rooms or {}).get(name)) for name in costs}
        self.frames: Counter[str] = Counter()

    def serve(self, seconds: float, present: set[str] | None = None) -> None:
        names = {id(share): name for name, share in self.shares.items()}
        end = self.clock.now + seconds
        waiting = [self.shares[name] for name in self.costs if present is None or name in present]
        while self.clock.now < end:
            for share in waiting:
                if share not in self.scheduler._waiting:
                    least = self.scheduler._least_used_s(share, share.used_s)
                    share.used_s = max(share.used_s, least - CREDIT_S)
                    self.scheduler._waiting.append(share)
            chosen = self.scheduler._next()
            assert chosen is not None
            self.scheduler._waiting.remove(chosen)
            self.clock.now += self.costs[names[id(chosen)]]
            self.scheduler._charge(chosen, self.costs[names[id(chosen)]])
            self.scheduler._note_frame(chosen, self.costs[names[id(chosen)]])
            self.frames[names[id(chosen)]] += 1
        self.scheduler._waiting.clear()


def test_equal_sessions_get_equal_shares() -> None:
    device = Device({f"s{i}": 0.1 for i in range(8)})
    device.serve(80.0)
    assert max(device.frames.values()) - min(device.frames.values()) <= 1


def test_a_heavy_session_slows_only_itself() -> None:
    device = Device({"light": 0.05, "heavy": 0.5})
    device.serve(60.0)
    assert device.frames["light"] * 0.05 == pytest.approx(device.frames["heavy"] * 0.5, abs=1.0)


def test_absence_is_not_saved_up() -> None:
    device = Device({"a": 0.1, "b": 0.1})
    device.serve(20.0, {"a"})
    device.frames.clear()
    device.serve(20.0)
    assert device.frames["b"] - device.frames["a"] <= CREDIT_S / 0.1 + 1


def test_a_newcomer_does_not_push_the_others_aside() -> None:
    device = Device({"a": 0.1, "b": 0.1})
    device.serve(30.0)
    device.costs["c"] = 0.1
    device.shares["c"] = device.scheduler.join()
    device.frames.clear()
    device.serve(30.0)
    assert max(device.frames.values()) - min(device.frames.values()) <= 2


def test_the_period_foretells_what_sessions_get() -> None:
    device = Device({"a": 0.1, "b": 0.2, "c": 0.3})
    device.serve(20.0)
    assert device.scheduler.busy == 3
    assert device.scheduler.period_s() == pytest.approx(0.6)
    assert device.scheduler.period_s(newcomers=1) == pytest.approx(0.8)
    device.clock.now += AWAY_S + 1
    assert device.scheduler.busy == 0
    assert device.scheduler.period_s() == 0.0


def test_first_frames_in_which_kernels_are_loaded_foretell_nothing() -> None:
    device = Device({"a": 2.0, "b": 2.0})
    device.serve(4.0)
    assert device.scheduler.period_s(newcomers=1) == 0.0
    device.costs |= {"a": 0.1, "b": 0.1}
    device.serve(0.2)
    assert device.scheduler.period_s() == pytest.approx(0.2)
    device.costs |= {"a": 0.2, "b": 0.2}
    device.serve(0.4)
    assert device.scheduler.period_s() == pytest.approx(0.24)


def run_in_threads(scheduler: Scheduler, shares: list[SessionShare], turns: int) -> tuple[int, int]:
    """The most frames at once, in all and of one room."""
    working: list[SessionShare] = []
    most, most_of_room = 0, 0
    lock = threading.Lock()

    def work(share: SessionShare) -> None:
        nonlocal most, most_of_room
        for _ in range(turns):
            with scheduler.acquire(share) as turn:
                assert turn.waited_s >= 0
                with lock:
                    working.append(share)
                    most = max(most, len(working))
                    most_of_room = max(most_of_room, *Counter(s.room for s in working).values())
                threading.Event().wait(0.0005)
                with lock:
                    working.remove(share)

    threads = [threading.Thread(target=work, args=(share,)) for share in shares]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=20)
        assert not thread.is_alive()
    return most, most_of_room


def test_one_frame_at_a_time() -> None:
    scheduler = Scheduler()
    assert run_in_threads(scheduler, [scheduler.join() for _ in range(4)], 25) == (1, 1)


def test_frames_of_one_room_never_meet_while_others_do() -> None:
    scheduler = Scheduler(concurrent_frames=2)
    shares = [scheduler.join(room) for room in ("a", "a", "a", "b", "b", "c")]
    most, most_of_room = run_in_threads(scheduler, shares, 25)
    assert most == 2
    assert most_of_room == 1


def test_a_frame_that_fails_gives_the_device_back() -> None:
    scheduler = Scheduler()
    share = scheduler.join()
    with pytest.raises(RuntimeError), scheduler.acquire(share):
        raise RuntimeError("a kernel")
    with scheduler.acquire(share):
        pass
    scheduler.leave(share)


def observe(shedding: LoadShedding, frames: int, sharing: int, period_s: float) -> list[str]:
    return [shedding.granted.preset for _ in range(frames) if shedding.observe(sharing, lambda: period_s)]


def test_quality_steps_down_under_load_and_back_when_it_eases() -> None:
    shedding = LoadShedding(Wishes(preset="rm"), 0.25)
    assert observe(shedding, 3 * FRAMES_BEFORE_CHEAPER, 8, 1.0) == ["art1", "reg4", "gr15fast"]
    assert observe(shedding, 40, 8, 1.0) == []  # there is nothing cheaper
    assert observe(shedding, FRAMES_BEFORE_FINER, 8, 0.2) == []  # neither too much, nor room for more
    assert observe(shedding, 2 * FRAMES_BEFORE_FINER, 2, 0.05) == ["reg4", "art1"]
    assert observe(shedding, FRAMES_BEFORE_FINER, 1, 0.05) == ["rm"]


def test_alone_a_session_gets_what_it_asked_for() -> None:
    assert observe(LoadShedding(Wishes(preset="rm"), 0.25), 100, 1, 3.0) == []


def test_lossless_sessions_are_left_alone() -> None:
    assert observe(LoadShedding(Wishes(preset="rm", lossless=True), 0.25), 100, 8, 3.0) == []


def test_what_is_asked_for_later_counts_from_then_on() -> None:
    shedding = LoadShedding(Wishes(preset="rm"), 0.25)
    observe(shedding, FRAMES_BEFORE_CHEAPER, 8, 1.0)
    shedding.request(SamplingRequest("reg4", None, None))
    assert shedding.granted.preset == "reg4"
    assert observe(shedding, FRAMES_BEFORE_CHEAPER, 8, 1.0) == ["gr15fast"]


def test_budgets_shrink_instead_of_presets() -> None:
    shedding = LoadShedding(Wishes(preset="auto", budget_ms=300.0), 0.25)
    observe(shedding, FRAMES_BEFORE_CHEAPER, 8, 1.0)
    assert shedding.granted == SamplingRequest("auto", pytest.approx(180.0), None)


TAKES_S = {"rm": 40.0, "art1": 9.0, "reg4": 0.8}


def test_a_preset_whose_frames_take_seconds_is_not_begun_while_others_are_there() -> None:
    shedding = LoadShedding(Wishes(preset="rm"), 0.25)
    assert not shedding.limit(1, lambda preset: TAKES_S[preset])
    assert shedding.granted.preset == "rm"
    assert shedding.limit(2, lambda preset: TAKES_S[preset])
    assert shedding.granted.preset == "reg4"
    assert not shedding.limit(2, lambda preset: TAKES_S[preset])


def test_lossless_sessions_begin_what_they_asked_for() -> None:
    assert not LoadShedding(Wishes(preset="rm", lossless=True), 0.25).limit(8, lambda _preset: 40.0)
