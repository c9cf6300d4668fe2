"""Puts the last run of `probeless bench accuracy` into docs/benchmarks: `python -m tests.bench.accuracy_doc`."""

from __future__ import annotations

from tests.bench.accuracy import OUT
from tests.bench.finished import ROOT
from tests.bench.page import write_page

if __name__ == "__main__":
    write_page(ROOT / "docs" / "benchmarks" / "accuracy.md", OUT / "result.json")
