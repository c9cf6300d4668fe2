"""The command line as a user meets it: exit status, and one line for every error.

Most of it runs in this process; what concerns signals, the installed program or a whole run has a process of its own.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from typer.main import get_command

from client.cli import app, main, run_command
from server.light.panorama import read_panorama
from tests.client import folders
from tests.client.results_page import data_of
from tests.data import ROOT

PROGRAM = Path(sys.executable).with_name("probeless")
TABLE = "synthetic:table?size=160x120&frames=4"


Done = subprocess.CompletedProcess[str]
Probeless = Callable[..., Done]


def probeless_process(*words: object, timeout_s: float = 300) -> Done:
    """The installed program in a process of its own."""
    command = [PROGRAM, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False, cwd=ROOT)


@pytest.fixture
def probeless(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Probeless:
    """The program in this process, in a terminal 200 columns wide."""
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("COLUMNS", "200")

    def run(*words: object) -> Done:
        arguments = [str(word) for word in words]
        monkeypatch.setattr(sys, "argv", ["probeless", *arguments])
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main()
        assert isinstance(ended.value.code, int)
        return Done(arguments, ended.value.code, *capsys.readouterr())

    return run


def assert_one_line(done: Done, status: int, words: str) -> None:
    assert done.returncode == status, done.stderr
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1, done.stderr
    assert words in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("words", "error"),
    [
        ([], "Missing command"),
        (["fly"], "No such command"),
        (["run"], "SOURCE"),
        (["run", TABLE], "--out"),
        (["run", TABLE, "--out", "{tmp}", "--rays", "3"], "--rays"),
        (["run", TABLE, "--out", "{tmp}", "--bands", "9"], "--bands"),
        (["run", TABLE, "--out", "{tmp}", "--wrong"], "--wrong"),
        (["run", TABLE, "--out", "{tmp}", "--frames", "0:9"], "0:4"),
        (["run", TABLE, "--out", "{tmp}", "--preset", "auto", "--rays", "9"], "leave one out"),
        (["run", TABLE, "--out", "{tmp}", "--light-at", "1,2"], "expected x,y,z"),
        (["run", TABLE, "--out", "{tmp}", "--panorama-out", "sky.png"], "expected FILE.hdr or FILE.exr"),
        (["stream", TABLE], "--server"),
        (["stream", TABLE, "--server", "localhost:1", "--device", "x"], "probeless serve --device"),
        (["stream", TABLE, "--server", "http://127.0.0.1:9", "--mesh"], "say where with --out"),
        (["serve", "--token", "a b"], "without spaces"),
        (["serve", "--token", "none", "--host", "0.0.0.0"], "--insecure"),
        (["serve", "--insecure"], "goes with --token none"),
        (["serve", "--tls-cert", "x"], "go together"),
        (["serve", "--allow-origin", "x"], "expected https://HOST"),
        (["serve", "--volume-memory", "1"], "expected MiB"),
        (["serve", "--port", "70000"], "--port"),
        (["bench", "nothing"], "nothing"),
    ],
)
def test_wrong_use_ends_with_2(words: list[str], error: str, tmp_path: Path, probeless: Probeless) -> None:
    assert_one_line(probeless(*(word.format(tmp=tmp_path) for word in words)), 2, error)


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["run", "/nowhere/at/all", "--out", "{tmp}"], "no such folder or file"),
        (["run", "{tmp}", "--out", "{tmp}/out"], "looked for"),
        (["run", "oak", "--out", "{tmp}"], "OAK"),
        (["run", "synthetic:moon", "--out", "{tmp}"], "synthetic:table"),
        (["run", TABLE, "--out", "{tmp}", "--object", "{tmp}/none.glb@0,0,0"], "no such file"),
        (["run", TABLE, "--out", "{tmp}", "--object", "pyproject.toml@0,0,0"], "not a mesh"),
        (["run", TABLE, "--out", "{tmp}", "--device", "no such device"], "no OpenCL device is called"),
        (["run", TABLE, "--out", "/proc/probeless"], "cannot be written"),
    ],
)
def test_what_cannot_be_done_ends_with_1(words: list[str], error: str, tmp_path: Path, probeless: Probeless) -> None:
    assert_one_line(probeless(*(word.format(tmp=tmp_path) for word in words)), 1, error)


def test_the_installed_program_ends_so_too(tmp_path: Path) -> None:
    """`serve` ends its process itself, whatever threads are left, so it has one of its own here; `run` below."""
    assert_one_line(
        probeless_process("serve", "--device", "no such device", "--port", "0"), 1, "no OpenCL device is called"
    )
    certificate = tmp_path / "none.pem"
    assert_one_line(probeless_process("serve", "--tls-cert", certificate, "--tls-key", certificate), 1, "none.pem")


def test_truncated_picture_in_the_middle_of_a_run(tmp_path: Path, probeless: Probeless) -> None:
    folder = folders.ground_truth(tmp_path / "set", count=4)
    file = folder / "color" / "000002.png"
    file.write_bytes(file.read_bytes()[:100])
    done = probeless("run", folder, "--out", tmp_path / "out", "--volume", "-2,-2,0,2,2,2", "--voxel", "0.05")
    assert_one_line(done, 1, "000002.png")
    lines = (tmp_path / "out" / "light.jsonl").read_text().splitlines()
    assert [json.loads(line)["frame"] for line in lines] == [0, 1]


def test_mesh_is_written_and_an_empty_one_told(tmp_path: Path, probeless: Probeless) -> None:
    volume = ["--volume", "-0.7,-0.1,-0.5,0.7,0.4,0.5", "--voxel", "0.02", "--mesh", "--out"]
    done = probeless("run", TABLE, "--frames", "0:2", *volume, tmp_path)
    assert done.returncode == 0, done.stderr
    meshes = [trimesh.load(tmp_path / f"mesh.{kind}", force="mesh", process=False) for kind in ("ply", "glb")]
    np.testing.assert_allclose(meshes[0].extents, [1.2, 0.25, 0.8], atol=0.1)  # the table and its things
    np.testing.assert_allclose(meshes[1].extents[1], meshes[0].extents[1], atol=1e-6)  # turned about up only
    volume[1] = "5,5,5,6,6,6"
    done = probeless("run", TABLE, "--frames", "0:2", "--overwrite", *volume, tmp_path)
    assert done.returncode == 1
    noted, told = done.stderr.splitlines()
    assert "no usable surface has been seen yet" in noted
    assert "there is no surface to mesh" in told
    assert "there is no surface to mesh" in data_of(tmp_path)["ended"]


def test_objects_are_placed_and_what_nobody_sees_is_named(tmp_path: Path, probeless: Probeless) -> None:
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "cube.obj")
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "far.obj")
    objects = ["--object", tmp_path / "cube.obj@auto", "--object", tmp_path / "far.obj@0,0,50,0.3m"]
    done = probeless("run", TABLE, "--frames", "0:2", "--voxel", "0.02", *objects, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    placed, outside, unseen = (line for line in done.stderr.splitlines() if "obj" in line)
    assert "object 'object-0' stands at" in placed
    assert "0.10 m high (scale 1: its own size)" in placed
    assert "object 'object-1' is at 0.00,0.15,50.00, outside of the scanned volume" in outside
    assert "far.obj was never in view: its middle is at 0.00,0.15,50.00" in unseen
    wrong = probeless("run", TABLE, "--object", tmp_path / "cube.obj@pixel:500,3", "--overwrite", "--out", tmp_path)
    assert_one_line(wrong, 1, "pixel 500,3 is beyond the picture of 160x120 pixels")


def test_debug_shows_the_traceback_wherever_it_stands(probeless: Probeless) -> None:
    for words in (["--debug", "run", "/nowhere", "--out", "x"], ["run", "/nowhere", "--out", "x", "--debug"]):
        done = probeless(*words)
        assert done.returncode == 1
        assert "Traceback" in done.stderr


def test_stream_without_a_server(probeless: Probeless) -> None:
    done = probeless("stream", TABLE, "--server", "http://127.0.0.1:9")
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "no server at http://127.0.0.1:9" in done.stderr.splitlines()[-1]


def test_help_names_every_command_and_option(probeless: Probeless) -> None:
    general = probeless("--help").stdout
    for command in ("run", "stream", "model", "serve", "demo", "devices", "bench"):
        assert command in general
    shared = (
        "--frames --poses --volume --voxel --preset --rays --ray-length --bands --albedo --indirect --as-thesis "
        "--object --up --light --panorama --lamps --exposure --mesh --budget-ms --max-light-error --out"
    )
    for command in ("run", "stream"):
        text = probeless(command, "--help-all").stdout
        assert [option for option in shared.split() if option not in text] == []


@pytest.mark.parametrize("command", ["run", "stream", "explain", "serve"])
def test_help_shows_on_one_page_what_people_need_first(probeless: Probeless, command: str) -> None:
    text, everything = probeless(command, "--help").stdout, probeless(command, "--help-all").stdout
    assert len(text.splitlines()) <= 60
    assert f"probeless {command} --help-all shows every option" in text
    assert "Examples:" in text
    assert "Others:" not in everything, "each option has a group"
    options = get_command(app).commands[command].params  # type: ignore[attr-defined]
    names = [option.opts[-1] for option in options if option.param_type_name == "option" and option.name != "help"]
    assert [name for name in names if f"  {name}" not in everything.replace(" / ", "  ")] == []
    assert len(everything.splitlines()) > len(text.splitlines())


@pytest.mark.parametrize("command", ["run", "stream"])
def test_examples_of_the_help_are_command_lines(command: str) -> None:
    """Each can be parsed: names of folders and files are not looked at."""
    parser = get_command(app).commands[command]  # type: ignore[attr-defined]
    for line in parser.epilog.splitlines():
        words = line.split()
        assert words[:2] == ["probeless", command]
        parser.make_context(command, words[2:])


def test_devices_lists_the_one_that_would_be_used(probeless: Probeless) -> None:
    done = probeless("devices")
    assert done.returncode == 0
    assert "would be used" in done.stdout


def test_run_writes_what_is_promised(tmp_path: Path) -> None:
    asked = ("--light-at", "-0.1,0,0.8", "--light-at", "0,-0.2,1", "--panorama-out", f"{tmp_path}/sky.hdr@0,0,0.8")
    done = probeless_process("run", TABLE, "--frames", "1:4", "--out", tmp_path, *asked)
    assert done.returncode == 0, done.stderr
    assert "3 frames" in done.stdout
    assert "light from (" in done.stdout
    assert "place 2 (0.00, -0.20, 1.00)" in done.stdout  # its direction may be off by 29 degrees
    assert read_panorama(tmp_path / "sky.hdr").shape == (512, 1024, 3)
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == ["000001.png", "000002.png", "000003.png"]
    assert cv2.imread(str(tmp_path / "frames" / "000001.png")).shape == (120, 160, 3)
    lights = [json.loads(line) for line in (tmp_path / "light.jsonl").read_text().splitlines()]
    assert [light["frame"] for light in lights] == [1, 2, 3]
    assert all(np.isfinite(light["sh"]).all() for light in lights)
    assert [at["position"] for at in lights[-1]["at"][1:]] == [[-0.1, 0.0, 0.8], [0.0, -0.2, 1.0]]
    assert len((tmp_path / "trajectory.txt").read_text().splitlines()) == 3
    assert len((tmp_path / "timings.jsonl").read_text().splitlines()) == 3
    assert f"open {tmp_path / 'index.html'}" in done.stdout
    assert [row["frame"] for row in data_of(tmp_path)["frames"]] == [1, 2, 3]
    again = probeless_process("run", TABLE, "--frames", "1:2", "--out", tmp_path)
    assert_one_line(again, 1, "--overwrite")
    assert len(list((tmp_path / "frames").iterdir())) == 3


def test_interrupt_ends_quietly_with_130(tmp_path: Path) -> None:
    words = [PROGRAM, "run", "synthetic:table?frames=5000&size=160x120", "--voxel", "0.02", "--out", tmp_path]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    deadline = time.monotonic() + 120
    while not (tmp_path / "frames" / "000002.png").exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert out == ""
    assert "Traceback" not in err
    assert err.count("\n") == 1
    assert f"interrupted; {tmp_path / 'index.html'} shows" in err
    page = data_of(tmp_path)
    assert page["ended"] == "interrupted"
    pictures = len(list((tmp_path / "frames").iterdir()))
    assert pictures - 1 <= len(page["frames"]) <= pictures  # between a picture and its row it may end
    assert len(page["frames"]) >= 2


def test_an_error_of_the_program_itself_is_told_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("client.cli.prepare", None)
    assert run_command(["run", "x", "--out", "y"]) == 1
    error = capsys.readouterr().err
    assert error.startswith("probeless: internal error, TypeError: ")
    assert error.count("\n") == 1


def test_demo_ends_by_itself_with_pictures(tmp_path: Path) -> None:
    done = probeless_process("demo", "--out", tmp_path / "demo", timeout_s=600)
    assert done.returncode == 0, done.stderr
    first, *_, last = done.stdout.splitlines()
    assert "http://" in first
    assert str(tmp_path / "demo") in last
    pictures = sorted((tmp_path / "demo" / "frames").glob("*.png"))
    assert len(pictures) >= 10
    assert min(p.stat().st_size for p in pictures) >= 10_000
    page = data_of(tmp_path / "demo")
    assert (page["ended"], page["objects"]) == ("", ["vase.glb"])
    assert len(page["frames"]) == len(pictures) == len(list((tmp_path / "demo" / "camera").iterdir()))
