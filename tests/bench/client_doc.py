"""Puts the last run of `probeless bench client` into docs/benchmarks: `python -m tests.bench.client_doc`."""

from __future__ import annotations

from tests.bench.client import OUT
from tests.bench.finished import ROOT
from tests.bench.page import write_page

if __name__ == "__main__":
    write_page(ROOT / "docs" / "benchmarks" / "client.md", OUT / "result.json")
