"""Connections before anything is said on them: how many, and for how long."""

from __future__ import annotations

import logging
import resource
import socket
import subprocess
import sys
from collections.abc import Iterator

import httpx
import pytest

from protocol.messages import Composite
from server.service.edge.gate import LOG_PERIOD_S, Gate, SparseLog, max_connections
from server.service.limits import Limits
from tests.data import ROOT
from tests.service.fakes import PATIENCE_S, frame_message
from tests.service.http import get
from tests.service.serve_fake import SERVE_FAKE
from tests.service.wire import Wire

FILES, ATTACKERS = 128, 200
LITTLE_FILES = f"import resource; resource.setrlimit(resource.RLIMIT_NOFILE, ({FILES}, {FILES}))\n"


class Dropped:
    """Remembers which places were closed."""

    def __init__(self, gate: Gate) -> None:
        self._gate, self.names = gate, []

    def enter(self, name: str, address: str, is_silent: bool = True):
        """A named place of `gate`, or None."""
        place = self._gate.enter(address)
        if place is not None:
            place.drop = lambda: self.names.append(name)
            place.set_silent(is_silent)
        return place


def test_the_oldest_silent_connection_of_an_address_makes_room() -> None:
    gate = Gate(most=10, most_per_address=3)
    dropped = Dropped(gate)
    assert dropped.enter("in use", "192.0.2.1", is_silent=False)
    assert dropped.enter("elsewhere", "192.0.2.2")
    for name in ("a", "b", "c", "d"):
        assert dropped.enter(name, "192.0.2.1")
    assert dropped.names == ["a", "b"]
    assert gate.count == 4


def test_connections_in_use_are_not_closed_for_new_ones() -> None:
    gate = Gate(most=3, most_per_address=2)
    dropped = Dropped(gate)
    places = [dropped.enter(str(k), "192.0.2.1", is_silent=False) for k in range(2)]
    assert dropped.enter("over the address's limit", "192.0.2.1") is None
    assert dropped.enter("other", "192.0.2.2", is_silent=False)
    assert dropped.enter("over the limit in all", "192.0.2.3") is None
    assert dropped.names == []
    for _ in range(2):
        places[0].leave()
    assert dropped.enter("again", "192.0.2.3")
    assert gate.count == 3


def test_whoever_has_most_silent_connections_makes_room_for_others() -> None:
    gate = Gate(most=5, most_per_address=4)
    dropped = Dropped(gate)
    assert dropped.enter("one", "192.0.2.1")
    for k in range(4):
        assert dropped.enter(f"many {k}", "192.0.2.2")
    assert dropped.enter("new", "192.0.2.3")
    assert dropped.names == ["many 0"]


def test_a_proxy_is_not_limited_as_one_client() -> None:
    gate = Gate(most=10, most_per_address=1, is_proxy=lambda address: address == "192.0.2.1")
    dropped = Dropped(gate)
    for k in range(3):
        assert dropped.enter(str(k), "192.0.2.1")
    assert dropped.names == []


def test_an_attack_does_not_fill_the_log(caplog: pytest.LogCaptureFixture) -> None:
    now_s = 0.0
    notes = SparseLog(lambda: now_s)
    with caplog.at_level(logging.INFO):
        for _ in range(1000):
            notes.note("192.0.2.1", "silent")
        notes.note("192.0.2.2", "silent")
        now_s = LOG_PERIOD_S
        notes.note("192.0.2.1", "silent")
    told = [(record.address, record.unlogged) for record in caplog.records]
    assert told == [("192.0.2.1", 0), ("192.0.2.2", 0), ("192.0.2.1", 999)]


@pytest.mark.parametrize(("files", "most"), [(128, 64), (1024, 768), (1 << 20, 1024), (resource.RLIM_INFINITY, 1024)])
def test_connections_stay_below_the_limit_on_files(monkeypatch, files: int, most: int) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _which: (files, files))
    assert max_connections(Limits()) == most


@pytest.fixture
def poor_server() -> Iterator[str]:
    """URL of a server in a process of its own that may open few files."""
    program = [sys.executable, "-c", LITTLE_FILES + SERVE_FAKE]
    with subprocess.Popen(program, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            url = process.stdout.readline().split()[3]
            assert process.stdout.readline().startswith("ready")
            yield url
        finally:
            process.kill()


def test_silent_sockets_take_nothing_from_others(poor_server: str) -> None:
    address = httpx.URL(poor_server)
    wire = Wire(poor_server)
    wire.greet()
    sockets = []
    try:
        for k in range(ATTACKERS):
            sockets.append(socket.create_connection((address.host, address.port), PATIENCE_S))
            if k % 2:
                sockets[-1].sendall(b"GET /healthz HTTP/1.1\r\nhost: x\r\n")  # never ended
        assert httpx.get(f"{poor_server}/healthz", trust_env=False, timeout=PATIENCE_S).status_code == 200
        wire.say(frame_message(0))
        assert wire.hear_until(Composite)
        newcomer = Wire(poor_server)
        newcomer.greet()
        newcomer.hang_up()
    finally:
        for attacker in sockets:
            attacker.close()
        wire.hang_up()


def test_silent_websockets_take_nothing_from_others(poor_server: str) -> None:
    wires = [Wire(poor_server)]
    wires[0].greet()
    wires += [Wire(poor_server) for _ in range(ATTACKERS // 2)]
    assert httpx.get(f"{poor_server}/healthz", trust_env=False, timeout=PATIENCE_S).status_code == 200
    wires[0].say(frame_message(0))
    assert wires[0].hear_until(Composite)
    for wire in wires:
        wire.hang_up()


@pytest.mark.parametrize("begun", [b"", b"GET / HTT", b"GET /healthz HTTP/1.1\r\nhost: x\r\n"])
def test_a_header_that_does_not_come_ends_the_connection(start_server, caplog, begun: bytes) -> None:
    with caplog.at_level(logging.INFO):
        server = start_server(limits=Limits(header_s=0.1))
        with _tcp(server) as silent:
            silent.sendall(begun)
            assert _rest(silent) == b""
    (told,) = [record for record in caplog.records if record.message == "connection refused"]
    assert (told.address, told.reason) == ("127.0.0.1", "no complete request came within 0.1 s")


def test_a_second_header_is_waited_for_no_longer(start_server) -> None:
    server = start_server(limits=Limits(header_s=0.1))
    with _tcp(server) as client:
        client.sendall(b"GET /healthz HTTP/1.1\r\nhost: x\r\n\r\nGET /healthz HTTP/1.1\r\n")
        assert _rest(client).count(b"HTTP/1.1 200 OK") == 1


def test_a_client_inside_is_not_held_to_the_time_of_a_header(start_server) -> None:
    server = start_server(limits=Limits(header_s=0.1))
    wire = Wire(server.url)
    wire.greet()
    with _tcp(server) as silent:
        assert _rest(silent) == b""  # the time has passed
    wire.say(frame_message(0))
    assert wire.hear_until(Composite)
    wire.hang_up()
    assert get(server, "/healthz").status_code == 200


def _tcp(server) -> socket.socket:
    url = httpx.URL(server.url)
    return socket.create_connection((url.host, url.port), PATIENCE_S)


def _rest(client: socket.socket) -> bytes:
    """What comes until the server closes the connection."""
    data = b""
    try:
        while piece := client.recv(1 << 16):
            data += piece
    except ConnectionResetError:
        pass
    return data
