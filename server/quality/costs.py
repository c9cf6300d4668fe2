"""Cost model: the time of a frame at an operating point, from the measured front, scaled to the current scene."""

from __future__ import annotations

from collections import deque
from statistics import median

from protocol.messages import TIMING_ROWS, Timings
from server.quality.pareto_front import ParetoPoint

WINDOW = 9
"""Frames in the median of a row: three slow frames do not change it, five do."""
SMALL_MS = 1.0
"""Rows below it are not scaled but added as measured."""
SPREAD_WINDOW = 40
"""Number of frames for the spread about the median."""
USUAL_SPREAD = 1.1
"""Spread before enough frames are known."""


def rows_of(timings: Timings) -> dict[str, float]:
    """The rows, and the rest of the total as `other`."""
    rows: dict[str, float] = {name: getattr(timings, name) for name in TIMING_ROWS}
    return {**rows, "other": max(timings.total - sum(rows.values()), 0.0)}


class CostModel:
    """Costs of one session. Each row has one factor between this scene and the scene of the front, for all operating
    points. It covers ray lengths, the share of virtual pixels and the load of the machine."""

    def __init__(self) -> None:
        self._recent: deque[dict[str, float]] = deque(maxlen=WINDOW)
        self._factors: dict[str, float] = {}
        self._totals: deque[float] = deque(maxlen=SPREAD_WINDOW)
        self._small: dict[str, float] = {}

    def changed(self) -> None:
        """The operating point changes: forget the frames of the last one."""
        self._recent.clear()

    def observe(self, point: ParetoPoint, timings: Timings) -> None:
        """Add the times of one frame at `point`."""
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
        """Frames seen at the current point, at most WINDOW."""
        return len(self._recent)

    @property
    def spread(self) -> float:
        """90 % quantile of frame times, relative to the expected time."""
        if len(self._totals) < WINDOW:
            return USUAL_SPREAD
        return max(1.0, sorted(self._totals)[int(0.9 * len(self._totals))])

    def expected_ms(self, point: ParetoPoint) -> float:
        """Expected median frame time at `point`."""
        scaled = (ms * self._factors.get(name, 1.0) for name, ms in point.ms.items() if name not in self._small)
        return sum(scaled) + sum(self._small.values()) or 1e-3
