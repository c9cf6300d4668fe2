"""`probeless bench service`: its clocks and counts tell what they are meant to tell."""

from __future__ import annotations

import asyncio
import random
import time
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from server.opencl.device import Device
from server.service.serve import BackgroundServer
from server.service.service import Service
from tests.bench.report.run import Run
from tests.bench.service import replay as service_replay
from tests.bench.service.bytes import Fed, _Kept, feed
from tests.bench.service.faults import Tally, part_of
from tests.bench.service.floods import Held
from tests.bench.service.floods import _round as flood_round
from tests.bench.service.full_disk import Found, begin, disk_full_then_killed
from tests.bench.service.guests import CAMERA, FIRST_PX, FULL_S, LAST_PX, WALL_M, Guest, clock_frame, clock_s
from tests.bench.service.http import bad_request
from tests.bench.service.load import growth, overhead
from tests.bench.service.odd_numbers import Outcome, play_sessions
from tests.bench.service.process import Served, Unusual, serving, stop
from tests.servers import fake_server
from tests.service.fakes import PATIENCE_S, FakePipeline, FakeResult, Lab


@pytest.mark.parametrize("shown_s", [0.0, 3.0, 12.0])
def test_the_wall_is_a_clock(shown_s: float) -> None:
    depth = clock_frame(0, shown_s).depth
    edge_px = int((depth[0] > 0).sum())
    assert edge_px == int(FIRST_PX + (LAST_PX - FIRST_PX) * shown_s / FULL_S)
    x_m = (edge_px - CAMERA.cx) / CAMERA.fx * WALL_M
    mesh = trimesh.Trimesh([[-1, 0, 2], [x_m, 0, 2], [-1, 1, 2]], [[0, 1, 2]], process=False)
    assert clock_s(mesh.export(file_type="ply")) == pytest.approx(shown_s, abs=0.15)


def test_what_a_room_has_fused_is_read_over_the_socket(device: Device) -> None:
    async def stream(url: str) -> tuple[float, float]:
        guest = await Guest(url, "clock").begin()
        assert await guest.goes_on(60.0, 8)
        guest.is_paused = True
        shown_s, fused_s = guest.shown_s, await guest.fused_until_s()
        await guest.place("there")
        assert await guest.lost_objects({"there": True, "gone": True, "never": False}) == ["gone"]
        await guest.leave()
        return shown_s, fused_s

    with BackgroundServer(Service(device)) as server:
        shown_s, fused_s = asyncio.run(stream(server.url))
    assert fused_s == pytest.approx(shown_s, abs=0.6)


def test_a_session_is_replayed_down_to_the_last_bit_of_its_lights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: Device
) -> None:
    """Each by a server of its own, which compiles only the kernels that the session needs."""
    monkeypatch.setattr(service_replay, "RUNS", 1)
    monkeypatch.setattr(service_replay, "serving", partial(serving, unusual=Unusual(warms_up=False)))
    part = service_replay.replay_part(Run(device, True, lambda _text: None), tmp_path)
    assert {row.name: row.value for row in part.rows} == {
        "replays whose composites and lights have the recording's SHA-256, of 1": 1,
        "frames of the recording": service_replay.QUICK_FRAMES,
    }


def test_a_full_disk_and_a_kill_take_nothing_that_was_acknowledged_without_an_error(tmp_path: Path) -> None:
    found = Found()
    served = begin(tmp_path / "log", str(tmp_path / "rooms"), warms_up=False)  # no frame is sent
    try:
        served = disk_full_then_killed(served, "study", random.Random(1), found)
    finally:
        stop(served)
    assert found.missing == []
    assert found.kept >= 5
    assert found.unsaved >= 1


def test_a_server_answers_or_refuses_sessions_of_odd_numbers(device: Device) -> None:
    outcome = Outcome()
    with BackgroundServer(Service(device)) as server:
        play_sessions(server.url, 200, outcome)
    assert outcome.failed == []
    assert outcome.frames >= 200
    assert outcome.answers["composite"] >= 40
    assert outcome.answers["dropped"] >= 10
    assert all(outcome.reasons)


