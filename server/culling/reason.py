"""Why an effect is culled from a frame, and how much all culled effects may change together."""

from __future__ import annotations

from dataclasses import dataclass

ALLOWANCE = 1.0
"""Allowed change of a pixel by all culled effects together, in display units (1 is 1/255) before rounding. Values less
than one unit apart round to the same code or to neighbouring codes."""


@dataclass(frozen=True)
class CullReason:
    """Why a scene does not need an effect. Equal reasons are one: their change is counted once."""

    reason: str
    error_bound: float
    """Bound on the change of any pixel by culling the effect, in display units (1 is 1/255) before rounding."""
