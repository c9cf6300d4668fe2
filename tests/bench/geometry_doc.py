"""Puts the last run of `probeless bench geometry` into docs/benchmarks: `python -m tests.bench.geometry_doc`."""

from __future__ import annotations

from tests.bench.finished import ROOT
from tests.bench.geometry_parts import OUT
from tests.bench.page import write_page

if __name__ == "__main__":
    write_page(ROOT / "docs" / "benchmarks" / "geometry.md", OUT / "result.json")
