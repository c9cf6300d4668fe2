"""Who may import whom. Every import counts: inside functions and for type checkers only, too."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("protocol", "server", "client", "tests")
WEB_SOURCES = ROOT / "client" / "web" / "src"

# The path of a relative import in TypeScript: `... from "./name"`, `import "./name"`, `import("./name")`.
TYPESCRIPT_IMPORT = re.compile(r"""(?:\bfrom|\bimport)\s*\(?\s*["'](\.{1,2}/[^"']+)["']""")

Graph = dict[str, set[str]]


def module_of(path: Path, root: Path) -> str:
    """The dotted name of a Python file; a package's is that of its folder."""
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_names(tree: ast.AST, package: str) -> Iterator[str]:
    """Dotted names that a file of `package` imports; of `from a import b` first a.b, which may be a module, then a."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*above, base] if base else above)
            yield from (f"{base}.{alias.name}" for alias in node.names)


def nearest_module(name: str, modules: set[str]) -> str | None:
    """The longest leading part of a dotted name that is a module."""
    while name and name not in modules:
        name = name.rpartition(".")[0]
    return name or None


def import_graph(root: Path, packages: tuple[str, ...]) -> Graph:
    """The modules that each module of these packages imports directly."""
    files = {module_of(path, root): path for package in packages for path in (root / package).rglob("*.py")}
    graph: Graph = {}
    for module, path in files.items():
        package = module if path.name == "__init__.py" else module.rpartition(".")[0]
        names = imported_names(ast.parse(path.read_text(encoding="utf-8")), package)
        graph[module] = {found for name in names if (found := nearest_module(name, set(files)))} - {module}
    return graph


def typescript_graph(folder: Path) -> Graph:
    """The same of TypeScript files, named by their path below `folder` without the suffix."""
    graph: Graph = {}
    for path in folder.rglob("*.ts"):
        targets = {
            (path.parent / name).resolve() for name in TYPESCRIPT_IMPORT.findall(path.read_text(encoding="utf-8"))
        }
        files = {target.with_suffix("") if target.suffix in (".js", ".ts") else target for target in targets}
        graph[str(path.relative_to(folder).with_suffix(""))] = {
            str(file.relative_to(folder.resolve())) for file in files if file.with_suffix(".ts").exists()
        }
    return graph


def folded(graph: Graph, fold: Callable[[str], str]) -> Graph:
    """The graph with its nodes merged by `fold`; edges inside a merged node are dropped."""
    merged: Graph = {}
    for node, targets in graph.items():
        merged.setdefault(fold(node), set()).update(fold(target) for target in targets)
    return {node: targets - {node} for node, targets in merged.items()}


def cycle_of(graph: Graph) -> list[str] | None:
    """One cycle of the graph as a list of nodes that begins and ends with the same, or None."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return None


def folder_of_package(module: str) -> str:
    """The folder directly below the package, such as server.volume; a file at the top of the package is its own."""
    parts = module.split(".")
    return ".".join(parts[:2])


@cache
def project() -> Graph:
    """The import graph of the checkout, read once."""
    return import_graph(ROOT, PACKAGES)


def test_no_file_imports_itself_through_others() -> None:
    assert cycle_of(project()) is None


@pytest.mark.parametrize("package", ["server", "client"])
def test_the_folders_of_a_package_form_no_cycle(package: str) -> None:
    modules = {module for module in project() if module.startswith(f"{package}.")}
    inside = {module: project()[module] & modules for module in modules}
    assert cycle_of(folded(inside, folder_of_package)) is None


@pytest.mark.parametrize(
    ("package", "forbidden"),
    [("protocol", {"server", "client", "tests"}), ("server", {"client", "tests"}), ("client", {"tests"})],
)
def test_a_package_imports_only_from_below(package: str, forbidden: set[str]) -> None:
    wrong = {
        f"{module} -> {target}"
        for module, targets in project().items()
        if module.split(".")[0] == package
        for target in targets
        if target.split(".")[0] in forbidden
    }
    assert wrong == set()


def test_no_file_of_the_page_imports_itself_through_others() -> None:
    graph = typescript_graph(WEB_SOURCES)
    assert any(graph.values())
    assert cycle_of(graph) is None


def test_every_kind_of_import_counts(tmp_path: Path) -> None:
    package = tmp_path / "package"
    package.mkdir()
    for name, text in {
        "__init__": "",
        "at_top": "from package import in_function",
        "in_function": "def f() -> None:\n    from .for_types import X",
        "for_types": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import package.at_top",
    }.items():
        (package / f"{name}.py").write_text(text)
    cycle = cycle_of(import_graph(tmp_path, ("package",)))
    assert cycle is not None
    assert set(cycle) == {"package.at_top", "package.in_function", "package.for_types"}
