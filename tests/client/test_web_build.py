"""The page: what is committed is what its sources build, its types check, and it reads what Python writes."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from client.web.build import FOLDER, build, npm
from protocol.codec import decode_client
from protocol.frames import CameraModel
from protocol.images import decode_depth, encode_depth
from protocol.limits import SUBPROTOCOL
from protocol.messages import DepthCodec
from tests.client.link_series import write_link_series
from tests.node import copy_sources, run_npm
from tests.protocol.golden import FOLDER as GOLDEN
from tests.protocol.golden import depth_ramp


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the page's sources with exactly the pinned packages beside them."""
    return copy_sources(tmp_path_factory.mktemp("web") / "sources")


def test_the_committed_page_is_what_its_sources_build(sources: Path, tmp_path: Path) -> None:
    build(tmp_path / "dist", sources)
    built = {path.name: path.read_bytes() for path in (tmp_path / "dist").iterdir()}
    committed = {path.name: path.read_bytes() for path in (FOLDER / "dist").iterdir()}
    assert sorted(built) == sorted(committed)
    stale = [name for name in built if built[name] != committed[name]]
    assert not stale, "stale: run `python -m client.web.build`"


def test_types_check(sources: Path) -> None:
    run_npm("run", "check", folder=sources)


def test_the_type_check_can_fail(sources: Path) -> None:
    """A `switch` that forgets a message, and a field that does not exist, are errors."""
    wrong = sources / "src" / "wrong.ts"
    wrong.write_text(
        'import type { Light, ServerMessage } from "./protocol";\n'
        "export const a = (light: Light): number => light.dominant_intensty;\n"
        "export function b(message: ServerMessage): void {\n"
        '  if (message.type !== "light") message satisfies never;\n'
        "}\n"
    )
    try:
        with pytest.raises(subprocess.CalledProcessError) as refusal:
            npm("run", "check", folder=sources)
    finally:
        wrong.unlink()
    assert "dominant_intensty" in refusal.value.stdout
    assert "TS1360" in refusal.value.stdout


def test_typescript_tests_pass_and_python_reads_what_a_browser_writes(
    sources: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = tmp_path / "frame.msgpack"
    monkeypatch.setenv("PROBELESS_GOLDEN", str(GOLDEN))
    monkeypatch.setenv("PROBELESS_BROWSER_FRAME", str(written))
    depths = tmp_path / "depths"
    depths.mkdir()
    for codec in get_args(DepthCodec):
        for rows in (7, 8):
            (depths / f"{codec}_{rows}").write_bytes(encode_depth(depth_ramp()[:rows], codec).data)
    monkeypatch.setenv("PROBELESS_PYTHON_DEPTHS", str(depths))
    assert write_link_series(tmp_path / "links.json") > 10_000
    monkeypatch.setenv("PROBELESS_LINK_SERIES", str(tmp_path / "links.json"))
    run_npm("test", folder=sources)
    frame = decode_client(written.read_bytes())
    height, width = depth_ramp().shape
    camera = CameraModel(width=width, height=height, fx=1, fy=1, cx=0, cy=0)
    assert frame.depth.codec == "zdelta"
    assert np.array_equal(decode_depth(frame.depth, camera), depth_ramp())


def test_the_page_fetches_nothing_from_elsewhere() -> None:
    for path in (FOLDER / "dist").iterdir():
        text = path.read_text(encoding="utf-8", errors="replace")  # icons and the sample are no text
        for name in ("http://www.w3.org/2000/svg", "http://www.w3.org/1999/xhtml"):  # of vocabularies, not addresses
            text = text.replace(name, "")
        assert "http://" not in text, path.name
        assert "https://" not in text, path.name
    assert any(SUBPROTOCOL in path.read_text(encoding="utf-8") for path in (FOLDER / "dist").glob("*.js"))
