"""Controls a session's operating point: by a time budget, a greatest light error, or neither (U1).

The controller steps along the Pareto front of the device. It steps down as soon as the budget is exceeded. It steps up
one point at a time, after a number of frames within the budget; that number doubles after each step up that had to be
taken back. So the picture does not oscillate.
"""

from __future__ import annotations

from protocol.messages import OperatingPoint, Timings, Wishes
from server.opencl.device import Device
from server.quality.costs import CostModel
from server.quality.pareto_front import ParetoFront, ParetoPoint, read_front

TOLERANCE = 1.1
"""Tolerated frame time, relative to the budget."""
UP_TO = 0.92
"""Greatest expected time of a better point, with its spread and relative to the budget, to step up to it."""
CALM_FRAMES, MOST_CALM_FRAMES = 15, 240
"""Frames within the budget before a step up: at first, and at most."""
FIRST_CALM_FRAMES = 4
"""The same before the first step up, since a session starts with a fast point."""
TAKEN_BACK_FRAMES = 45
"""A step up that is taken back within this number of frames counts as failed."""
BEGIN = 0.75
"""Greatest expected time of the first point, relative to the budget: the scene is not known yet."""
SETTLING_FRAMES = 2
"""Frames ignored after a change, while buffers are allocated and caches fill, unless they are far too slow."""
BADLY = 1.5
"""Frame time relative to the tolerated one beyond which a frame counts twice."""
LEAST_KNOWN_FRAMES = 5
"""Frames at a point before its expected time is used."""
GOOD_ENOUGH_DEG = 1.0
"""Tolerated light error above the least one if neither budget nor error is given."""


class OperatingPointControl:
    """Controller of one session. Call `observe` after every frame; `chosen` is the point of the next one."""

    def __init__(
        self,
        front: ParetoFront,
        budget_ms: float | None = None,
        max_light_error_deg: float | None = None,
        *,
        is_own: bool = True,
    ) -> None:
        """`is_own`: the front was measured on this device; otherwise its times are those of another."""
        self._is_own = is_own
        self._ladder = front.best()
        self._costs = CostModel()
        self._budget_ms = budget_ms
        self._max_error_deg = max_light_error_deg
        self._reason = ""
        self._since = 0
        self._calm = FIRST_CALM_FRAMES
        self._slow = 0
        self._climbed = False
        self._index = self._begin()

    @property
    def chosen(self) -> ParetoPoint:
        """Operating point of the next frame."""
        return self._ladder[self._index]

    @property
    def operating_point(self) -> OperatingPoint:
        """The point as described in the message of a frame."""
        chosen = self.chosen
        return OperatingPoint(
            settings=chosen.point.settings,
            reason=self._reason,
            expected_ms=self._costs.expected_ms(chosen),
            light_error_deg=chosen.light_error_deg,
        )

    def observe(self, timings: Timings) -> None:
        """Add the times of a frame that ran at `chosen`."""
        self._since += 1
        if self._since > SETTLING_FRAMES:
            self._costs.observe(self.chosen, timings)
        if self._budget_ms is None:
            return
        self._count_slow(timings.total, self._budget_ms)
        if self._must_go_down(self._budget_ms):
            self._go_down(self._budget_ms)
        elif self._since >= self._calm and self._costs.known_frames:
            self._climb(self._budget_ms)

    def _begin(self) -> int:
        last = len(self._ladder) - 1
        if self._budget_ms is not None:
            unknown = "what the scene costs" if self._is_own else "what frames cost on this device"
            self._reason = f"the first frames of a budget of {self._budget_ms:g} ms: {unknown} is not known"
            return self._most_accurate(BEGIN * self._budget_ms)
        best_deg = self._ladder[last].light_error_deg
        most_deg = best_deg + GOOD_ENOUGH_DEG if self._max_error_deg is None else self._max_error_deg
        fitting = [i for i, point in enumerate(self._ladder) if point.light_error_deg <= most_deg]
        if not fitting:
            self._reason = f"no point errs by {most_deg:g} degrees or less on this device: the most accurate"
            return min(range(last + 1), key=lambda i: self._ladder[i].light_error_deg)
        words = f"{most_deg:.3g} degrees or less"
        self._reason = f"the fastest whose light erred by {words} where the device was measured"
        return fitting[0]

    def _count_slow(self, total_ms: float, budget_ms: float) -> None:
        badly = total_ms > BADLY * TOLERANCE * budget_ms
        slow = total_ms > TOLERANCE * budget_ms and (self._since > SETTLING_FRAMES or badly)
        self._slow = self._slow + 1 + badly if slow else max(0, self._slow - 1)

    def _must_go_down(self, budget_ms: float) -> bool:
        if self._index == 0:
            return False
        if self._slow >= 2:
            return True
        settled = self._costs.known_frames >= LEAST_KNOWN_FRAMES
        return settled and self._costs.expected_ms(self.chosen) * self._costs.spread > TOLERANCE * budget_ms

    def _go_down(self, budget_ms: float) -> None:
        was = self._index
        self._index = min(self._most_accurate(UP_TO * budget_ms), self._index - 1)
        if self._climbed and self._since < TAKEN_BACK_FRAMES:
            self._calm = min(2 * max(self._calm, CALM_FRAMES), MOST_CALM_FRAMES)
        self._climbed = False
        self._moved(was, f"frames at the last point took more than the budget of {budget_ms:g} ms")

    def _climb(self, budget_ms: float) -> None:
        target = self._most_accurate(UP_TO * budget_ms)
        if target <= self._index:
            self._reason = self._reason_here(budget_ms)
            self._since = min(self._since, self._calm)
            return
        was, self._index = self._index, self._index + 1
        if self._climbed or self._calm < CALM_FRAMES:  # the climb before this one has lasted
            self._calm = CALM_FRAMES
        self._climbed = True
        self._moved(was, f"the next better one was expected to stay below the budget of {budget_ms:g} ms")

    def _reason_here(self, budget_ms: float) -> str:
        if self._index == len(self._ladder) - 1:
            return f"the most accurate, and within the budget of {budget_ms:g} ms"
        if self._index == 0 and self._costs.expected_ms(self.chosen) > budget_ms:
            return f"the fastest; no point is expected within the budget of {budget_ms:g} ms"
        return f"the most accurate that is expected within the budget of {budget_ms:g} ms"

    def _moved(self, was: int, reason: str) -> None:
        if was == self._index:
            return
        self._reason = reason
        self._since = 0
        self._slow = 0
        self._costs.changed()

    def _most_accurate(self, below_ms: float) -> int:
        """Index of the most accurate point expected to take less, with its spread; the fastest if there is none.

        With a limit of the light error: the fastest point within it.
        """
        spread = self._costs.spread
        fitting = [i for i, p in enumerate(self._ladder) if self._costs.expected_ms(p) * spread <= below_ms * TOLERANCE]
        if not fitting:
            return 0
        if self._max_error_deg is not None:
            enough = [i for i in fitting if self._ladder[i].light_error_deg <= self._max_error_deg]
            return enough[0] if enough else fitting[-1]
        return fitting[-1]


def control_for(device: Device, wishes: Wishes) -> OperatingPointControl | None:
    """The controller of a session with preset `auto`, else None. Raises FrontError."""
    if wishes.preset != "auto":
        return None
    front = read_front(device.name)
    return OperatingPointControl(
        front, wishes.budget_ms, wishes.max_light_error_deg, is_own=front.device == device.name
    )
