"""Why an effect is left out of a frame, and how much all that is left out may change together."""

from __future__ import annotations

from dataclasses import dataclass

ALLOWANCE = 1.0
"""Display units (1 is 1/255) that a pixel may change by, before it is rounded, by all that is left out as needless.
Numbers that are less than one apart round to the same code or to neighbours."""


@dataclass(frozen=True)
class CullReason:
    """Why a scene does not call for an effect. Equal ones are one: what they change is counted once."""

    reason: str
    error_bound: float
    """Greatest change of any pixel by leaving the effect out, in display units (1 is 1/255), before rounding."""
