"""What the client sends over links that it does not know, simulated: rate, delay and computing, without a clock."""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median

import pytest

from client.streaming.adaptive import LADDER, Adaptive, AnsweredFrame
from protocol.limits import MOST_INFLIGHT

FPS = 15
DEPTH_BYTES = 80_000
COLOR_BYTES = (60_000, 43_000, 33_000, 23_000, 13_000, 9_000)
"""About what the kitchen takes, by rung."""
ANSWER_BYTES = 40_000
LARGEST_BYTES = DEPTH_BYTES + COLOR_BYTES[0]


@dataclass
class Link:
    """A link and a server: each way and the server take one frame at a time, in order."""

    bytes_per_s: float
    delay_s: float = 0.02
    computed_s: float = 0.02
    overhead_s: float = 0.0
    turn_s: float = 0.0
    """That others use the device before each frame."""
    says_wait: bool = False
    up_free_s: float = 0.0
    server_free_s: float = 0.0
    down_free_s: float = 0.0
    ages_s: list[float] = field(default_factory=list)
    """Of each answered frame, from its capture."""

    def send(self, sent_s: float, size: int) -> AnsweredFrame:
        arrived_s = max(sent_s, self.up_free_s) + size / self.bytes_per_s
        self.up_free_s = arrived_s
        here_s = arrived_s + self.delay_s
        begun_s = max(here_s, self.server_free_s) + self.turn_s
        done_s = begun_s + self.computed_s + self.overhead_s
        self.server_free_s = done_s
        self.down_free_s = max(done_s, self.down_free_s) + ANSWER_BYTES / self.bytes_per_s
        waited_s = begun_s - here_s if self.says_wait else None
        return AnsweredFrame(sent_s, self.down_free_s + self.delay_s, self.computed_s, size, ANSWER_BYTES, waited_s)


def stream(adaptive: Adaptive, link: Link, seconds: float, start_s: float = 0.0, color: tuple = COLOR_BYTES) -> list:
    """Send for a time; the frames' records. The camera's newest frame is never older than a frame's time."""
    now_s, last_s = start_s, -1e9
    under_way: list[tuple[float, AnsweredFrame]] = []
    done = []
    while now_s < start_s + seconds:
        now_s += 0.001
        while under_way and under_way[0][0] <= now_s:
            _, frame = heapq.heappop(under_way)
            adaptive.note(frame)
            done.append(frame)
            link.ages_s.append(frame.answered_s - frame.sent_s)
        if adaptive.may_send(now_s, last_s, len(under_way)) and now_s - last_s >= 1 / FPS:
            assert len(under_way) < MOST_INFLIGHT
            frame = link.send(now_s, color[adaptive.rung] + DEPTH_BYTES)
            heapq.heappush(under_way, (frame.answered_s, frame))
            last_s = now_s
    return done


def test_a_link_that_carries_all_gets_the_best_at_the_full_rate() -> None:
    adaptive, link = Adaptive(1 / FPS), Link(100e6 / 8)
    done = stream(adaptive, link, 10)
    assert adaptive.rung == 0
    assert len(done) > 0.95 * 10 * FPS


def test_a_slow_link_gets_fewer_bytes_and_nothing_waits() -> None:
    adaptive, link = Adaptive(1 / FPS, delay_s=0.04), Link(12e6 / 8)
    done = stream(adaptive, link, 30)
    assert adaptive.rung > 0
    transfer_s = (done[-1].bytes_up + ANSWER_BYTES) / link.bytes_per_s
    assert median(link.ages_s[-50:]) < 2 * link.delay_s + link.computed_s + 1.3 * transfer_s
    assert max(link.ages_s[-50:]) < 0.35
    full = Link(12e6 / 8)
    held = stream(_Fixed(), full, 30)
    assert len(done) > 1.15 * len(held)


