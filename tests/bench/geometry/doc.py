"""Puts the last run of `probeless bench geometry` into docs/benchmarks: `python -m tests.bench.geometry.doc`."""

from __future__ import annotations

from tests.bench.geometry.parts import OUT
from tests.bench.report.finished import ROOT
from tests.bench.report.page import write_page

if __name__ == "__main__":
    write_page(ROOT / "docs" / "benchmarks" / "geometry.md", OUT / "result.json")
