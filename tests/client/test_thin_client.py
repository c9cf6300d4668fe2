"""An installation of the client alone (`make install-client`) streams, records and shows, and says what it lacks."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2

from client.sources.recording import open_recording
from server.opencl.device import Device
from server.scene.vase import vase_glb
from server.service.serve import BackgroundServer
from server.service.service import Service
from tests.client.thin_client import left_out
from tests.data import ROOT

SCENE = "synthetic:table?size=160x120&frames=3"


def thin(*words: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    """The command line in a process that has the client's packages only."""
    command = [sys.executable, "-m", "tests.client.thin_client", *map(str, words)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300, check=False)


def test_the_packages_of_the_server_are_left_out() -> None:
    assert {"pyopencl", "scipy", "trimesh", "fastapi", "starlette", "uvicorn", "cryptography"} <= left_out()
    assert not {"numpy", "msgspec", "websockets", "typer"} & left_out()


def test_its_requirements_are_the_programs() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    group = {line.replace("opencv-python", "opencv-contrib-python") for line in project["dependency-groups"]["client"]}
    assert group <= {*project["project"]["dependencies"], *project["project"]["optional-dependencies"]["build"]}


def test_it_streams_records_and_shows(device: Device, tmp_path: Path) -> None:
    (tmp_path / "vase.glb").write_bytes(vase_glb())
    with BackgroundServer(Service(device)) as server:
        words = ("stream", SCENE, "--server", server.url, "--out", "out", "--record", "session.probeless", "--view")
        done = thin(*words, "--object", "vase.glb@0.1,0,0.12", "--mesh", "--panorama-out", "sky.hdr", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "3 frames answered" in done.stdout
    lines = (tmp_path / "out" / "light.jsonl").read_text().splitlines()
    assert [json.loads(line)["frame"] for line in lines] == [0, 1, 2]
    assert cv2.imread(str(tmp_path / "out" / "frames" / "000002.png")).shape == (120, 160, 3)
    assert (tmp_path / "out" / "mesh.ply").stat().st_size > 1000
    assert "<html" in (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert len(open_recording(tmp_path / "session.probeless")) == 3


def test_what_it_cannot_do_ends_with_one_line(tmp_path: Path) -> None:
    commands = [["run", SCENE, "--out", "out"], ["serve"], ["demo"], ["devices"], ["tune"], ["explain", SCENE]]
    done = thin("--each", json.dumps(commands), cwd=tmp_path)
    results = json.loads(done.stdout)
    assert len(results) == len(commands)
    for words, (status, out, error) in zip(commands, results, strict=True):
        assert (status, out) == (1, ""), words
        assert error.count("\n") == 1, error
        assert "an installation of the client alone leaves out: make install" in error
    assert done.stderr == ""
