"""What the documentation tells people to type is understood by the program; with a synthetic scene it is run, too."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from client.cli import run_command
from client.commands import explain, run
from server.opencl.device import Device, open_device
from server.scene.vase import vase_glb
from server.service.serve import BackgroundServer
from server.service.service import Service
from tests.client.documented import GROUP, Command, code_in_sentences, commands, pages
from tests.data import ROOT

COMMANDS = commands()
OTHER_PROGRAMS = {"apt-get", "curl", "docker", "openssl"}
"""Programs that are not ours; nothing of theirs is checked."""
SCENE = "?size=160x120&frames=12"
GENERATED = {f"docs/reference/{name}" for name in ("cli.md", "messages.md", "messages.schema.json")}
"""Pages that docs/site makes when the site is built."""
STANDS_FOR = {
    "SOURCE": f"synthetic:table{SCENE}",
    "FOLDER": f"synthetic:table{SCENE}",
    "0:60": "0:2",
    "cup.obj@pixel:320,240:12,1,45": "cup.obj@pixel:80,60:1,1,45",
}
"""Words of the documentation -> what they are here: small, so that it takes a second."""
EXTRAS = {"--video": ("av", "PyAV"), "--rerun": ("rerun", "rerun-sdk")}
OPTIONS = {name for command in GROUP.commands.values() for each in command.params for name in each.opts}
OPTIONS |= {name for command in GROUP.commands.values() for each in command.params for name in each.secondary_opts}
OPTIONS |= {"--help", "--help-all", "--debug"}
OPTIONS_OF_OTHERS = {
    "--background",
    "--build-arg",
    "--count",
    "--from",
    "--group-add",
    "--large",
    "--python",
    "--seed",
    "--serve",
    "--turn",
}
"""Of other programs, that sentences name."""


def test_the_documentation_has_commands() -> None:
    programs = [command.program for command in COMMANDS]
    assert programs.count("probeless") > 40
    assert programs.count("make") > 8


def test_the_readme_is_one_page() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 80


def test_links_between_pages_lead_somewhere() -> None:
    """Without the tools that build the site. Its test follows anchors, too."""
    for page, text in pages():
        for target in re.findall(r"\]\((?!\w+:|#)([^)\s#]+)", text):
            path = ((ROOT / page).parent / target).resolve()
            assert path.exists() or str(path.relative_to(ROOT)) in GENERATED, f"{page}: {target}"


@pytest.mark.parametrize("command", [c for c in COMMANDS if c.program == "probeless"], ids=str)
def test_the_program_understands(command: Command) -> None:
    name, *words = command.words[1:]
    GROUP.commands[name].make_context(name, words)  # raises an error of usage


@pytest.mark.parametrize("command", [c for c in COMMANDS if c.program == "make"], ids=str)
def test_make_has_the_target(command: Command) -> None:
    make = shutil.which("make")
    assert make is not None
    done = subprocess.run([make, "-n", *command.words[1:]], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_other_commands_are_known() -> None:
    for command in COMMANDS:
        if command.program in {"probeless", "make", *OTHER_PROGRAMS}:
            continue
        if command.program == "sh":
            assert (ROOT / command.words[1]).is_file(), command
        else:
            assert command.words[:2] == ("python", "-m"), f"{command}: no test knows this program"
            assert find_spec(command.words[2]), command


def test_options_in_sentences_exist() -> None:
    unknown = [
        f"{page}: {code}"
        for page, code in code_in_sentences()
        for option in re.findall(r"(?<![\w-])--[a-z][a-z-]+", code)
        if option not in OPTIONS | OPTIONS_OF_OTHERS
    ]
    assert unknown == []


def test_commands_in_sentences_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):(?!=)", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    for page, code in code_in_sentences():
        program, *words = code.split()
        names = [word for word in words if re.fullmatch(r"[a-z][a-z-]+", word)]
        if program.endswith("probeless") and names and words[0] == names[0]:
            assert names[0] in GROUP.commands, f"{page}: {code}"
        if program == "make":
            assert set(names) <= targets, f"{page}: {code}"


@pytest.fixture(scope="module")
def opened() -> Device:
    """The device of all commands: each that opened its own would load all programs anew."""
    return open_device()


@pytest.fixture(scope="module")
def server(opened: Device) -> Iterator[BackgroundServer]:
    with BackgroundServer(Service(opened)) as server:
        yield server


def runs_here(command: Command) -> bool:
    """Whether a command can be run with a synthetic scene."""
    return command.program == "probeless" and (
        command.words[1] == "devices"
        or (command.words[1] in {"run", "explain", "stream"} and "oak" not in command.words)
    )


def own_words(command: Command, url: str) -> list[str]:
    """The words of a command with a small scene and the server of the test in it."""
    words = []
    left = iter(command.words[1:])
    for word in left:
        if word in {"--tls-fingerprint", "--token"}:
            next(left)  # the server of the test has neither
        elif word in {"URL", "https://HOST:8080"}:
            words.append(url)
        elif re.fullmatch(r"synthetic:\w+", word):
            words.append(word + SCENE)
        else:
            words.append(STANDS_FOR.get(word, word))
    if words[0] in {"run", "stream"} and "--frames" not in words:
        words += ["--frames", "0:2"]
    return words


@pytest.mark.parametrize("command", [c for c in COMMANDS if runs_here(c)], ids=str)
def test_it_can_be_run(
    command: Command, server: BackgroundServer, opened: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (run, explain):
        monkeypatch.setattr(module, "open_device", lambda _name: opened)
    for option, (extra, package) in EXTRAS.items():
        if option in command.words:
            pytest.importorskip(extra, reason=f"{package} is an extra: make install-all")
    for name in ("Duck", "lamp", "vase", "sofa"):
        (tmp_path / f"{name}.glb").write_bytes(vase_glb())
    trimesh.creation.cylinder(0.03, 0.1).export(tmp_path / "cup.obj")
    cv2.imwrite(str(tmp_path / "sunset.hdr"), np.full((8, 16, 3), 0.7, np.float32))
    monkeypatch.chdir(tmp_path)
    words = own_words(command, server.url)
    assert run_command(words, debug=True) == 0
    if "--out" in words:
        assert (tmp_path / words[words.index("--out") + 1] / "index.html").is_file()
