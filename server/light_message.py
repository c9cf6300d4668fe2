"""The estimated light as the wire and `light.jsonl` carry it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from protocol.messages import Light
from server.maths.sh import dominant_direction, dominant_intensity, webxr_floats
from server.stages.light_estimation import LightEstimate

_WIRE_COEFFICIENTS = 16


def light_message(
    frame: int, timestamp_s: float, estimate: LightEstimate, webxr_from_world: NDArray[np.float64]
) -> Light:
    """Message of `estimate`; bands not estimated are zeros with unknown deviation."""
    sh, std = estimate.sh, estimate.std
    direction = dominant_direction(sh)
    return Light(
        frame=frame,
        timestamp_s=timestamp_s,
        sh=tuple(_rgb(sh[i]) if i < len(sh) else (0.0, 0.0, 0.0) for i in range(_WIRE_COEFFICIENTS)),
        sh_all=tuple(_rgb(row) for row in sh) if len(sh) > _WIRE_COEFFICIENTS else None,
        sh_std=tuple(
            _rgb(std[i]) if std is not None and i < len(std) else (None, None, None) for i in range(_WIRE_COEFFICIENTS)
        ),
        sh_webxr=webxr_floats(sh, webxr_from_world),
        dominant_direction=_rgb(direction),
        dominant_intensity=dominant_intensity(sh),
        condition=estimate.condition if math.isfinite(estimate.condition) else None,
        valid=estimate.valid,
    )


def _rgb(row: NDArray[np.float64]) -> tuple[float, float, float]:
    return float(row[0]), float(row[1]), float(row[2])
