"""The day that is played: it adds up, and settings do what they are for."""

import math

import numpy as np
import pytest

from server.cluster.capacity import Policy
from tests.bench.cluster.simulation import DAY_S, HOURS, TICK_S, Day, Fleet, Load, arrivals, simulate

LOAD, FLEET = Load(busiest_per_hour=60.0), Fleet()


@pytest.fixture(scope="module")
def usual() -> Day:
    return simulate(Policy(), LOAD, FLEET)


def test_rooms_arrive_as_often_as_the_hours_say() -> None:
    came = np.array([when for when, _, _ in arrivals(LOAD)])
    expected = LOAD.busiest_per_hour * sum(HOURS) / max(HOURS)
    assert len(came) == pytest.approx(expected, abs=5 * math.sqrt(expected))  # Poisson: five standard deviations
    assert (np.diff(came) > 0).all()
    assert came[-1] < DAY_S
    evening = ((came >= 19 * 3600) & (came < 21 * 3600)).sum()
    assert evening == pytest.approx(LOAD.busiest_per_hour * (88 + 100) / 100, abs=5 * math.sqrt(113))


def test_open_rooms_follow_littles_law(usual) -> None:
    let_in = len(usual.waited_s)
    rooms = usual.open_rooms.mean()
    assert rooms == pytest.approx(let_in * LOAD.stay_s / DAY_S, rel=0.15)


def test_everybody_is_let_in_or_refused_or_there_still_at_the_end(usual) -> None:
    assert 0 <= usual.rooms - len(usual.waited_s) - usual.refused <= 3
    assert (usual.open_rooms <= usual.places).all()
    assert all(0 <= wait <= FLEET.patience_s + TICK_S for wait in usual.waited_s)


def test_node_hours_are_those_of_the_places(usual) -> None:
    ready = usual.places.sum() / FLEET.places * TICK_S / 3600
    assert ready <= usual.node_hours <= 1.2 * ready


def test_more_spare_places_refuse_fewer_and_cost_more() -> None:
    none, some, many = (
        simulate(Policy(spare=spare, spare_share=0, shrink_after_s=120), LOAD, FLEET) for spare in (0, 3, 12)
    )
    assert none.refused_share > some.refused_share >= many.refused_share
    assert none.node_hours < some.node_hours < many.node_hours
    assert many.refused == 0


def test_most_is_never_exceeded() -> None:
    day = simulate(Policy(most=8), LOAD, FLEET)
    assert day.places.max() == 8
    assert day.refused_share > 0.05


def test_heavier_rooms_age_their_frames_and_relief_helps() -> None:
    heavy = Load(busiest_per_hour=60.0, share=0.8)
    without, with_relief = (
        simulate(Policy(most_relief=relief, queue_age_s=0.15), heavy, FLEET) for relief in (1.0, 2.0)
    )
    assert without.aged_share > with_relief.aged_share
    assert with_relief.node_hours > without.node_hours
    assert simulate(Policy(), Load(busiest_per_hour=60.0, share=0.01), FLEET).aged_share == 0


def test_cost_is_the_price_of_the_hours(usual) -> None:
    sessions = 2.5 * (usual.rooms - usual.refused)
    assert usual.cost_per_thousand(0.4, 2.5) == pytest.approx(1000 * 0.4 * usual.node_hours / sessions)


def test_the_same_day_comes_out_the_same(usual) -> None:
    again = simulate(Policy(), LOAD, FLEET)
    assert (again.node_hours, again.waited_s) == (usual.node_hours, usual.waited_s)
