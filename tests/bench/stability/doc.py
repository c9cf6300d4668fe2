"""Puts the last run of `probeless bench stability` into docs: `python -m tests.bench.stability.doc`.

The page's words stand before the first mark; what comes between the marks is made here: builds, then a table a family.
"""

from __future__ import annotations

import json
import shutil
from itertools import groupby
from typing import Any

from tests.bench.report.finished import ROOT
from tests.bench.report.page import END, START, origin
from tests.bench.stability.suite import OUT

PAGE = ROOT / "docs" / "benchmarks" / "stability.md"


def figures(result: dict[str, Any]) -> str:
    """Markdown: what was run, what is red, and every case with bound and errors."""
    builds, cases = result["builds"], result["cases"]
    lines = [f"{origin(result)}: {len(cases)} cases in {len(builds)} builds.", ""]
    lines += ["| build | green | red |", "|---|---|---|"]
    for build in builds:
        red = sum(case["builds"][build]["fault"] is not None for case in cases)
        lines.append(f"| {build} | {len(cases) - red} | {red} |")
    disagree = [case for case in cases if case["apart"] is None or case["apart"] > case["agreement"]]
    lines += ["", f"Builds disagree in {len(disagree)} cases."]
    faults = [
        f"- {case['family']}: {case['name']}, {build}: {case['builds'][build]['fault']}"
        for case in cases
        for build in builds
        if case["builds"][build]["fault"]
    ]
    faults += [f"- {c['family']}: {c['name']}: builds are {_number(c['apart'])} {c['unit']} apart" for c in disagree]
    lines += [""] * bool(faults) + faults
    for family, of_family in groupby(cases, key=lambda case: case["family"]):
        lines += ["", f"### {family.capitalize()}", ""]
        lines += [f"| case | bound | {' | '.join(builds)} | builds apart | says | why the bound |"]
        lines += ["|---" * (len(builds) + 5) + "|"]
        lines += [_line(case, builds) for case in of_family]
    return "\n".join([*lines, ""])


def _line(case: dict[str, Any], builds: list[str]) -> str:
    errors = [_number(case["builds"][build]["error"]) for build in builds]
    said = {True: "known", False: "unknown", None: ""}[case["must_be_known"]]
    bound = f"{_number(case['bound'])} {case['unit']}"
    cells = [case["name"], bound, *errors, _number(case["apart"]), said, case["reason"]]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.2g}"


if __name__ == "__main__":
    before, _, rest = PAGE.read_text().partition(START)
    after = rest.partition(END)[2]
    PAGE.write_text(before + START + figures(json.loads((OUT / "result.json").read_text())) + END + after)
    shutil.copy(OUT / "result.json", PAGE.with_suffix(".json"))
