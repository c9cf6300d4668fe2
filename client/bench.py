"""`probeless bench SUITE`: finds the suite, runs it, prints its rows.

A suite is a module of `server.evaluation` or `tests.bench` named after it, with
`run_suite(quick: bool, progress: Callable[[str], None]) -> dict`: `device`, `commit`, `rows`, `unmeasured`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.util import find_spec
from inspect import signature
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from client.laptop.errors import OptionError
from client.progress import note, say

SUITES = ("geometry", "light", "rendering", "accuracy", "stability", "plan", "service", "client")
_CHECKOUT = Path(__file__).resolve().parents[1]
PACKAGES = ("server.evaluation", "tests.bench")

Suite = Callable[..., dict[str, Any]]


def run_bench(name: str, as_json: bool, quick: bool, options: Mapping[str, Any] | None = None) -> None:
    """Run a suite and print what it measured. `options`: those that only some suites take; None where nothing was said.

    Raises OptionError, listing the suites that exist, and for an option that the suite does not take.
    """
    suite = find_suite(name)
    if suite is None:
        existing = ", ".join(known for known in SUITES if find_suite(known) is not None)
        raise OptionError(f"there is no suite {name!r} here; there are: {existing or 'none yet'}")
    said = {option: value for option, value in (options or {}).items() if value is not None}
    for option in said:
        if option not in signature(suite).parameters:
            raise OptionError(f"--{option}: bench {name} has no such option; leave it out")
    result = suite(quick, note, **said)
    if as_json:
        say(json.dumps(result, allow_nan=False))
    else:
        _print(result)


def find_suite(name: str) -> Suite | None:
    """The suite's function, if this installation has it."""
    if name not in SUITES:
        return None
    if str(_CHECKOUT) not in sys.path:  # the benchmarks lie beside the packages, not in them
        sys.path.append(str(_CHECKOUT))
    for package in PACKAGES:
        if _exists(package) and _exists(f"{package}.{name}"):
            function: Suite | None = getattr(import_module(f"{package}.{name}"), "run_suite", None)
            if function is not None:
                return function
    return None


def _exists(module: str) -> bool:
    """True if the module can be found; the benchmarks' package is not part of every installation."""
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def _print(result: dict[str, Any]) -> None:
    table = Table("row", "value", "unit", "goal", "holds", title=f"{result['device']}, {result['commit']}")
    for row in result["rows"]:
        holds = {True: "yes", False: "NO", None: ""}[row["holds"]]
        table.add_row(row["name"], f"{row['value']:.4g}", row["unit"], row["goal"] or "", holds)
    console = Console()
    console.print(table)
    for missing in result["unmeasured"]:
        console.print(f"not measured: {missing['name']}: {missing['reason']}", markup=False)
