"""Puts the last run of `probeless bench speed` into docs/benchmarks: `python -m tests.bench.speed.doc`."""

from __future__ import annotations

from tests.bench.report.finished import ROOT
from tests.bench.report.page import write_page
from tests.bench.speed.suite import OUT

if __name__ == "__main__":
    write_page(ROOT / "docs" / "benchmarks" / "speed.md", OUT / "result.json")
