"""The npm package: packed, installed elsewhere, and used by a program in Node.js against the real service."""

from __future__ import annotations

import base64
import io
import json
import os
import shutil
import subprocess
import threading
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
from rich.console import Console

from client.commands.stream import stream
from client.options.source import open_source
from client.web.build import pack
from protocol.conformance.play_server import ConformanceServer
from protocol.messages import Wishes
from server.opencl.device import Device
from server.service.edge.authenticator import Authenticator
from server.service.serve import BackgroundServer
from server.service.service import Service
from tests.client.web.received import Received
from tests.data import ROOT
from tests.node import copy_sources, node, run_npm
from tests.service.conftest import keys_are_left_here  # noqa: F401
from tests.service.fakes import FAKE_DEVICE, Lab, fake_mesh
from tests.service.proxy import impaired

TOKEN = "a-token"
PATIENCE_S = 60

STRICT = """
import { type Answer, type Dropped, encodeDepth, type Light, StreamClient, streamUrl } from "probeless";
import { type ArrivingLight, lightOf } from "probeless";

export function litBy(light: Light): ArrivingLight | Light {
  return lightOf(light, "chair");
}

export async function first(url: string): Promise<Light | string> {
  const camera = { width: 2, height: 1, fx: 1, fy: 1, cx: 0, cy: 0 };
  const client = await StreamClient.connect(url, { client: "typed", camera, wishes: { preset: "reg8" } });
  const depth = await encodeDepth(new Uint16Array(2), 2);
  const answer: Answer | Dropped = await client.send({ timestamp_s: 0, world_from_camera: null, color: null, depth });
  const done = await client.request({ type: "remove_object", object: "chair" });
  return answer.type === "answer" ? answer.light : answer.reason + done.error + client.welcome.session;
}
"""


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the sources with their packages."""
    return copy_sources(tmp_path_factory.mktemp("web") / "sources")


@pytest.fixture(scope="module")
def program(sources: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the packed package installed, and the example in it."""
    folder = tmp_path_factory.mktemp("program")
    pack(folder, sources)
    (folder / "package.json").write_text('{"type": "module", "private": true}')
    run_npm("install", "--no-audit", "--no-fund", "--prefer-offline", str(next(folder.glob("*.tgz"))), folder=folder)
    shutil.copy(ROOT / "docs" / "examples" / "stream.mjs", folder)
    return folder


@pytest.fixture
def server(device: Device) -> Iterator[BackgroundServer]:
    with BackgroundServer(Service(device), authenticator=Authenticator(TOKEN)) as server:
        yield server


