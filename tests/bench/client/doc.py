"""Puts the last run of `probeless bench client` into docs/benchmarks: `python -m tests.bench.client.doc`."""

from __future__ import annotations

from tests.bench.client.suite import OUT
from tests.bench.report.finished import ROOT
from tests.bench.report.page import write_page

OTHER_RATES = (", 30/s,", ", 7.5/s,")


def shown(name: str) -> bool:
    """Rows for the page: video at the rate that bits are counted at."""
    return not any(rate in name for rate in OTHER_RATES)


if __name__ == "__main__":
    write_page(ROOT / "docs" / "benchmarks" / "client.md", OUT / "result.json", shown)
