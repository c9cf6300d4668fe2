"""`probeless bench SUITE`: find a suite, run it and print its rows.

Suites are part of a source checkout, not of the installed package. A suite is the module `tests.bench.NAME.suite`, with
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

from client.errors import OptionError, RunError
from client.progress import note, say

SUITES = ("geometry", "light", "rendering", "accuracy", "stability", "plan", "speed", "service", "client")
OWN_PACKAGES = ("tests", "client", "server", "protocol", "cl_kernels")
_CHECKOUT = Path(__file__).resolve().parents[2]

Suite = Callable[..., dict[str, Any]]


def run_bench(name: str, as_json: bool, quick: bool, options: Mapping[str, Any] | None = None) -> None:
    """Run a suite and print its results. `options`: options of single suites; None: not given.

    Raises OptionError for an unknown suite or an option that it lacks; RunError if its files or a package are missing.
    """
    suite = find_suite(name)
    given = {option: value for option, value in (options or {}).items() if value is not None}
    for option in given:
        if option not in signature(suite).parameters:
            raise OptionError(f"--{option}: bench {name} has no such option; leave it out")
    try:
        result = suite(quick, note, **given)
    except ModuleNotFoundError as error:
        raise _missing(name, error) from error
    if as_json:
        say(json.dumps(result, allow_nan=False))
    else:
        _print(result)


def find_suite(name: str) -> Suite:
    """The suite's function. Raises OptionError for an unknown name; RunError if it is not installed."""
    if name not in SUITES:
        raise OptionError(f"there is no suite {name!r}; there are: {', '.join(SUITES)}")
    if str(_CHECKOUT) not in sys.path:  # suites lie in the checkout, outside the packages
        sys.path.append(str(_CHECKOUT))
    if not _exists(f"tests.bench.{name}.suite"):
        raise RunError(f"bench {name}: suites are part of the source checkout; run make install-bench and bench there")
    try:
        function: Suite = import_module(f"tests.bench.{name}.suite").run_suite
    except ModuleNotFoundError as error:
        raise _missing(name, error) from error
    return function


def _missing(name: str, error: ModuleNotFoundError) -> Exception:
    """A RunError for a missing third-party package; `error` itself for a missing module of this project (a bug)."""
    package = (error.name or "").split(".")[0]
    if package in OWN_PACKAGES:
        return error
    return RunError(f"bench {name} needs {package}, which is not installed: make install-bench installs it")


def _exists(module: str) -> bool:
    """Whether the module can be found; an installed package has no benchmarks."""
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
