"""Exposure curves of the scene's camera, similar to automatic exposure."""

from __future__ import annotations

import math
from collections.abc import Callable

FIRST_EXPOSURE = 1 / 60
"""Reported exposure of the first frame if exposure varies; exposure is relative and need not start at 1."""
_WALK_FRAMES, _SWAY_FRAMES = 90, 23
_STEP_FRAMES = 15
_STEPS = (1.0, 0.5, 1.0, 2.0)


def constant(_index: int) -> float:
    """1."""
    return 1.0


def walk(index: int) -> float:
    """Exposure relative to frame 0: oscillates within a factor of 2, up to 8 % between frames."""
    slow, fast = (math.sin(2 * math.pi * index / period) for period in (_WALK_FRAMES, _SWAY_FRAMES))
    return float(2.0 ** (0.8 * slow + 0.2 * fast))


def steps(index: int) -> float:
    """Exposure relative to frame 0: halved and doubled in steps."""
    return _STEPS[index // _STEP_FRAMES % len(_STEPS)]


EXPOSURE_CURVES: dict[str, Callable[[int], float]] = {"constant": constant, "walk": walk, "steps": steps}