def test_a_slow_server_is_no_reason_to_send_old_pictures() -> None:
    adaptive, link = Adaptive(1 / FPS, delay_s=0.04), Link(2e6 / 8, computed_s=1.0, says_wait=True)
    stream(adaptive, link, 40)
    assert adaptive.rung == len(LADDER) - 1
    quick = Adaptive(1 / FPS, delay_s=0.04)
    stream(quick, Link(10e6 / 8, computed_s=1.0, says_wait=True), 40)
    assert quick.rung == 0


@pytest.mark.parametrize("says_wait", [True, False])
def test_a_device_that_others_use_is_not_taken_for_a_narrow_link(says_wait: bool) -> None:
    adaptive = Adaptive(1 / FPS, delay_s=0.04)
    link = Link(100e6 / 8, turn_s=0.3, says_wait=says_wait)
    for second in range(30):  # alone at times, so that what is least on the way is known
        link.turn_s = 0.0 if second % 6 == 0 else 0.3
        stream(adaptive, link, 1, float(second))
    assert (adaptive.rung == 0) is says_wait


class _Fixed(Adaptive):
    """Sends the best whenever the window has room."""

    def __init__(self) -> None:
        super().__init__(1 / FPS)

    def may_send(self, _now_s: float, _last_sent_s: float, unanswered: int) -> bool:
        return unanswered < 2

    def note(self, _frame: AnsweredFrame) -> None: ...


def test_pacing_keeps_frames_younger_than_the_window_does() -> None:
    paced, filled = Link(6e6 / 8), Link(6e6 / 8)
    adaptive = Adaptive(1 / FPS, delay_s=0.04)
    stream(adaptive, paced, 30)
    stream(_Fixed(), filled, 30)
    assert median(paced.ages_s) < 0.75 * median(filled.ages_s)


def test_a_picture_is_no_worse_than_it_must_be() -> None:
    adaptive, link = Adaptive(1 / FPS, delay_s=0.04), Link(13e6 / 8)
    stream(adaptive, link, 40)
    heaviest = DEPTH_BYTES + COLOR_BYTES[adaptive.rung]
    assert heaviest / link.bytes_per_s < 1.05 / FPS
    assert (heaviest + 25_000) / link.bytes_per_s > 0.8 / FPS


def test_what_the_link_cannot_carry_at_the_full_rate_is_sent_at_its_own() -> None:
    adaptive, link = Adaptive(1 / FPS, delay_s=0.04), Link(2e6 / 8)
    done = stream(adaptive, link, 40)
    assert adaptive.rung == len(LADDER) - 1
    alone_s = (done[-1].bytes_up + ANSWER_BYTES) / link.bytes_per_s + 2 * link.delay_s + link.computed_s
    assert median(link.ages_s[-30:]) < 1.1 * alone_s
    assert len(done) > 0.8 * 40 * link.bytes_per_s / done[-1].bytes_up


def test_a_link_that_eases_is_found_out() -> None:
    adaptive, link = Adaptive(1 / FPS, delay_s=0.04), Link(8e6 / 8)
    stream(adaptive, link, 20)
    low = adaptive.rung
    link.bytes_per_s = 100e6 / 8
    stream(adaptive, link, 30, start_s=20)
    assert low >= 2
    assert adaptive.rung == 0


def test_a_rung_that_is_too_heavy_is_tried_ever_more_rarely() -> None:
    adaptive, link = Adaptive(1 / FPS, delay_s=0.04), Link(3.6e6)
    color = (600_000, 300_000, 150_000, 75_000, 40_000, 20_000)  # far apart: one fits with ease, the next does not
    rungs = []
    for step in range(240):
        stream(adaptive, link, 0.5, start_s=step / 2, color=color)
        rungs.append(adaptive.rung)
    tried = sum(a != b for a, b in pairwise(rungs))
    assert 3 < tried < 40  # one that is never put off tries it more than 200 times
    assert rungs.count(3) > 150


