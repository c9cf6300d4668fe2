"""Runs the command line as an installation of the client alone would: `python -m tests.client.thin_client WORDS...`.

`--each JSON`, a list of lists of words, runs one after the other and prints what each gave: JSON of [status, standard
output, standard error]. Packages that requirements-client.lock does not list cannot be imported. (OpenCV's larger build
stands for the smaller.)
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from importlib.metadata import packages_distributions
from io import StringIO
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
OWN = {"client", "protocol", "server", "tests", "cv2"}


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def left_out() -> set[str]:
    """Names of importable packages that are installed here and that the client's lock does not list."""
    lock = (ROOT / "requirements-client.lock").read_text(encoding="utf-8")
    listed = {_plain(name) for name in re.findall(r"^([\w.-]+)==", lock, re.MULTILINE)}
    installed = packages_distributions()
    return {name for name, of in installed.items() if not listed & set(map(_plain, of))} - OWN - sys.stdlib_module_names


class Without:
    """The finders of Python's import, which find none of these packages, as if they were not installed."""

    def __init__(self, names: set[str], finders: list[Any]) -> None:
        self._names, self._finders = names, finders

    def find_spec(self, name: str, *where: Any) -> Any:
        """As `importlib.abc.MetaPathFinder.find_spec`."""
        if name.partition(".")[0] in self._names:
            return None
        found = (finder.find_spec(name, *where) for finder in self._finders)
        return next((spec for spec in found if spec is not None), None)


def run_each(run_command: Callable[[list[str]], int], commands: list[list[str]]) -> list[tuple[int, str, str]]:
    """Status, standard output and standard error of each command."""
    results = []
    for words in commands:
        with redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as error:
            status = run_command(words)
        results.append((status, out.getvalue(), error.getvalue()))
    return results


if __name__ == "__main__":
    sys.meta_path[:] = [Without(left_out(), list(sys.meta_path))]
    from client.cli import run_command

    if sys.argv[1] == "--each":
        sys.stdout.write(json.dumps(run_each(run_command, json.loads(sys.argv[2]))))
    else:
        sys.exit(run_command(sys.argv[1:]))
