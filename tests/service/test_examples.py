"""The examples of docs/library.md, run against a server."""

import asyncio
import importlib
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import msgspec
import numpy as np
import pytest

from client.streaming.client import StreamClient
from server.maths.sh import lambert_transfer
from server.opencl.device import Device
from server.service.serve import BackgroundServer
from server.service.service import Service
from tests.data import ROOT
from tests.node import installed_modules, node
from tests.protocol.samples import SERVER
from tests.service.fakes import CAMERA, rgbd_frame

EXAMPLES = ROOT / "docs" / "examples"


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch):
    """Import an example by name, as Python does when it is run from its folder."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    names = [path.stem for path in EXAMPLES.glob("*.py")]

    def example(name: str) -> ModuleType:
        return importlib.import_module(name)

    yield example
    for name in names:
        sys.modules.pop(name, None)


def test_frames_are_streamed_and_their_light_is_used(server, load, capsys) -> None:
    lights = asyncio.run(load("stream_frames").main(server.url, 4))
    assert [light.frame for light in lights] == [0, 1, 2, 3]
    printed = capsys.readouterr().out
    assert printed.count("light from above") == 4
    assert "(120, 160, 3)" in printed


def test_the_examples_light_is_the_servers(load) -> None:
    rng = np.random.default_rng(3)
    coefficients = rng.normal(size=(16, 3))
    light = msgspec.structs.replace(SERVER["light"], sh=tuple(tuple(row) for row in coefficients.tolist()))
    normal = np.array([0.6, -0.48, 0.64])
    expected = lambert_transfer(normal[None], 3)[0] @ coefficients[:9]
    np.testing.assert_allclose(load("stream_frames").light_on(light, tuple(normal)), expected, atol=1e-4)


def test_layers_are_put_over_the_newest_picture(device: Device, load, capsys) -> None:
    with BackgroundServer(Service(device)) as server:
        pictures = asyncio.run(load("newest_picture").main(server.url, 20))
    assert len(pictures) == 20
    sign = np.abs(pictures[-1].astype(int) - 180).max(axis=-1) > 20
    assert 0.005 < sign.mean() < 0.5
    assert sign[:, :20].sum() == 0
    assert "20 of 20 pictures have the sign" in capsys.readouterr().out


def test_two_programs_share_a_room(device: Device, load, capsys) -> None:
    with BackgroundServer(Service(device)) as server:
        light = asyncio.run(load("share_a_room").main(server.url, 2))
    assert len(light.sh_webxr) == 27
    assert "27 floats" in capsys.readouterr().out


def test_javascript_gets_the_light(server, tmp_path: Path) -> None:
    program = node()
    shutil.copy(EXAMPLES / "light.mjs", tmp_path)
    (tmp_path / "node_modules").symlink_to(installed_modules())

    async def stream_for_it() -> str:
        looking = await asyncio.create_subprocess_exec(
            program,
            "light.mjs",
            server.url,
            cwd=tmp_path,
            env={**os.environ, "NODE_NO_WARNINGS": "1"},
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        client = await StreamClient.connect(server.url)
        await client.hello(CAMERA)
        said = asyncio.create_task(looking.communicate())
        for number in range(400):
            if said.done():
                break
            await client.send_frame(rgbd_frame(number))
            await asyncio.sleep(0.05)
        out, errors = await said
        await client.close()
        assert looking.returncode == 0, errors.decode()
        return out.decode()

    told = json.loads(asyncio.run(stream_for_it()))
    assert len(told["sh"]) == 27
    assert told["frame"] >= 0


WITH_THREE = """
import { LightProbe } from "three";
import { applyLight } from "./light.mjs";
const probe = new LightProbe();
applyLight(probe, { sh_webxr: Array.from({ length: 27 }, (_, i) => i), valid: true });
console.log(JSON.stringify(probe.sh.coefficients.map(({ x, y, z }) => [x, y, z])));
"""


def test_three_js_takes_the_light_as_the_example_gives_it(tmp_path: Path) -> None:
    program = node()
    shutil.copy(EXAMPLES / "light.mjs", tmp_path)
    (tmp_path / "node_modules").symlink_to(installed_modules())
    (tmp_path / "with_three.mjs").write_text(WITH_THREE)
    ran = subprocess.run([program, "with_three.mjs"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert json.loads(ran.stdout) == [[3 * i, 3 * i + 1, 3 * i + 2] for i in range(9)]


def test_the_pages_name_every_example_and_their_code_is_theirs() -> None:
    page = (ROOT / "docs" / "library.md").read_text()
    named = page + (ROOT / "docs" / "exchange.md").read_text()
    for path in EXAMPLES.iterdir():
        assert path.is_dir() or f"examples/{path.name}" in named
    code = "\n".join(path.read_text() for path in EXAMPLES.iterdir() if path.is_file())
    quoted = [
        line.strip() for block in re.findall(r"```(?:python|js)\n(.*?)```", page, re.S) for line in block.splitlines()
    ]
    strange = [line for line in quoted if line and line != "..." and line not in code]
    assert strange == []
