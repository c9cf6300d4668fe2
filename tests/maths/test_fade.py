"""The light that is told comes to the one that is solved by small steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from server.light.shell.bright_surface import BrightSurface
from server.light.shell.fade import MOST_CHANGE, Fade, Told
from server.light.shell.shell import CELLS, SIDE, Shell
from server.light.shell.solution import Solution
from server.light.shell.solved import Solved
from server.light.shell.transport import lamp_keys
from server.maths.sh import LUMINANCE
from tests.scenes.analytic import Floats

ROOM = Shell(np.eye(3), np.zeros(3), np.array([4.0, 3.6, 2.4]), 0.0, np.zeros((2, 3)))
PLACE = np.array([1.7, 1.9, 0.6])
CEILING = 5 * SIDE * SIDE
HIDDEN = {75: CELLS, 99: CELLS + 1}
"""Keys of two pieces of hidden surface, and their columns."""


def solved(lamp: int, shell: Shell = ROOM, hidden: dict[int, int] = HIDDEN) -> Solution:
    """A dim room with a lamp in one cell of its ceiling."""
    sent = np.full((CELLS + len(hidden), 3), [0.3, 0.3, 0.25])
    sent[CEILING + lamp] = 60.0
    near = Solved(sent, np.eye(len(sent), dtype=np.float32), 1.0, 0.0, 0.0)
    rows = np.zeros(0, np.int64)
    return Solution(shell, hidden, BrightSurface().seen_by().emitters, near, near, rows, np.zeros((0, 3)))


def light_of(solution: Solution) -> Floats:
    return np.asarray(solution.beyond_at(PLACE) @ LUMINANCE)


def change(before: Solution, after: Solution) -> float:
    one, two = light_of(before), light_of(after)
    return float(np.linalg.norm(two - one) / np.linalg.norm(one))


def next_told(before: Solution | None, solution: Solution, new: float = 0.0) -> Solution:
    return Fade(Told.by(before), new).told(solution, PLACE)


def test_a_first_light_is_told_as_it_is() -> None:
    first = solved(24)
    assert next_told(None, first) is first


def test_a_lamp_passes_to_the_next_cell_by_small_steps() -> None:
    told, goal = solved(24), solved(26)
    steps, behind = [], []
    while told is not goal:
        following = next_told(told, goal)
        steps.append(change(told, following))
        behind.append(following.behind)
        told = following
        assert len(steps) < 100
    assert max(steps) <= MOST_CHANGE * (1 + 1e-9)
    assert behind[-1] == 0.0
    assert (np.diff(behind) < 0).all(), "it comes nearer with each"
    assert change(solved(24), goal) > 5 * MOST_CHANGE, "seen: .35"


def test_what_it_is_behind_is_what_it_differs_by() -> None:
    told, goal = solved(24), solved(26)
    told = next_told(told, goal)
    difference = float(np.linalg.norm(light_of(goal) - light_of(told)) / np.linalg.norm(light_of(solved(24))))
    assert told.behind == pytest.approx(difference, rel=1e-6)


@pytest.mark.parametrize("new", [0.05, 0.09])
def test_young_light_follows_faster(new: float) -> None:
    before = solved(24)
    assert change(before, next_told(before, solved(26), new)) == pytest.approx(new)


def test_hidden_surface_is_told_by_what_it_is() -> None:
    """And not by its column, which another one may have."""
    before, goal = solved(24), solved(26, hidden={99: CELLS, 54: CELLS + 1})
    before.near.radiance[CELLS:] = [[5.0] * 3, [9.0] * 3]
    told = next_told(before, goal)
    share = MOST_CHANGE / change(before, goal)
    np.testing.assert_allclose(told.near.radiance[CELLS], 9.0 + share * (goal.near.radiance[CELLS] - 9.0))
    np.testing.assert_array_equal(told.near.radiance[CELLS + 1], goal.near.radiance[CELLS + 1])


def test_a_wall_that_is_found_elsewhere_does_not_move_what_is_seen() -> None:
    """The room is found to be half a metre longer, with the same light from each direction."""
    before, goal = solved(24), solved(26, shell=replace(ROOM, high=ROOM.high + np.array([0.5, 0.0, 0.0])))
    told = next_told(before, goal)
    by_cell = replace(goal, near=replace(goal.near, radiance=before.near.radiance))
    assert change(before, told) < 0.13  # seen: .11, of which the step is .03
    assert change(before, by_cell) > 0.2, "seen: .22, with what each cell had told"


def test_a_place_in_the_middle_of_a_cell() -> None:
    """Has no direction to it."""
    goal = solved(26, shell=replace(ROOM, high=ROOM.high - np.array([0.0, 0.0, 0.5])))
    told = Fade(Told.by(solved(24)), 0.0).told(goal, goal.shell.centers[CEILING + 5])
    assert np.isfinite(told.near.radiance).all()
    assert np.isfinite(told.behind)


def test_what_is_asked_of_it_is_of_what_it_tells() -> None:
    """Nothing that was found of the solution before is left in it."""
    goal = solved(26)
    goal.beyond(PLACE[None], 4)
    told = next_told(solved(24), goal)
    whole, _, _ = told.beyond(PLACE[None], 4)
    np.testing.assert_allclose(whole[0] @ LUMINANCE, light_of(told))


def test_a_lamp_that_no_picture_has_shown_comes_on_with_the_rest() -> None:
    """Not at once, beside the light of the shell that it takes the place of."""
    lamp = int(lamp_keys([0])[0])
    before, goal = solved(24), solved(26, hidden={**HIDDEN, lamp: CELLS + len(HIDDEN)})
    told = next_told(before, goal).near.radiance
    first, last = before.near.radiance[CEILING + 26, 0], goal.near.radiance[CEILING + 26, 0]
    share = (told[CEILING + 26, 0] - first) / (last - first)
    assert 0 < share < 0.5
    np.testing.assert_allclose(told[-1], share * goal.near.radiance[-1])
