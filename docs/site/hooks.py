"""Hooks of mkdocs: pages that are kept outside of docs, and pages that are generated from the program."""

from __future__ import annotations

import posixpath
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

from command_line_page import command_line_page  # noqa: E402
from message_pages import message_page, message_schema  # noqa: E402

KEPT_ELSEWHERE = {
    "README.md": "index.md",
    "protocol/README.md": "wire.md",
    "docker/README.md": "docker.md",
    "client/web/README.md": "npm.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changes.md",
    "SECURITY.md": "security.md",
    "CITATION.cff": "CITATION.cff",
}
"""File of the repository -> its place in the site."""
KEPT_ELSEWHERE |= {
    f"protocol/{path.name}": f"wire_{path.name}" for path in ROOT.glob("protocol/*.md") if path.name != "README.md"
}
GENERATED = {
    "reference/cli.md": command_line_page,
    "reference/messages.md": message_page,
    "reference/messages.schema.json": message_schema,
}
_SOURCES = {page: source for source, page in KEPT_ELSEWHERE.items()}
_NESTED = re.compile(r"^ {2,3}(?=- )", re.MULTILINE)
"""Lists in lists; Python's Markdown wants four spaces before them."""
_LINK = re.compile(r"\[([^\]]*)\]\((?!\w+:|#|/)([^)\s#]+)(#[^)\s]*)?\)")


def on_config(config: Any) -> Any:
    """The menu, with pages that it does not name under "More"."""
    named = set(re.findall(r"[\w./-]+\.md", str(config.nav)))
    pages = [str(path.relative_to(ROOT / "docs")) for path in sorted((ROOT / "docs").rglob("*.md"))]
    pages += [page for page in KEPT_ELSEWHERE.values() if page.endswith(".md")]
    if rest := [page for page in pages if page not in named]:
        config.nav.append({"More": rest})
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the pages."""
    for source, page in KEPT_ELSEWHERE.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8")))
    for page, write in GENERATED.items():
        files.append(File.generated(config, page, content=write()))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """The page with links between files of the repository as links between pages of the site."""
    uri = page.file.src_uri
    source = _SOURCES.get(uri, f"docs/{uri}")
    return _LINK.sub(lambda link: _link(link, source, uri), _NESTED.sub("    ", markdown))


def _link(link: re.Match[str], source: str, uri: str) -> str:
    """A link as it is in the site; its text alone where it leads to a file that the site does not have."""
    text, target, anchor = link[1], link[2], link[3] or ""
    place = _in_site(target, source, uri)
    return text if place is None else f"[{text}]({place}{anchor})"


def _in_site(target: str, source: str, uri: str) -> str | None:
    path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
    if path not in KEPT_ELSEWHERE and not path.startswith("docs/") and (ROOT / path).exists():
        return None
    place = KEPT_ELSEWHERE.get(path, path.removeprefix("docs/"))
    return posixpath.relpath(place, posixpath.dirname(uri) or ".")
