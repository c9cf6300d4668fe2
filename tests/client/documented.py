"""Commands that the documentation shows: the lines of its fenced `sh` blocks, and code in its sentences."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import typer

from client.cli import app
from tests.data import ROOT

GROUP: Any = typer.main.get_command(app)
_FENCE = re.compile(r"^```sh\n(.*?)^```", re.MULTILINE | re.DOTALL)
_CODE = re.compile(r"`([^`]+)`")
_BLOCK = re.compile(r"^```.*?^```|^ {4}.*?$", re.MULTILINE | re.DOTALL)
_ASSIGNMENT = re.compile(r"[A-Z_]+=\S*$")


@dataclass(frozen=True)
class Command:
    """One command of a page, split into words; comments and variables before it are left out."""

    page: str
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.page}: {' '.join(self.words)}"

    @property
    def program(self) -> str:
        """Name of the program without its folder."""
        return self.words[0].rpartition("/")[2]


def pages() -> Iterator[tuple[str, str]]:
    """(name, text) of every page."""
    named = ["README.md", "CONTRIBUTING.md", "SECURITY.md", "protocol/README.md", "docker/README.md"]
    for path in [*(ROOT / name for name in named), *sorted((ROOT / "docs").rglob("*.md"))]:
        yield str(path.relative_to(ROOT)), path.read_text(encoding="utf-8")


def commands() -> list[Command]:
    """All commands in fenced blocks, and the examples of the help."""
    found = [
        Command(page, words)
        for page, text in pages()
        for block in _FENCE.findall(text)
        for line in block.replace("\\\n", " ").splitlines()
        if (words := _words(line))
    ]
    for name, command in GROUP.commands.items():
        found += [Command(f"{name} --help", tuple(line.split())) for line in (command.epilog or "").splitlines()]
    return found


def code_in_sentences() -> Iterator[tuple[str, str]]:
    """(page, code) of what stands between backquotes outside of blocks."""
    for page, text in pages():
        for paragraph in re.split(r"\n\s*\n", _BLOCK.sub("", text)):
            for code in _CODE.findall(paragraph):
                if code.strip():
                    yield page, " ".join(code.split())


def _words(line: str) -> tuple[str, ...]:
    line = line.replace("$(openssl rand -hex 24)", "SECRET")
    words = shlex.split(line, comments=True)
    while words and _ASSIGNMENT.match(words[0]):
        words = words[1:]
    return tuple(words)
