"""What a server tells of the ways to it: addresses, token, certificate, a code that a phone reads."""

from __future__ import annotations

import socket
from pathlib import Path

import cv2
import numpy as np
import pytest

from server.service import ways_in
from server.service.edge.authenticator import Authenticator
from server.service.edge.tls import own_certificate
from server.service.monitoring.qr_code import BLACK_ON_WHITE, BLOCKS, END, terminal_code
from server.service.ways_in import WaysIn

THERE = "192.168.77.5"


@pytest.fixture
def listener(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(ways_in, "reachable_host", lambda: THERE)
    with socket.create_server(("0.0.0.0", 0)) as listener:
        yield listener


def read_code(lines: list[str]) -> str:
    """What OpenCV's reader finds in the drawing."""
    modules = {block: dark for dark, block in BLOCKS.items()}
    rows: list[list[bool]] = []
    for line in lines:
        pairs = [modules[block] for block in line.removeprefix(BLACK_ON_WHITE).removesuffix(END)]
        rows += [[upper for upper, _ in pairs], [lower for _, lower in pairs]]
    picture = np.where(np.array(rows), 0, 255).astype(np.uint8)
    large = cv2.resize(picture, None, fx=8, fy=8, interpolation=cv2.INTER_NEAREST)
    return cv2.QRCodeDetectorAruco().detectAndDecode(large)[0]  # the older reader misses one code in 400


@pytest.mark.parametrize("text", ["http://10.0.0.5:8080/", f"https://{THERE}:8080/?token=" + "aB3-_" * 9])
def test_a_reader_finds_in_the_code_what_was_put_in(text: str) -> None:
    lines = terminal_code(text)
    assert len({len(line) for line in lines}) == 1
    assert read_code(lines) == text


def test_other_machines_are_told_an_address_that_is_theirs_to_open(listener: socket.socket, tmp_path: Path) -> None:
    certificate, port = own_certificate(tmp_path), listener.getsockname()[1]
    ways = WaysIn(listener, Authenticator("a-token"), certificate, is_key_left=True, shows_token=True)
    lines = ways.lines()
    assert lines[0].startswith(f"ready: open https://localhost:{port}/?token=a-token or run")
    assert lines[1] == f"from other machines: open https://{THERE}:{port}/?token=a-token"
    assert lines[2].endswith(f"https://{THERE}:{port}/?token=a-token --tls-fingerprint {certificate.fingerprint}")
    assert f"open https://{THERE}:{port}/ca.crt there once" in lines[-1]
    assert len(lines) == 5
    assert read_code(ways.code()[1:]) == f"https://{THERE}:{port}/?token=a-token"


def test_no_code_and_no_other_address_where_no_other_machine_reaches_it() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        ways = WaysIn(listener, Authenticator("a-token"), None, is_key_left=True, shows_token=True)
        assert len(ways.lines()) == 1
        assert ways.code() == []


def test_without_tls_it_is_said_that_cameras_of_others_need_it(listener: socket.socket) -> None:
    lines = WaysIn(listener, Authenticator("a-token"), None, is_key_left=True, shows_token=True).lines()
    assert lines[1].startswith(f"from other machines: open http://{THERE}:")
    assert lines[-1].endswith("add --tls")
    assert not any("SHA-256" in line for line in lines)


def test_a_token_that_is_not_shown_is_in_no_line_and_no_code(listener: socket.socket) -> None:
    ways = WaysIn(listener, Authenticator("a-token"), None, is_key_left=True, shows_token=False)
    assert not any("a-token" in line for line in ways.lines())
    assert ways.code() == []
