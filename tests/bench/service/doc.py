"""Puts the last run of `probeless bench service` into docs/benchmarks: `python -m tests.bench.service.doc`."""

from __future__ import annotations

from tests.bench.report.finished import ROOT
from tests.bench.report.page import write_page
from tests.bench.service.suite import OUT

if __name__ == "__main__":
    write_page(ROOT / "docs" / "benchmarks" / "service.md", OUT / "result.json")
