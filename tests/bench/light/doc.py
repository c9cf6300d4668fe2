"""Puts the last run of `probeless bench light` into docs/benchmarks: `python -m tests.bench.light.doc`."""

from __future__ import annotations

from tests.bench.light.parts import OUT
from tests.bench.report.finished import ROOT
from tests.bench.report.page import write_page

if __name__ == "__main__":
    write_page(ROOT / "docs" / "benchmarks" / "light.md", OUT / "result.json")