def test_a_slow_server_is_no_reason_for_worse_pictures() -> None:
    adaptive, link = Adaptive(1 / FPS, delay_s=0.04), Link(100e6 / 8, computed_s=0.3)
    done = stream(adaptive, link, 20)
    assert adaptive.rung == 0
    assert len(done) > 0.9 * 20 / 0.3
    assert median(link.ages_s[-20:]) < 0.3 + 0.04 + 0.1 + 0.3 * 0.5


def test_a_wait_that_is_not_told_is_not_taken_for_the_turn_of_others() -> None:
    untold, told = (
        stream(Adaptive(1 / FPS, delay_s=0.04), Link(10e6 / 8, computed_s=0.15, says_wait=says), 40)
        for says in (False, True)
    )
    assert len(untold) > 0.7 * len(told)


def test_frames_do_not_queue_at_a_server_that_takes_longer_than_it_says() -> None:
    adaptive, link = Adaptive(1 / FPS, delay_s=0.04), Link(100e6 / 8, computed_s=0.3)
    link.overhead_s = 0.04  # of decoding and the like, not part of what it tells
    stream(adaptive, link, 30)
    assert median(link.ages_s[-20:]) < 0.34 + 0.04 + 0.02 + 0.1


def test_distance_is_no_reason_for_worse_pictures() -> None:
    adaptive, link = Adaptive(1 / FPS, delay_s=0.2), Link(100e6 / 8, delay_s=0.1)
    done = stream(adaptive, link, 10)
    assert adaptive.rung == 0
    assert len(done) >= 0.95 * 10 * FPS
    assert max(link.ages_s) < 0.2 + link.computed_s + 1.1 * (LARGEST_BYTES + ANSWER_BYTES) / link.bytes_per_s


def test_a_far_device_that_others_use_gets_no_queue_of_frames() -> None:
    adaptive, link = Adaptive(1 / FPS, delay_s=0.2), Link(100e6 / 8, delay_s=0.1, says_wait=True)
    stream(adaptive, link, 10)
    most = adaptive.most_in_flight
    assert most > 2
    link.turn_s = 1.0  # from one frame to the next
    done = stream(adaptive, link, 30, start_s=10)
    assert max(link.ages_s) - 2 * link.delay_s < (most + 0.5) * link.turn_s  # of the window's eight, not of those
    alone_s = 2 * link.delay_s + link.turn_s + link.computed_s
    assert median(link.ages_s[-10:]) < 1.3 * alone_s
    assert len(done) > 0.9 * 30 / (link.turn_s + link.computed_s)


def test_frames_that_wait_at_a_far_server_grown_slower_become_fewer() -> None:
    adaptive, link = Adaptive(1 / FPS, delay_s=0.4), Link(100e6 / 8, delay_s=0.2, says_wait=True)
    stream(adaptive, link, 10)
    link.computed_s = 0.3
    stream(adaptive, link, 10, start_s=10)
    assert max(link.ages_s) > 1.3  # frames that were under way when it began
    assert median(link.ages_s[-10:]) < 2 * link.delay_s + link.computed_s + 0.05


def test_throughput_is_told() -> None:
    adaptive, link = Adaptive(1 / FPS, delay_s=0.04), Link(8e6 / 8)
    assert adaptive.bytes_per_s is None
    stream(adaptive, link, 10)
    assert adaptive.bytes_per_s == pytest.approx(1e6, rel=0.35)


def test_after_a_lost_connection_it_begins_a_rung_lower() -> None:
    adaptive = Adaptive(1 / FPS)
    adaptive.note_reconnection()
    assert adaptive.rung == 1
    for _ in range(20):
        adaptive.note_reconnection()
    assert adaptive.rung == len(LADDER) - 1


def test_the_wish_for_rounded_depth_is_on_every_rung() -> None:
    assert Adaptive(1 / FPS, depth_noise_per_m=0.003).coding.depth_noise_per_m == 0.003
    assert all(rung.depth_noise_per_m is None for rung in LADDER)
