"""Puts the last run of `probeless bench rendering` into docs: `python -m tests.bench.rendering.doc`.

Its figures go into docs/benchmarks/rendering.md, rows of its sheets to docs/pictures.
"""

from __future__ import annotations

import shutil

from tests.bench.rendering.common import OUT
from tests.bench.rendering.pictures import stack
from tests.bench.report.finished import ROOT
from tests.bench.report.page import write_page

ROWS = {
    "presets": ("key_tex_direct", "key_white_gi", "studio_white_direct", "stage_market_light_from_the_left"),
    "bounce": ("key_tex_gi", "key_white_gi"),
}
SHARE = 0.7
"""Of the sheets' size: the page's pictures stay small."""

if __name__ == "__main__":
    write_page(ROOT / "docs" / "benchmarks" / "rendering.md", OUT / "result.json")
    pictures = ROOT / "docs" / "pictures"
    for word, rows in ROWS.items():
        stack(OUT, word, pictures / f"rendering_{word}.jpg", rows, SHARE)
    shutil.copy(OUT / "turning.jpg", pictures / "rendering_turning.jpg")
