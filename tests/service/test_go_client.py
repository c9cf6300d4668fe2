"""docs/examples/stream.go, a client that was written from the wire page alone, where Go's compiler is."""

from __future__ import annotations

import shutil
import subprocess
import threading
from pathlib import Path

import cv2
import pytest

from protocol.conformance.play_server import ConformanceServer
from server.opencl.device import Device
from server.service.edge.authenticator import Authenticator
from server.service.serve import BackgroundServer
from server.service.service import Service
from tests.absent import NO_TOOLCHAIN
from tests.data import ROOT
from tests.servers import fake_server
from tests.service.fakes import Lab

SOURCE = ROOT / "docs" / "examples" / "stream.go"
MOST_LINES = 350
PATIENCE_S = 600.0
"""The first time, Go compiles its own library too."""


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The compiled client."""
    go = shutil.which("go")
    if go is None:
        pytest.skip(f"{NO_TOOLCHAIN}Go")
    path = tmp_path_factory.mktemp("go") / "stream"
    built = subprocess.run(
        [go, "build", "-o", str(path), str(SOURCE)], capture_output=True, text=True, check=False, timeout=PATIENCE_S
    )
    assert built.returncode == 0, built.stderr
    return path


def run(program: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(program), *arguments], capture_output=True, text=True, check=False, timeout=PATIENCE_S)


def test_it_is_short_and_needs_nothing_but_go() -> None:
    text = SOURCE.read_text()
    assert text.count("\n") <= MOST_LINES
    assert not [line for line in text.splitlines() if line.startswith('\t"') and "." in line and line.endswith('"')]


def test_it_keeps_every_rule_of_the_page(program: Path) -> None:
    kit = ConformanceServer()
    threading.Thread(target=kit.run, daemon=True).start()
    ran = run(program, f"http://127.0.0.1:{kit.port}", "12")
    assert ran.returncode == 0, ran.stderr
    session = kit.wait_for(0, PATIENCE_S)
    kit.stop()
    assert [str(line) for line in session.lines() if line.failure is not None] == []
    assert session.counts["frame"] == 12
    assert ran.stdout.count("was dropped") == 2


def test_it_gets_light_and_pictures_from_a_server(program: Path, device: Device, tmp_path: Path) -> None:
    with BackgroundServer(Service(device)) as server:
        ran = run(program, server.url, "4", str(tmp_path / "picture.jpg"))
    assert ran.returncode == 0, ran.stderr
    assert "request 1: error <nil>" in ran.stdout
    assert [f"frame {n}: light from" in ran.stdout for n in range(4)] == [True] * 4
    picture = cv2.imread(str(tmp_path / "picture.jpg"))
    assert picture is not None
    assert picture.shape == (48, 64, 3)


def test_it_says_in_one_line_why_it_was_refused(program: Path) -> None:
    with fake_server(Lab().build, authenticator=Authenticator("secret")) as server:
        wrong, right = run(program, f"{server.url}/?token=guess"), run(program, f"{server.url}/?token=secret", "2")
    assert wrong.returncode == 1
    assert wrong.stderr.startswith("stream: refused: ")
    assert wrong.stderr.count("\n") == 1
    assert right.returncode == 0, right.stderr
