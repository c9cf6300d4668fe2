"""Puts the last run of `probeless bench speed` into docs/benchmarks: `python -m tests.bench.speed.doc`.

`python -m tests.bench.speed.doc speed_gpu.md RESULT.json` puts another machine's run into a page of its own.
"""

from __future__ import annotations

import sys
from pathlib import Path

from tests.bench.report.finished import ROOT
from tests.bench.report.page import write_page
from tests.bench.speed.suite import OUT

if __name__ == "__main__":
    page, result = sys.argv[1:3] or ("speed.md", OUT / "result.json")
    write_page(ROOT / "docs" / "benchmarks" / page, Path(result))
