"""What the parts of the suite of rendering share."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from tests.bench.report.finished import UnmeasurableError

OUT = Path("out/bench/rendering")
PRESETS = ("rm", "art4", "gr15", "gr15fast")
"""Those of the thesis's fig. 7.11: volume rays, accelerated; image space, accelerated."""


def require(*modules: str) -> None:
    """Raise UnmeasurableError unless all are installed."""
    missing = [name for name in modules if find_spec(name) is None]
    if missing:
        raise UnmeasurableError(f"{' and '.join(missing)} not installed: make install-bench")
