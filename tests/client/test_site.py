"""The documentation as a site, built as `make docs` builds it: no warning, and what is generated is the program's."""

from __future__ import annotations

import html
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from protocol.messages import Light
from tests.client.documented import GROUP
from tests.data import ROOT


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site. A link or an anchor that leads nowhere is an error here."""
    for module in ("mkdocs", "material", "mkdocstrings"):
        pytest.importorskip(module, reason=f"{module} is not installed (make install-docs)")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def text_of(path: Path) -> str:
    return html.unescape(re.sub(r"<[^>]+>", "", path.read_text(encoding="utf-8")))


def test_every_option_is_in_the_reference(site: Path) -> None:
    page = text_of(site / "reference" / "cli.html")
    for name, command in GROUP.commands.items():
        assert f"probeless {name}" in page
        for parameter in command.params:
            assert all(option in page for option in parameter.opts if option.startswith("--")), parameter.name
    assert "half-open range of positions in the source" in page


def test_every_field_of_the_light_is_in_the_reference(site: Path) -> None:
    page = (site / "reference" / "messages.html").read_text(encoding="utf-8")
    for field in Light.__struct_fields__:
        assert f'id="protocol.messages.Light.{field}"' in page
    schema = json.loads((site / "reference" / "messages.schema.json").read_text(encoding="utf-8"))
    assert set(Light.__struct_fields__) <= set(schema["$defs"]["Light"]["properties"])
    assert schema["$defs"]["Light"]["properties"]["type"]["enum"] == ["light"]


def test_what_is_kept_elsewhere_is_in_the_site(site: Path) -> None:
    assert "The wire protocol" in text_of(site / "wire.html")
    assert "Two commands" in text_of(site / "index.html")
    start = (site / "index.html").read_text(encoding="utf-8")
    assert 'href="wire.html"' in start
    assert (site / "CITATION.cff").read_bytes() == (ROOT / "CITATION.cff").read_bytes()


def test_no_script_or_style_is_linked_from_elsewhere(site: Path) -> None:
    start = (site / "index.html").read_text(encoding="utf-8")
    assert re.findall(r'(?:src|href)="https?://[^"]+\.(?:js|css|woff2?)"', start) == []
