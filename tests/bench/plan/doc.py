"""Puts the last run of `probeless bench plan` into docs/benchmarks/plan.md: `python -m tests.bench.plan.doc`."""

from __future__ import annotations

from tests.bench.plan.suite import OUT
from tests.bench.report.finished import ROOT
from tests.bench.report.page import write_page

if __name__ == "__main__":
    write_page(ROOT / "docs" / "benchmarks" / "plan.md", OUT / "result.json")
