"""How far the dominant directions of two lights are apart."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from server.maths.sh import dominant_direction

Floats = NDArray[np.float64]


def direction_dot(estimated: Floats, true: Floats) -> float:
    """Dot product of the dominant directions of two lights [n, 3]; 0 where one has none."""
    return float(np.clip(dominant_direction(estimated) @ dominant_direction(true), -1, 1))


def direction_error_deg(estimated: Floats, true: Floats) -> float:
    """Angle between the dominant directions; 90 degrees where one light has none."""
    return float(np.degrees(np.arccos(direction_dot(estimated, true))))
