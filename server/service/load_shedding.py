"""Load shedding: sessions that share an overloaded device use cheaper sampling before frames are dropped.

A session that is alone gets what it requested. Steps depend on the frame period that the scheduler predicts. There is a
minimum number of frames between steps, so that quality does not oscillate. Sampling whose frames would take seconds is
not begun at all while others are there.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, get_args

from protocol.messages import Preset, Wishes

BY_COST: tuple[Preset, ...] = ("rm", "art1", "gr15", "reg4", "art4", "reg8", "art8", "gr15fast")
"""Presets by cost, most expensive first, as measured on CPUs (docs/benchmarks/accuracy.md)."""
LADDER: tuple[Preset, ...] = ("rm", "art1", "reg4", "gr15fast")
"""Presets that are stepped to. The others cost about the same as a neighbour, or have a larger error."""
BUDGET_STEP = 0.6
"""Factor per step on the budget of a session that chose one."""
MOST_STEPS = 4
"""Limit on steps of the budget."""
FRAMES_BEFORE_FINER, FRAMES_BEFORE_CHEAPER = 40, 4
"""Minimum frames before a step to finer and to cheaper sampling."""
MOST_FRAME_S = 1.0
"""Predicted time of a frame above which a session that shares the device samples more cheaply before it is begun: the
others of its room wait until it has ended."""
FINER_BELOW = 0.4
"""Share of the target period below which there is time for the next finer step."""

assert set(BY_COST) == set(get_args(Preset)) - {"auto"}


class SamplingRequest(NamedTuple):
    """Sampling that a session requests of its pipeline."""

    preset: Preset
    budget_ms: float | None
    max_light_error_deg: float | None


def cheaper(requested: SamplingRequest, steps: int) -> SamplingRequest:
    """`requested` lowered by `steps`, at most to the cheapest one."""
    if steps == 0:
        return requested
    if requested.preset == "auto":
        if requested.budget_ms is None:
            return requested
        return requested._replace(budget_ms=requested.budget_ms * BUDGET_STEP**steps)
    below = [p for p in LADDER if BY_COST.index(p) > BY_COST.index(requested.preset)]
    return requested._replace(preset=below[min(steps, len(below)) - 1]) if below else requested


def most_steps(requested: SamplingRequest) -> int:
    """Number of cheaper steps available."""
    if requested.preset == "auto":
        return MOST_STEPS if requested.budget_ms is not None else 0
    return sum(BY_COST.index(p) > BY_COST.index(requested.preset) for p in LADDER)


class LoadShedding:
    """State of one session."""

    def __init__(self, wishes: Wishes, target_period_s: float) -> None:
        """`target_period_s`: frame period above which a session that shares the device samples more cheaply."""
        self._wanted_s = target_period_s
        self._is_fixed = wishes.lossless  # offline work: the same bytes, however long it takes
        self._since = 0
        self.request(SamplingRequest(wishes.preset, wishes.budget_ms, wishes.max_light_error_deg))

    def request(self, request: SamplingRequest) -> None:
        """Set what the client requests from now on."""
        self.requested = request
        self.steps = 0

    @property
    def granted(self) -> SamplingRequest:
        """The request, lowered by the current steps."""
        return cheaper(self.requested, self.steps)

    def observe(self, sharing: int, period_s: Callable[[], float]) -> bool:
        """Call after each frame. `sharing`: sessions on the device, this one included. True if the step changed."""
        self._since += 1
        if self._is_fixed:
            return False
        if sharing <= 1:
            return self._step(-1, FRAMES_BEFORE_FINER)
        period = period_s()
        if period > self._wanted_s:
            return self._step(+1, FRAMES_BEFORE_CHEAPER)
        return period < FINER_BELOW * self._wanted_s and self._step(-1, FRAMES_BEFORE_FINER)

    def limit(self, sharing: int, predicted_s: Callable[[Preset], float]) -> bool:
        """Call before each frame. `predicted_s`: time of a frame at a preset. True if the step changed."""
        before = self.steps
        if sharing > 1 and not self._is_fixed:
            while self.steps < most_steps(self.requested) and predicted_s(self.granted.preset) > MOST_FRAME_S:
                self.steps += 1
        return self.steps != before

    def _step(self, by: int, patience: int) -> bool:
        to = min(max(self.steps + by, 0), most_steps(self.requested))
        if to == self.steps or self._since < patience:
            return False
        self.steps, self._since = to, 0
        return True
