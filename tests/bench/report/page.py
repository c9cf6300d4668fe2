"""Puts a suite's last figures into its page of docs/benchmarks, between two marks, and the JSON beside the page."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

START, END = "<!-- figures -->\n", "<!-- end of figures -->\n"


def write_page(page: Path, result: Path, shown: Callable[[str], bool] = lambda _name: True) -> None:
    """Write the figures of a suite's result.json into `page`, and a copy of it beside the page.

    shown: of rows without a goal, by their names, those that are not left to the copy.
    """
    before, _, rest = page.read_text().partition(START)
    after = rest.partition(END)[2]
    found = json.loads(result.read_text())
    found["rows"] = [row for row in found["rows"] if row["goal"] or shown(row["name"])]
    page.write_text(before + START + figures(found) + END + after)
    shutil.copy(result, page.with_suffix(".json"))


def origin(result: dict[str, Any]) -> str:
    """The commit, the date and the machine of a result; results of earlier versions have no date."""
    date = f" {result['date']}" if "date" in result else ""
    return f"Commit {result['commit']}, measured{date} on {result['device']}"


def figures(result: dict[str, Any]) -> str:
    """Markdown: the machine, what was held and what not, all rows, what was not measured."""
    sizes = ", ".join(f"{name}: {count}" for name, count in result["sizes"].items())
    held = [row for row in result["rows"] if row["goal"]]
    others = [row for row in result["rows"] if not row["goal"]]
    lines = [f"{origin(result)}. {sizes}.", "", "Held against a goal:", ""]
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
