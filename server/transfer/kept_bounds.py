"""How far off a picture is for what it has of earlier frames: measured by kept_changes.py, stated in the plan."""

from __future__ import annotations

from dataclasses import dataclass

MEASURED = "measured where others were found anew, for all but a thousandth of the pixels"
"""Of a reason whose bound is one of KeptBounds."""


@dataclass(frozen=True)
class KeptBounds:
    """In display units (1 is 1/255), for all but a thousandth of the pixels; None: not known yet."""

    known: float | None
    """Of what stands as it was found earlier."""
    lent: float | None
    """Of what was found with the transfer of a sample beside it."""


NOT_SHOWN = KeptBounds(0.0, 0.0)
"""Of a picture that has nothing of it."""
