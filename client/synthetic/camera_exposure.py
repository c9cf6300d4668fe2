"""How the exposure of a scene's camera goes, as a camera that chooses it by itself would have it."""

from __future__ import annotations

import math
from collections.abc import Callable

FIRST_EXPOSURE = 1 / 60
"""What the first frame says of its exposure, where it changes: it is relative, and need not begin with 1."""
_WALK_FRAMES, _SWAY_FRAMES = 90, 23
_STEP_FRAMES = 15
_STEPS = (1.0, 0.5, 1.0, 2.0)


def constant(_index: int) -> float:
    """1."""
    return 1.0


def walk(index: int) -> float:
    """Of one frame relative to the first: to and fro within a factor of 2, by up to 8 % between two frames."""
    slow, fast = (math.sin(2 * math.pi * index / period) for period in (_WALK_FRAMES, _SWAY_FRAMES))
    return float(2.0 ** (0.8 * slow + 0.2 * fast))


def steps(index: int) -> float:
    """Of one frame relative to the first: halved and doubled, from one frame to the next."""
    return _STEPS[index // _STEP_FRAMES % len(_STEPS)]


EXPOSURE_CURVES: dict[str, Callable[[int], float]] = {"constant": constant, "walk": walk, "steps": steps}
