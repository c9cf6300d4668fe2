"""How many places are asked for."""

import math
import os

import numpy as np
import pytest

from server.cluster.capacity import Capacity, Policy, places_needed
from server.cluster.node_warm_up import warm_up_node
from server.cluster.settings import read_settings
from tests.service.fakes import FAKE_DEVICE


def test_spare_places_are_a_number_or_a_share_whichever_is_more() -> None:
    policy = Policy(spare=2, spare_share=0.1, most=1000)
    assert [places_needed(policy, rooms, 0.0) for rooms in (0, 1, 20, 50)] == [2, 3, 22, 55]


def test_old_frames_add_places_up_to_a_limit() -> None:
    policy = Policy(spare=0, spare_share=0, queue_age_s=0.2, most_relief=1.5, most=1000)
    ages = (0.0, 0.2, 0.25, 0.3, 9.0)
    assert [places_needed(policy, 40, age) for age in ages] == [40, 40, 50, 60, 60]


def test_places_never_exceed_the_most() -> None:
    assert places_needed(Policy(most=7), 100, 9.0) == 7


def test_up_at_once_and_down_when_it_has_not_been_wanted_for_long() -> None:
    capacity = Capacity(Policy(spare=0, spare_share=0, shrink_after_s=100))
    assert capacity.wanted(0, 3, 0) == 3
    assert capacity.wanted(10, 9, 0) == 9
    assert capacity.wanted(20, 5, 0) == 9
    assert capacity.wanted(110, 2, 0) == 9
    assert capacity.wanted(111, 2, 0) == 5  # wanted 91 s ago
    assert capacity.wanted(121, 2, 0) == 2
    assert capacity.wanted(122, 6, 0) == 6


def test_it_is_the_greatest_need_of_the_time_before() -> None:
    capacity = Capacity(Policy(spare=0, spare_share=0, shrink_after_s=3))
    needs = np.random.default_rng(1).integers(0, 6, 400).tolist()
    for now, need in enumerate(needs):
        assert capacity.wanted(now, need, 0.0) == min(64, max(needs[max(0, now - 3) : now + 1]))


@pytest.mark.parametrize(
    ("args", "named"),
    [
        ({}, "data"),
        ({"data": "/rooms", "polcy": {}}, "polcy"),
        ({"data": "/rooms", "policy": {"spare": -1}}, "spare"),
        ({"data": "/rooms", "place": {"room": 0}}, "place"),
    ],
)
def test_wrong_setting_is_named(args, named) -> None:
    with pytest.raises(ValueError, match=named):
        read_settings(args)


def test_node_is_warmed_up_once_and_again_where_that_failed(tmp_path) -> None:
    warmed = []

    def fail(_device: object) -> None:
        raise RuntimeError("wrong answer")

    with pytest.raises(RuntimeError):
        warm_up_node(FAKE_DEVICE, fail, tmp_path)
    assert warm_up_node(FAKE_DEVICE, warmed.append, tmp_path)
    assert not warm_up_node(FAKE_DEVICE, warmed.append, tmp_path)
    assert warmed == [FAKE_DEVICE]
    stamp = next(tmp_path.iterdir())
    os.utime(stamp, (0, math.floor(stamp.stat().st_mtime) - 4000))
    assert warm_up_node(FAKE_DEVICE, warmed.append, tmp_path)
