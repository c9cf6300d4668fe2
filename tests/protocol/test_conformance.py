"""The conformance kit finds nothing wrong with our server and clients, and finds what is wrong with others."""

from __future__ import annotations

import asyncio
import contextlib
import subprocess
import sys
import threading
from collections.abc import Iterator

import msgpack
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from client.streaming.client import Answer, StreamClient
from protocol.conformance.play_client import CHECKS, check_server
from protocol.conformance.play_server import RULES, ConformanceServer
from protocol.conformance.scene import frame, hello
from protocol.frames import CameraModel, RgbdFrame
from protocol.limits import SUBPROTOCOL
from protocol.wire_page import PAGE
from server.service.edge.authenticator import Authenticator
from server.service.serve import BackgroundServer
from server.service.service import Service
from tests.data import ROOT
from tests.servers import fake_server
from tests.service.fakes import Lab

PATIENCE_S = 60.0


@pytest.fixture
def kit() -> Iterator[ConformanceServer]:
    server = ConformanceServer()
    threading.Thread(target=server.run, daemon=True).start()
    yield server
    server.stop()


def _failures(kit: ConformanceServer) -> list[str]:
    return [str(line) for line in kit.wait_for(0, PATIENCE_S).lines() if line.failure is not None]


def test_our_server_keeps_every_rule(device) -> None:
    with BackgroundServer(Service(device)) as server:
        lines = list(check_server(server.url))
    assert [str(line) for line in lines if line.failure is not None] == []
    assert len(lines) == len(CHECKS)


def test_a_server_that_breaks_rules_is_found(kit) -> None:
    broken = {
        line.rule for line in check_server(f"http://127.0.0.1:{kit.port}", patience_s=1.0) if line.failure is not None
    }
    assert any("4410" in rule for rule in broken)  # it resumes whatever it is asked to
    assert any("1003" in rule for rule in broken)
    assert any("second hello" in rule for rule in broken)
    assert not any("subprotocol" in rule for rule in broken)


def test_every_rule_names_a_heading_of_the_page() -> None:
    headings = {line.lstrip("# ") for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("##")}
    assert {section for _, section, _ in CHECKS} | {section for _, section in RULES.values()} <= headings


def test_our_python_client_keeps_every_rule(kit) -> None:
    camera = CameraModel(width=48, height=32, fx=40.0, fy=41.0, cx=23.5, cy=15.5)

    async def talk() -> list[object]:
        client = await StreamClient.connect(f"http://127.0.0.1:{kit.port}")
        await client.hello(camera)
        answers: list[object] = []

        async def send() -> None:
            for number in range(12):
                await client.wait_for_room()
                color, depth = np.full((32, 48, 3), 90, np.uint8), np.full((32, 48), 1500, np.uint16)
                await client.send_frame(RgbdFrame(number, number / 30, color, depth, np.eye(4)))
            await client.wait_until_answered()
            await client.close()

        sending = asyncio.create_task(send())
        async for answer in client.answers():
            answers.append(answer)
        await sending
        return answers

    answers = asyncio.run(asyncio.wait_for(talk(), PATIENCE_S))
    assert sum(isinstance(answer, Answer) for answer in answers) == 10
    assert len(answers) == 12  # two were dropped, as a busy server does
    assert _failures(kit) == []
    assert kit.sessions[0].counts["frame"] == 12


def _dial(kit: ConformanceServer):
    url = f"ws://127.0.0.1:{kit.port}/v1/stream"
    return connect(url, subprotocols=[SUBPROTOCOL], compression=None, proxy=None)


@pytest.mark.parametrize(
    ("messages", "rule"),
    [
        ([frame(0)], "hello or watch first"),
        ([hello(), hello()], "hello or watch first, and once"),
        ([hello(), {"type": "frame"}], "valid by the definitions"),
        ([hello(), frame(1), frame(0)], "numbers its frames upwards"),
        ([hello(), frame(0, color={"width": 8, "height": 8, "codec": "raw", "data": b""})], "camera's size"),
        ([hello(), *(frame(number) for number in range(40))], "max_inflight"),
        ([hello(), frame(0, world_from_camera=None)], "gives poses"),
    ],
)
def test_a_client_that_breaks_a_rule_is_found(kit, messages, rule: str) -> None:
    with _dial(kit) as socket:
        for message in messages:
            socket.send(msgpack.packb(message))
        with contextlib.suppress(ConnectionClosed):  # the kit closes after an invalid message
            socket.send(msgpack.packb({"type": "bye"}))
        with contextlib.suppress(ConnectionClosed):
            while socket.recv(timeout=PATIENCE_S):
                pass
    assert rule in " ".join(_failures(kit))


def test_a_missing_token_is_refused() -> None:
    with fake_server(Lab().build, authenticator=Authenticator("secret")) as server:
        ran = subprocess.run(
            [sys.executable, "-m", "protocol.conformance", server.url, "--token", "secret", "--patience", "5"],
            capture_output=True, text=True, check=False, timeout=PATIENCE_S, cwd=ROOT,
        )  # fmt: skip
    assert "pass  a socket without the token is refused with 4401 [README.md, Transport]" in ran.stdout, ran.stderr


def test_the_kit_does_not_load_the_server() -> None:
    code = (
        "import sys, protocol.conformance.__main__; print([n for n in sys.modules if n.startswith(('server', 'cv2'))])"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert ran.stdout.strip() == "[]"