def run(program: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A program of the folder, by the Node.js of the tests."""
    environment = {**os.environ, "NODE_NO_WARNINGS": "1"}
    command = [node(), *arguments]
    return subprocess.run(
        command, cwd=program, env=environment, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )


def test_a_program_streams_frames_and_gets_the_light(server: BackgroundServer, program: Path) -> None:
    done = run(program, "stream.mjs", server.way_in, "3")
    assert done.returncode == 0, done.stderr
    lights = [json.loads(line) for line in done.stdout.splitlines()]
    assert [light["frame"] for light in lights] == [0, 1, 2]
    assert all(len(light["sh"]) == 27 for light in lights)
    assert np.isfinite(lights[-1]["sh"]).all()


BOTH = """
import { StreamClient } from "probeless";
import { readFileSync } from "node:fs";
const bytesOf = (text) => new Uint8Array(Buffer.from(text, "base64"));
const { camera, wishes, pose, color, depth } = JSON.parse(readFileSync("frame.json", "utf8"));
const client = await StreamClient.connect(process.argv[1], { client: "test", camera, wishes });
const answer = await client.send({
  timestamp_s: 0, world_from_camera: pose, exposure: 1,
  color: { codec: "raw", width: camera.width, height: camera.height, data: bytesOf(color) },
  depth: new Uint16Array(bytesOf(depth).buffer),
});
console.log(JSON.stringify(answer.light.sh));
client.close();
"""


def test_it_and_the_python_client_get_the_same_light_of_the_same_server(
    server: BackgroundServer, program: Path
) -> None:
    source = open_source("synthetic:table?size=96x72&frames=1")
    wishes = Wishes(up=source.up, voxel_m=0.02, lossless=True)
    frame = source[0]
    assert frame.exposure == 1
    given = {
        "camera": msgspec.to_builtins(source.camera),
        "wishes": {"up": source.up, "voxel_m": 0.02, "lossless": True},
        "pose": frame.world_from_camera.ravel().tolist(),
        "color": base64.b64encode(frame.color.tobytes()).decode(),
        "depth": base64.b64encode(frame.depth.astype("<u2").tobytes()).decode(),
    }
    (program / "frame.json").write_text(json.dumps(given))
    done = run(program, "--input-type=module", "--eval", BOTH, "--", server.way_in)
    assert done.returncode == 0, done.stderr
    quiet = Console(file=io.StringIO())
    ours = stream(source, server.way_in, (), wishes, lossless=True, realtime=False, console=quiet)
    assert ours.light is not None
    assert np.abs(ours.light.sh).max() > 0.01
    np.testing.assert_allclose(json.loads(done.stdout), ours.light.sh, rtol=1e-6, atol=1e-7)


def test_the_package_keeps_the_rules_of_the_wire_page(program: Path) -> None:
    kit = ConformanceServer()
    threading.Thread(target=kit.run, daemon=True).start()
    try:
        done = run(program, "stream.mjs", f"http://127.0.0.1:{kit.port}", "12")
        session = kit.wait_for(0, PATIENCE_S)
    finally:
        kit.stop()
    assert done.returncode == 0, done.stderr
    assert done.stdout.count('"sh"') == 10  # two of twelve frames are dropped, as a busy server does
    assert session.counts["frame"] == 12
    assert [str(line) for line in session.lines() if line.failure is not None] == []


def test_what_is_refused_is_told_in_one_sentence(server: BackgroundServer, program: Path) -> None:
    script = """
        import { StreamClient } from "probeless";
        const camera = { width: 160, height: 120, fx: 150, fy: 150, cx: 79.5, cy: 59.5 };
        const tell = (error) => console.log(error.message);
        await StreamClient.connect(process.argv[1], { client: "test", camera }).catch(tell);
    """
    done = run(program, "--input-type=module", "--eval", script, "--", server.url)
    assert done.stdout == (
        "the token is missing: use the URL that the server printed at its start, which ends in ?token=...\n"
    ), done.stderr
    done = run(program, "--input-type=module", "--eval", script, "--", "http://127.0.0.1:9")
    assert done.stdout.startswith("the server does not answer; see that it runs (probeless serve)"), done.stderr


def test_a_program_that_wishes_nothing_has_the_defaults(program: Path) -> None:
    script = """
        import { StreamClient } from "probeless";
        const camera = { width: 160, height: 120, fx: 150, fy: 150, cx: 79.5, cy: 59.5 };
        (await StreamClient.connect(process.argv[1], { client: "test", camera })).close();
    """
    received = Received()
    with BackgroundServer(Service(FAKE_DEVICE, pipeline_factory=received.build)) as server:
        done = run(program, "--input-type=module", "--eval", script, "--", server.url)
    assert done.returncode == 0, done.stderr
    assert received.wishes == [Wishes()]


def listened_to(folder: Path, script: str, url: str, hear: Callable[[list[str]], None]) -> list[str]:
    """Lines that a script says which is given `url`; `hear` gets all so far with each."""
    command = [node(), "--input-type=module", "--eval", script, "--", url]
    said: list[str] = []
    with subprocess.Popen(command, cwd=folder, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        timer = threading.Timer(PATIENCE_S, process.kill)
        timer.start()
        for line in process.stdout:
            said.append(line.strip())
            hear(said)
        timer.cancel()
        errors = process.stderr.read()
    assert process.returncode == 0, errors
    return said


def test_a_panorama_is_fetched_and_each_object_has_its_own_light(server: BackgroundServer, program: Path) -> None:
    """A cube on a wall 1 m ahead, in a light from everywhere: half of what it receives is the wall."""
    script = """
        import { lightOf, StreamClient } from "probeless";
        const camera = { width: 64, height: 48, fx: 50, fy: 50, cx: 31.5, cy: 23.5, depth_scale_m: 0.001 };
        const up = [0, -1, 0];
        const light = [[3.5449077018, 3.5449077018, 3.5449077018]];
        const wishes = { light, up, light_at: [[0, 0, 0.5]] };
        const client = await StreamClient.connect(process.argv[1], { client: "test", camera, wishes });
        await client.panorama("hdr").catch((error) => console.log(error.message));
        const face = ["v 0 0 0", "v 0.1 0 0", "v 0 0.1 0", "f 1 2 3"].join(String.fromCharCode(10));
        const data = new TextEncoder().encode(face);
        const placed = { type: "place_object", object: "chair", format: "obj", data, position_m: [0, 0, 0.9] };
        console.log((await client.request(placed)).error);
        const color = { width: 64, height: 48, codec: "raw", data: new Uint8Array(3 * 64 * 48).fill(120) };
        const depth = new Uint16Array(64 * 48).fill(1000);
        const world_from_camera = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
        const { light: told } = await client.send({ timestamp_s: 0, world_from_camera, color, depth });
        console.log(told.at.map((each) => `${each.of} ${each.object}`).join(", "));
        const mine = lightOf(told, "chair");
        console.log(mine === told.at[2], lightOf(told, "sofa") === told);
        const { data: file, position_m } = await client.panorama("exr", [0, 0, 0.5]);
        console.log([...file.subarray(0, 4)].join(" "), position_m.join(" "));
        client.close();
    """
    done = run(program, "--input-type=module", "--eval", script, "--", server.way_in)
    assert done.stdout.splitlines() == [
        "there is no light yet: no frame has been placed in the room",
        "null",
        "view null, place null, object chair",
        "true true",
        "118 47 49 1 0 0 0.5",
    ], done.stderr


def test_objects_are_placed_and_a_server_that_stops_ends_what_waits(program: Path) -> None:
    script = """
        import { StreamClient } from "probeless";
        const camera = { width: 48, height: 32, fx: 40, fy: 41, cx: 23.5, cy: 15.5 };
        const options = { client: "test", camera, patience_s: 1 };
        const client = await StreamClient.connect(process.argv[1], options);
        const data = new TextEncoder().encode("a mesh");
        const place = (object, data) => client.request({ type: "place_object", object, format: "obj", data });
        console.log((await place("chair", data)).error);
        console.log((await place("none", new TextEncoder().encode("no mesh"))).error);
        const color = { width: 48, height: 32, codec: "raw", data: new Uint8Array(3 * 48 * 32) };
        const depth = new Uint16Array(48 * 32).fill(1000);
        const send = () => client.send({ timestamp_s: 0, world_from_camera: null, color, depth });
        const answer = await send();
        console.log(answer.type, answer.composite.color.codec, answer.light.frame === answer.composite.frame);
        console.log("stop");
        for (;;) await send().catch((error) => { console.log(error.message); process.exit(0); });
    """
    lab = Lab()
    service = Service(FAKE_DEVICE, pipeline_factory=lab.build, mesh_loader=fake_mesh)
    with BackgroundServer(service) as server:

        def hear(said: list[str]) -> None:
            if said[-1] == "stop":
                threading.Thread(target=server.stop).start()

        said = listened_to(program, script, server.url, hear)
    placed, refused, answer, _, ended = said
    assert placed == "null"
    assert refused == "the object is no GLB: its first bytes are not glTF"
    assert answer == "answer jpeg true"
    assert ended == "the server did not answer for 1 s"
    assert lab.log[0][:3] == ("place", "chair", ("obj", b"a mesh"))


def test_a_lost_connection_is_restored_and_the_session_goes_on(program: Path) -> None:
    script = """
        import { StreamClient } from "probeless";
        const camera = { width: 48, height: 32, fx: 40, fy: 41, cx: 23.5, cy: 15.5 };
        const onNote = (text) => console.log(`note: ${text}`);
        const client = await StreamClient.connect(process.argv[1], { client: "test", camera, keep_s: 30, onNote });
        const color = { width: 48, height: 32, codec: "raw", data: new Uint8Array(3 * 48 * 32) };
        const depth = new Uint16Array(48 * 32).fill(1000);
        while (!client.welcome.resumed) {
            await client.send({ timestamp_s: 0, world_from_camera: null, color, depth });
            console.log("sent");
        }
        const answer = await client.send({ timestamp_s: 0, world_from_camera: null, color, depth });
        console.log(answer.type, client.welcome.session);
        client.close();
    """
    lab = Lab()
    service = Service(FAKE_DEVICE, pipeline_factory=lab.build, mesh_loader=fake_mesh)
    with BackgroundServer(service) as server, impaired(server.url) as proxy:

        def hear(said: list[str]) -> None:
            if said.count("sent") == 2 and said[-1] == "sent":
                proxy.cut()

        said = listened_to(program, script, proxy.url, hear)
    assert any(line.startswith("note: the connection was lost (") for line in said)
    assert said[-1] == "answer session-1"


def test_its_types_need_no_dom(program: Path, sources: Path) -> None:
    (program / "typed.ts").write_text(STRICT)
    options = {"target": "es2022", "module": "nodenext", "lib": ["es2023"], "types": [], "strict": True, "noEmit": True}
    (program / "tsconfig.json").write_text(json.dumps({"compilerOptions": options, "files": ["typed.ts"]}))
    compiler = [node(), str(sources / "node_modules" / "typescript" / "bin" / "tsc"), "-p", str(program)]
    done = subprocess.run(compiler, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (program / "typed.ts").write_text(STRICT.replace("answer.light :", "answer.lihgt :"))
    done = subprocess.run(compiler, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert "lihgt" in done.stdout


def test_it_holds_what_it_says_and_has_the_projects_version(program: Path) -> None:
    package = program / "node_modules" / "probeless"
    described = json.loads((package / "package.json").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert (described["version"], described["license"]) == (project["version"], project["license"])
    assert (package / "LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()
    names = {path.relative_to(package).as_posix() for path in package.rglob("*") if path.is_file()}
    assert {"README.md", "lib/probeless.js", "lib/types/library.d.ts"} <= names
    assert not any(name.startswith(("src", "dist", "node_modules", "test")) for name in names)