def test_odd_numbers_that_end_the_server_or_a_session_are_found(lab_of_failures: str) -> None:
    outcome = Outcome()
    play_sessions(lab_of_failures, 60, outcome)
    assert any(line.startswith("1011") for line in outcome.failed)
    with pytest.raises(OSError, match="refused"):
        play_sessions("http://127.0.0.1:9", 60, outcome)  # the port of "discard": nobody listens
    assert outcome.failed[-1].startswith("the server is gone")


@pytest.fixture
def lab_of_failures() -> Iterator[str]:
    """URL of a server whose pipelines fail in every frame."""

    class Failing(FakePipeline):
        def process(self, *_: object, **__: object) -> FakeResult:
            raise RuntimeError("secret internals")

    with fake_server(lambda *_: Failing(Lab())) as server:
        yield server.url


def samples(counts: dict[str, float]) -> dict[tuple[str, ...], float]:
    return {("probeless_overhead_seconds_bucket", bound): count for bound, count in counts.items()}


def test_percentiles_are_of_what_came_between() -> None:
    before = samples({"0.001": 5, "0.005": 5, "0.01": 5, "+Inf": 5})
    after = samples({"0.001": 55, "0.005": 95, "0.01": 105, "+Inf": 105})
    under, p99 = overhead(before, after, "overhead_seconds")
    assert under == pytest.approx(0.9)
    assert 9.4 < p99 < 9.6
    assert np.isnan(overhead(after, after, "overhead_seconds")[1])


def test_growth_is_of_the_halves() -> None:
    assert growth([100.0] * 10) == 0
    assert growth([100.0] * 5 + [110.0] * 5) == pytest.approx(10.0)


def test_a_hang_and_an_end_without_a_word_do_not_hold() -> None:
    good = Tally(trials=3, outcomes=Counter({"went on": 2, "told: the server is full": 1}))
    assert all(row.holds for row in part_of("cut", good).rows if row.goal)
    for bad in ("hung", "told: "):
        tally = Tally(trials=1, outcomes=Counter({bad: 1}))
        assert [row.holds for row in part_of("cut", tally).rows if "without a word" in row.name] == [False]
    late = Tally(trials=1, outcomes=Counter({"went on": 1}), lost_fusion_s=[6.0], lost_objects=["a"])
    assert [row.holds for row in part_of("killed", late).rows if row.goal] == [True, True, False, False]


def test_chunks_of_mutations_are_kept(tmp_path: Path) -> None:
    fed = feed(0, 200)
    assert (fed.messages, fed.broken, fed.unnamed) == (200, [], [])
    assert fed.refused > 100
    kept = _Kept(tmp_path / "bytes.jsonl")
    assert kept.find(0) is None
    kept.keep(0, fed)
    assert kept.find(0) == fed
    assert kept.find(200) is None
    both = Fed()
    both.add(fed)
    both.add(fed)
    assert both.messages == 400


def test_floods_leave_no_session_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the round itself; what a real server keeps is the benchmark's question."""
    monkeypatch.setattr("tests.bench.service.floods.FLOODS", 1)
    rooms = {"room_factory": lambda _wishes, name: SimpleNamespace(name=name, key_digest=None, close=lambda: None)}
    with fake_server(Lab().build, **rooms) as server:
        flood_round(Served(None, server.url, Path("no log"), ()), 3, 4, 3)  # type: ignore[arg-type]
        end_s = time.monotonic() + PATIENCE_S
        while server.service.sessions and time.monotonic() < end_s:
            time.sleep(0.01)
        assert server.service.sessions == 0
        dropped = server.service.metrics.dropped.labels("replaced")._value.get()
    assert dropped > 0  # of those that never read, which do not keep to the window


def test_growth_is_told_by_kind() -> None:
    before = Held(100.0, 20, 8, 1.0)
    assert Held(120.0, 22, 12, 1.0).growth_from(before) == {
        "memory_mb": pytest.approx(20.0), "files": 0.0, "threads": pytest.approx(25.0), "disk_kb": 0.0
    }  # fmt: skip


def test_bad_requests_are_the_same_for_the_same_seed() -> None:
    first, again = ([bad_request(random.Random(seed)) for seed in range(50)] for _ in range(2))
    assert first == again
    assert len(set(first)) == 50
