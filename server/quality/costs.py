"""What a frame will take at an operating point: the front's rows, scaled to this scene by what its frames took."""

from __future__ import annotations

from collections import deque
from statistics import median

from msgspec import structs

from protocol.messages import Timings
from server.quality.pareto_front import ParetoPoint

WINDOW = 9
"""Frames of which a row's median is taken: three slow ones in a row do not move it, five do."""
SMALL_MS = 1.0
"""Rows below it scale with nothing: they are added as they are."""
SPREAD_WINDOW = 40
"""Frames that tell how much a frame's time scatters about its median."""
USUAL_SPREAD = 1.1


def rows_of(timings: Timings) -> dict[str, float]:
    """The rows, and as `other` what the whole frame took besides."""
    rows: dict[str, float] = structs.asdict(timings)
    total = rows.pop("total")
    return {**rows, "other": max(total - sum(rows.values()), 0.0)}


class CostModel:
    """Of one session. A row of the scene costs a factor of what it cost when the front was measured, at every point:
    how far rays run, how much of the picture is virtual, how fast the machine is today."""

    def __init__(self) -> None:
        self._recent: deque[dict[str, float]] = deque(maxlen=WINDOW)
        self._factors: dict[str, float] = {}
        self._totals: deque[float] = deque(maxlen=SPREAD_WINDOW)
        self._small: dict[str, float] = {}

    def changed(self) -> None:
        """Another point from now on: what its frames take says nothing of the last one's rows."""
        self._recent.clear()

    def observe(self, point: ParetoPoint, timings: Timings) -> None:
        """One frame at `point`."""
        self._recent.append(rows_of(timings))
        for name in self._recent[-1]:
            found = median(rows.get(name, 0.0) for rows in self._recent)
            reference = point.ms.get(name, 0.0)
            if reference > SMALL_MS:
                self._factors[name] = found / reference
                self._small.pop(name, None)
            else:
                self._small[name] = found
        self._totals.append(timings.total / self.expected_ms(point))

    @property
    def known_frames(self) -> int:
        """At the present point, `WINDOW` at most."""
        return len(self._recent)

    @property
    def spread(self) -> float:
        """What nine frames of ten stay below, over what is expected."""
        if len(self._totals) < WINDOW:
            return USUAL_SPREAD
        return max(1.0, sorted(self._totals)[int(0.9 * len(self._totals))])

    def expected_ms(self, point: ParetoPoint) -> float:
        """Median of frames at `point`, so far as is known."""
        scaled = (ms * self._factors.get(name, 1.0) for name, ms in point.ms.items() if name not in self._small)
        return sum(scaled) + sum(self._small.values()) or 1e-3
