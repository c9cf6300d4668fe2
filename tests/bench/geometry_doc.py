"""Puts the last run of `probeless bench geometry` into docs/benchmarks: `python -m tests.bench.geometry_doc`."""

from __future__ import annotations

import json
import shutil
from typing import Any

from tests.bench.finished import ROOT
from tests.bench.geometry_parts import OUT

PAGE = ROOT / "docs" / "benchmarks" / "geometry.md"
START, END = "<!-- figures -->\n", "<!-- end of figures -->\n"


def main() -> None:
    """Write the page's figures and the JSON beside it."""
    result = json.loads((OUT / "result.json").read_text())
    before, _, rest = PAGE.read_text().partition(START)
    after = rest.partition(END)[2]
    PAGE.write_text(before + START + figures(result) + END + after)
    shutil.copy(OUT / "result.json", PAGE.with_suffix(".json"))


def figures(result: dict[str, Any]) -> str:
    """Markdown: the machine, what was held and what not, all rows, what was not measured."""
    sizes = ", ".join(f"{name}: {count}" for name, count in result["sizes"].items())
    held = [row for row in result["rows"] if row["goal"]]
    others = [row for row in result["rows"] if not row["goal"]]
    lines = [f"Commit {result['commit']} on {result['device']}. {sizes}.", "", "Held against a goal:", ""]
    lines += ["| row | value | unit | goal | holds |", "|---|---|---|---|---|"]
    for row in held:
        holds = "yes" if row["holds"] else "**no**"
        lines.append(f"| {row['name']} | {row['value']:.4g} | {row['unit']} | {row['goal']} | {holds} |")
    lines += ["", "Beside them:", "", "| row | value | unit |", "|---|---|---|"]
    lines += [f"| {row['name']} | {row['value']:.4g} | {row['unit']} |" for row in others]
    if result["unmeasured"]:
        lines += ["", "Not measured:", ""]
        lines += [f"- {item['name']}: {item['reason']}" for item in result["unmeasured"]]
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    main()
