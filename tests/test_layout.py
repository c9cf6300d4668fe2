"""Rules of the tests' own files: what several test files need is in a helper module, such as those of tests/scenes."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parent
FOLDERS = sorted({path.parent.relative_to(TESTS).as_posix() for path in TESTS.rglob("*.py")})


def imported(source: str) -> Iterator[str]:
    """Dotted names of all that a module imports, at its top and inside functions."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{'.' * node.level}{node.module or ''}.{alias.name}" for alias in node.names)


def from_test_files(source: str) -> list[str]:
    """What a module imports from files that pytest collects, or such a file as a whole."""
    return [name for name in imported(source) if ".test_" in name]


@pytest.mark.parametrize("folder", FOLDERS)
def test_nothing_is_imported_from_a_test_file(folder: str) -> None:
    """A helper that others need has a place of its own: who changes a test file then changes only its tests."""
    found = {path.name: from_test_files(path.read_text()) for path in (TESTS / folder).glob("*.py")}
    assert not {name: names for name, names in found.items() if names}


@pytest.mark.parametrize(
    "line",
    [
        "from tests.kernels.test_sh import AXES",
        "from tests.kernels import test_sh",
        "import tests.kernels.test_sh as sh",
        "from .test_sh import AXES",
        "def f():\n    from tests.kernels.test_sh import AXES",
    ],
)
def test_every_way_to_import_one_is_found(line: str) -> None:
    assert len(from_test_files(line)) == 1


def test_helpers_may_be_imported() -> None:
    allowed = "from tests.scenes.solids import box\nfrom server.maths import sh\nimport tests.data"
    assert from_test_files(allowed) == []


def test_only_own_kernel_turns_warnings_into_errors() -> None:
    """A test that compiles by itself fails on processors without AVX-512, for a warning that means nothing."""
    strict = [
        path.relative_to(TESTS).as_posix() for path in TESTS.rglob("*.py") if '"-W' + 'error"' in path.read_text()
    ]
    assert strict == ["scenes/own_kernel.py"]
