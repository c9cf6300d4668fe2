"""E5 in the suite of accuracy: the parts that measure the thesis's tables and figures, and B9."""

from __future__ import annotations

from collections.abc import Callable

from tests.bench.bases.comparison import bases_part
from tests.bench.report.finished import Part
from tests.bench.report.run import Run
from tests.bench.thesis.families import families_part
from tests.bench.thesis.light import reach_part, robust_part
from tests.bench.thesis.presets import presets_part
from tests.bench.thesis.probe import probe_part
from tests.bench.thesis.speed import speed_part

PRESETS, SPEED, ROBUST, REACH, PROBE, FAMILIES, BASES = (
    "presets",
    "speed",
    "robust",
    "reach",
    "probe",
    "families",
    "bases",
)

THESIS_PARTS: dict[str, Callable[[Run], Part]] = {
    PRESETS: presets_part,
    SPEED: speed_part,
    ROBUST: robust_part,
    REACH: reach_part,
    PROBE: probe_part,
    FAMILIES: families_part,
    BASES: bases_part,
}
"""By the names under which the report looks for them."""
