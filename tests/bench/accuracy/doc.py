"""Puts the last run of `probeless bench accuracy` into docs/benchmarks: `python -m tests.bench.accuracy.doc`."""

from __future__ import annotations

from tests.bench.accuracy.suite import OUT
from tests.bench.report.finished import ROOT
from tests.bench.report.page import write_page

SHOWN = ("table ", "fig. ", "living room", "stage: ", "lit-room: ")
"""How names begin of rows that stand on the page without a goal; the others, hundreds, are in the JSON beside it."""

if __name__ == "__main__":
    page = ROOT / "docs" / "benchmarks" / "accuracy.md"
    write_page(page, OUT / "result.json", lambda name: name.startswith(SHOWN))
