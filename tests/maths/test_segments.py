"""Patches of one surface: paint's edges part them, shading does not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from server.light.shell.segments import LEVEL_EDGE, segments
from tests.scenes.analytic import Floats

SIDE = 12


def wall() -> NDArray[np.int64]:
    """Keys [SIDE^2, 7] of a wall x = 0."""
    place = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij"), -1).reshape(-1, 2)
    return np.column_stack([np.zeros(len(place), int), place, np.ones(len(place), int), np.zeros((len(place), 3), int)])


def looks(level: Floats) -> Floats:
    return np.column_stack([level, np.zeros((len(level), 2))])


def test_a_shaded_wall_is_one_surface() -> None:
    """From 1 to a hundredth across, and by noise."""
    keys = wall()
    level = -np.log(100) * keys[:, 1] / SIDE + np.random.default_rng(1).normal(0, 0.03, len(keys))
    assert not segments(keys, looks(level)).any()


def test_black_paint_is_another_surface() -> None:
    keys = wall()
    stripe = keys[:, 1] // 4
    found = segments(keys, looks(np.where(stripe == 1, -2.0, 0.0)))
    assert len(np.unique(found)) == 3  # what lies on either side of it is two
    for number in range(3):
        assert len(np.unique(found[stripe == number])) == 1


def test_red_paint_is_another_surface() -> None:
    keys = wall()
    seen = looks(np.zeros(len(keys)))
    seen[keys[:, 2] < 5, 1] = 0.8
    assert len(np.unique(segments(keys, seen))) == 2


def test_neither_facings_nor_gaps_nor_grids_are_crossed() -> None:
    keys = wall()
    floor = keys.copy()
    floor[:, 3:6] = 0, 0, 1
    away = keys + np.array([0, SIDE + 1, 0, 0, 0, 0, 0])
    other_grid = keys + np.array([0, 0, 0, 0, 0, 0, 1])
    found = segments(np.concatenate([keys, floor, away, other_grid]), looks(np.zeros(4 * len(keys))))
    assert len(np.unique(found)) == 4


def test_alone_each_is_its_own() -> None:
    keys = 3 * wall()
    np.testing.assert_array_equal(np.sort(segments(keys, looks(np.zeros(len(keys))))), np.arange(len(keys)))


def test_order_does_not_matter() -> None:
    keys, random = wall(), np.random.default_rng(2)
    level = np.where(random.random(len(keys)) < 0.3, 1.2 * LEVEL_EDGE, 0.0)
    turn = random.permutation(len(keys))
    one, other = segments(keys, looks(level)), segments(keys[turn], looks(level[turn]))
    same = one[turn][:, None] == one[turn][None]
    np.testing.assert_array_equal(same, other[:, None] == other[None])
