"""When many share a device: each samples more cheaply before frames are dropped, and more finely again when it eases.

Alone, a session gets what it asked for. Steps are taken by the time from one of its frames to the next that the
scheduler foretells, slowly, so that pictures do not pump.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, get_args

from protocol.messages import Preset, Wishes

BY_COST: tuple[Preset, ...] = ("rm", "art1", "gr15", "reg4", "art4", "reg8", "art8", "gr15fast")
"""Dearest first, as measured on processors (docs/benchmarks/accuracy.md)."""
LADDER: tuple[Preset, ...] = ("rm", "art1", "reg4", "gr15fast")
"""Those of them that are worth stepping to: what lies between costs about the same, or errs more."""
BUDGET_STEP = 0.6
"""Of the budget of a session that chose one."""
MOST_STEPS = 4
"""Of budgets."""
CALM_FRAMES, DOWN_FRAMES = 40, 4
"""Between steps, upwards and downwards."""
EASY = 0.4
"""Of the period that is wanted: only below it is there room for the next dearer step."""

assert set(BY_COST) == set(get_args(Preset)) - {"auto"}


class Quality(NamedTuple):
    """What a session is to ask its pipeline for."""

    preset: Preset
    budget_ms: float | None
    max_light_error_deg: float | None


def cheaper(asked: Quality, steps: int) -> Quality:
    """`asked`, so many steps down; the cheapest where there are no more."""
    if steps == 0:
        return asked
    if asked.preset == "auto":
        if asked.budget_ms is None:
            return asked
        return asked._replace(budget_ms=asked.budget_ms * BUDGET_STEP**steps)
    below = [p for p in LADDER if BY_COST.index(p) > BY_COST.index(asked.preset)]
    return asked._replace(preset=below[min(steps, len(below)) - 1]) if below else asked


def most_steps(asked: Quality) -> int:
    """How far down there is anything cheaper."""
    if asked.preset == "auto":
        return MOST_STEPS if asked.budget_ms is not None else 0
    return sum(BY_COST.index(p) > BY_COST.index(asked.preset) for p in LADDER)


class Pressure:
    """One session's steps."""

    def __init__(self, wishes: Wishes, wanted_period_s: float) -> None:
        """`wanted_period_s`: the longest time between two frames of a session that shares the device with others."""
        self._wanted_s = wanted_period_s
        self._is_fixed = wishes.lossless  # offline work: the same bytes, however long it takes
        self._since = 0
        self.ask(Quality(wishes.preset, wishes.budget_ms, wishes.max_light_error_deg))

    def ask(self, quality: Quality) -> None:
        """What the client asks for, from now on."""
        self.asked = quality
        self.steps = 0

    @property
    def quality(self) -> Quality:
        """What it gets."""
        return cheaper(self.asked, self.steps)

    def observe(self, sharing: int, period_s: Callable[[], float]) -> bool:
        """After a frame of a session that shares the device with so many in all, itself counted: whether it steps."""
        self._since += 1
        if self._is_fixed:
            return False
        if sharing <= 1:
            return self._step(-1, CALM_FRAMES)
        period = period_s()
        if period > self._wanted_s:
            return self._step(+1, DOWN_FRAMES)
        return period < EASY * self._wanted_s and self._step(-1, CALM_FRAMES)

    def _step(self, by: int, patience: int) -> bool:
        to = min(max(self.steps + by, 0), most_steps(self.asked))
        if to == self.steps or self._since < patience:
            return False
        self.steps, self._since = to, 0
        return True
