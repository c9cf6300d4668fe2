"""Do the tests see small faults? Changes one operator, constant or condition at a time and runs the tests of its stem.

`python -m tests.mutation_check --seed 18 --count 30` draws changes from the kernels, server/ and protocol/, each place
as likely as any other, and applies each to a copy of the tree. The tests of its stem are the test files with the stem
in their name, and those that import the module, or, without any, that import a module that uses it. A change that they
do not see survives; `--whole` then runs `make test` on each survivor. Changes that do not compile are drawn again.
Writes out/mutations.json; `--again` judges the survivors in it once more.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import tokenize
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("server", "protocol")
OPERATORS = {
    "+": "-",
    "-": "+",
    "*": "/",
    "/": "*",
    "<": "<=",
    "<=": "<",
    ">": ">=",
    ">=": ">",
    "==": "!=",
    "!=": "==",
    "&&": "||",
    "||": "&&",
    "and": "or",
    "or": "and",
    "if": "if not",
    "min": "max",
    "max": "min",
    "fmin": "fmax",
    "fmax": "fmin",
}
KERNEL_TOKEN = re.compile(
    r"//[^\n]*|/\*.*?\*/|^\s*#[^\n]*|[A-Za-z_]\w*|\d+\.\d*(?:e[-+]?\d+)?f?|\d+|[-+*/&|<>=!]{2}|[-+*/<>]", re.M | re.S
)
POINTED_TO = re.compile(r"(?:float|int|uint|uchar|ushort|char|\w+\d)\s$")
STEM_PATIENCE_S, WHOLE_PATIENCE_S = 900, 1800
"""A run of tests that takes longer is taken to hang, which is seen."""


@dataclass(frozen=True)
class Mutation:
    """One change of a file."""

    path: str
    """From the root of the tree."""
    line: int
    start: int
    """Of the token, in characters from the beginning of the file."""
    before: str
    after: str


@dataclass(frozen=True)
class Verdict:
    """What became of a mutation."""

    mutation: Mutation
    outcome: str
    """caught | survived | caught by make test"""
    by: str
    """The first test that failed, or the files that passed."""


def mutated(token: str) -> str | None:
    """What a token is changed to; None: it is left alone."""
    if token in OPERATORS:
        return OPERATORS[token]
    if re.fullmatch(r"\d+", token):
        return str(int(token) + 1)
    if re.fullmatch(r"\d+\.\d*(?:e[-+]?\d+)?f?", token):
        value = float(token.removesuffix("f"))
        return f"{2 * value if value else 0.5!r}{'f' if token.endswith('f') else ''}"
    return None


def of_python(path: Path) -> Iterator[Mutation]:
    """Every change of a module; some leave no valid code."""
    text = path.read_text()
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    kinds = (tokenize.OP, tokenize.NUMBER, tokenize.NAME)
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        after = mutated(token.string) if token.type in kinds else None
        if after is None:
            continue
        row, column = token.start
        yield Mutation(str(path.relative_to(ROOT)), row, starts[row - 1] + column, token.string, after)


def of_kernel(path: Path) -> Iterator[Mutation]:
    """Every change of a kernel file; whether it compiles is only known once it is built."""
    text = path.read_text()
    for match in KERNEL_TOKEN.finditer(text):
        after = None if match[0] == "if" else mutated(match[0])
        is_pointer = match[0] == "*" and re.search(
            r"(?:float|int|uint|uchar|ushort|char|\w+\d)\s$", text[: match.start()]
        )
        if after is not None and not is_pointer:
            line = text.count("\n", 0, match.start()) + 1
            yield Mutation(str(path.relative_to(ROOT)), line, match.start(), match[0], after)


def applied(text: str, mutation: Mutation) -> str:
    """The file's text with the change."""
    end = mutation.start + len(mutation.before)
    assert text[mutation.start : end] == mutation.before
    return text[: mutation.start] + mutation.after + text[end:]


def all_mutations() -> list[Mutation]:
    """All that can be drawn, in a fixed order."""
    kernels = sorted((ROOT / "cl_kernels").rglob("*.cl*"))
    modules = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
    return [m for path in kernels for m in of_kernel(path)] + [m for path in modules for m in of_python(path)]


def tests_of(path: str) -> list[str]:
    """Test files with the stem in their name, then those that import the module (for a kernel its host), or without any
    those that import a module that does."""
    stems = {Path(path).stem} | (
        {kernel.stem for kernel in _users(Path(path).name)} if path.endswith(".clh") else set()
    )
    tests = sorted((ROOT / "tests").rglob("test_*.py"))
    named = [t for t in tests if any(t.stem == f"test_{s}" or t.stem.startswith(f"test_{s}_") for s in stems)]
    users = _users(Path(path).name) if path.endswith(".clh") else set()
    named += [test for test in tests if path.endswith(".clh") and Path(path).name in test.read_text()]
    modules = {_module_of(str(user.relative_to(ROOT))) for user in users} or {_module_of(path)}
    importing = _importing(modules, tests)
    sources = sorted(file for package in (*PACKAGES, "client") for file in (ROOT / package).rglob("*.py"))
    while modules and not named and not importing:
        modules = {_module_of(str(file.relative_to(ROOT))) for file in _importing(modules, sources)}
        importing = _importing(modules, tests)
    return [str(test.relative_to(ROOT)) for test in dict.fromkeys([*named, *importing])]


