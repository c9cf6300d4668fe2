"""Puts the last run of `probeless bench plan` into docs/benchmarks/plan.md: `python -m tests.bench.plan_doc`."""

from __future__ import annotations

from tests.bench.finished import ROOT
from tests.bench.page import write_page
from tests.bench.plan import OUT

if __name__ == "__main__":
    write_page(ROOT / "docs" / "benchmarks" / "plan.md", OUT / "result.json")
