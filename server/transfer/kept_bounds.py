"""How far off a picture is for what it has of earlier frames: measured by kept_changes.py, stated in the plan."""

from __future__ import annotations

from dataclasses import dataclass

from protocol.messages import LeftOut

MEASURED = "measured where others were found anew, for all but a thousandth of the pixels"
NOT_YET = "how far off that is will be known when enough was found anew"
"""Ends of the reason of what is kept, with a bound and without."""


@dataclass(frozen=True)
class KeptBounds:
    """In display units (1 is 1/255), for all but a thousandth of the pixels; None: not known yet."""

    known: float | None
    """Of what stands as it was found earlier."""
    lent: float | None
    """Of what was found with the transfer of a sample beside it."""


def kept_left_out(effect: str, reason: str, bound: float | None) -> LeftOut:
    """What is not made anew, and how far off it may be."""
    return LeftOut(effect=effect, reason=f"{reason}; {NOT_YET if bound is None else MEASURED}", error_bound=bound)