def _module_of(path: str) -> str:
    return path.removesuffix(".cl").removesuffix(".py").replace("/", ".").replace("cl_kernels.", "server.")


def _importing(modules: set[str], files: list[Path]) -> list[Path]:
    """Files that import one of the modules."""
    patterns = []
    for module in modules:
        package, _, name = module.rpartition(".")
        patterns.append(rf"from {re.escape(module)} import|from {re.escape(package)} import [^\n]*\b{name}\b")
    imports = re.compile("|".join(patterns)) if patterns else None
    return [file for file in files if imports and imports.search(file.read_text())]


def _users(include: str) -> set[Path]:
    """Kernel files that include a file, by way of others too."""
    direct = [f for f in (ROOT / "cl_kernels").rglob("*.cl*") if f'"{include}"' in f.read_text()]
    return {f for f in direct if f.suffix == ".cl"}.union(*(_users(f.name) for f in direct if f.suffix == ".clh"))


def judge(mutation: Mutation, tree: Path, whole: bool) -> Verdict | None:
    """Run the tests on a change; None where it does not compile."""
    file, text = tree / mutation.path, (ROOT / mutation.path).read_text()
    changed = applied(text, mutation)
    if file.suffix == ".py" and not _is_new_code(text, changed):
        return None
    file.write_text(changed)
    try:
        tests = tests_of(mutation.path)
        if tests:
            failed, said = _run([sys.executable, "-m", "pytest", "-q", "-x", *tests], tree, STEM_PATIENCE_S)
            if "KernelBuildError" in said:
                return None
            if failed:
                return Verdict(mutation, "caught", _first_failure(said))
        if whole:
            failed, said = _run(["make", "test"], tree, WHOLE_PATIENCE_S)
            if failed:
                return Verdict(mutation, "caught by make test", _first_failure(said))
        return Verdict(mutation, "survived", " ".join(tests) or "no test of its stem")
    finally:
        file.write_text(text)


def main() -> None:
    """Draw, judge, say and write."""
    options = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    options.add_argument("--seed", type=int, default=18)
    options.add_argument("--count", type=int, default=30)
    options.add_argument("--whole", action="store_true", help="run `make test` on what survives the tests of its stem")
    options.add_argument("--again", action="store_true", help="judge the survivors of the last run once more")
    asked = options.parse_args()
    found = all_mutations()
    drawn = iter(random.Random(asked.seed).sample(found, len(found)))
    if asked.again:
        last = json.loads((ROOT / "out" / "mutations.json").read_text())
        again = [Mutation(**verdict["mutation"]) for verdict in last if verdict["outcome"] == "survived"]
        drawn, asked.count = iter(again), len(again)
    verdicts: list[Verdict] = []
    with tempfile.TemporaryDirectory() as folder:
        tree = _copy_of_the_tree(Path(folder) / "tree")
        while len(verdicts) < asked.count:
            mutation = next(drawn)
            verdict = judge(mutation, tree, asked.whole)
            if verdict is not None:
                verdicts.append(verdict)
                place = f"{mutation.path}:{mutation.line}"
                change = f"{mutation.before} -> {mutation.after}"
                print(f"{len(verdicts):3} {verdict.outcome:20} {place} {change}  {verdict.by}", flush=True)
    caught = sum(verdict.outcome != "survived" for verdict in verdicts)
    print(f"{caught} of {len(verdicts)} caught ({100 * caught / len(verdicts):.0f} %), out of {len(found)} places")
    (ROOT / "out").mkdir(exist_ok=True)
    (ROOT / "out" / "mutations.json").write_text(json.dumps([asdict(verdict) for verdict in verdicts], indent=1))


def _copy_of_the_tree(tree: Path) -> Path:
    """What git tracks, with the environment of this one."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    for name in filter(None, listed.split("\0")):
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, tree / name)
    (tree / ".venv").symlink_to(ROOT / ".venv")
    return tree


def _run(command: list[str], tree: Path, patience_s: float) -> tuple[bool, str]:
    """Whether a run of tests failed or hung, and what it printed. The tree's own modules come first."""
    environment = os.environ | {"PYTHONPATH": str(tree)}
    environment.setdefault("PROBELESS_DATA", str((ROOT / "../shared/data").resolve()))
    try:
        done = subprocess.run(
            command, cwd=tree, env=environment, capture_output=True, text=True, timeout=patience_s, check=False
        )
    except subprocess.TimeoutExpired:
        return True, "hung"
    return done.returncode != 0, done.stdout + done.stderr


def _first_failure(said: str) -> str:
    found = re.search(r"^(?:FAILED|ERROR) (\S+)", said, re.M)
    return found[1] if found else said.strip()[-80:]


def _is_new_code(before: str, after: str) -> bool:
    try:
        return ast.dump(ast.parse(before)) != ast.dump(ast.parse(after))
    except SyntaxError:
        return False


if __name__ == "__main__":
    main()
