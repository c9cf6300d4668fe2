"""A server that crashes is started again on the same socket with the same token; one that ends is not."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from client.options.serve_options import ServeOptions, authenticator_of
from server.opencl.device import Device
from server.service import keeper
from server.service.edge.listening import listen
from server.service.keeper import CAN_KEEP, KEPT, Keeper, kept
from tests.bench.service.process import children
from tests.data import ROOT
from tests.service.fakes import PATIENCE_S
from tests.service.wire import Wire

pytestmark = pytest.mark.skipif(not CAN_KEEP, reason="this machine's hardware: Windows hands down no sockets")

SERVER = f"""
import os, signal, sys
sys.path.insert(0, {str(ROOT)!r})
from pathlib import Path
from server.service.keeper import kept

mine = kept()
assert mine is not None
runs = Path(sys.argv[1])
runs.write_text((runs.read_text() if runs.exists() else "") + mine.token + "\\n")
number = len(runs.read_text().splitlines())
"""
CRASH = "os.kill(os.getpid(), signal.SIGKILL)\n"
ANSWER = "client, _ = mine.listener.accept()\nclient.sendall(str(number).encode())\nclient.close()\n"


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with listen("127.0.0.1", 0) as found:
        yield found


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keeper, "FIRST_PAUSE_S", 0.01)


def of(program: str, runs: Path, listener: socket.socket) -> Keeper:
    return Keeper([sys.executable, "-c", SERVER + program, str(runs)], listener)


def test_it_is_started_again_with_its_socket_and_its_token(tmp_path: Path, listener, caplog) -> None:
    runs = tmp_path / "runs"
    crashes_twice = f"mine.tell_ready()\nif number < 3:\n    {CRASH}{ANSWER}sys.exit(7)\n"
    with socket.create_connection(listener.getsockname(), timeout=PATIENCE_S) as waiting:  # before any server runs
        assert of(crashes_twice, runs, listener).run() == 7
        assert waiting.recv(10) == b"3"
    tokens = runs.read_text().splitlines()
    assert len(tokens) == 3
    assert len(set(tokens)) == 1
    assert [record.signal for record in caplog.records] == ["SIGKILL", "SIGKILL"]
    assert tokens[0] not in caplog.text


def test_a_crash_before_it_was_ready_is_its_end(tmp_path: Path, listener) -> None:
    runs = tmp_path / "runs"
    assert of(CRASH, runs, listener).run() == 128 + signal.SIGKILL
    assert len(runs.read_text().splitlines()) == 1


def test_a_server_that_does_not_come_back_is_tried_again(tmp_path: Path, listener) -> None:
    runs = tmp_path / "runs"
    kept_on = of(f"if number == 1: mine.tell_ready()\nif number < 4:\n    {CRASH}", runs, listener)
    assert kept_on.run() == 0
    assert kept_on.crashes == 3


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_is_passed_on_and_ends_both(tmp_path: Path, listener, number: int) -> None:
    runs = tmp_path / "runs"
    sleeps = "signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))\nmine.tell_ready()\nruns.with_name('up').touch()\n"
    kept_on = of(sleeps + "while True: signal.pause()\n", runs, listener)

    def stop() -> None:
        end_s = time.monotonic() + PATIENCE_S
        while not (tmp_path / "up").exists() and time.monotonic() < end_s:
            time.sleep(0.01)
        kept_on.stop(number)

    stopping = threading.Thread(target=stop)
    stopping.start()
    assert kept_on.run() == 0
    stopping.join()
    assert kept_on.crashes == 0


def test_a_stop_during_the_pause_is_the_end(tmp_path: Path, listener, monkeypatch) -> None:
    monkeypatch.setattr(keeper, "FIRST_PAUSE_S", 2 * PATIENCE_S)
    kept_on = of(f"mine.tell_ready()\n{CRASH}", tmp_path / "runs", listener)

    def stop() -> None:
        end_s = time.monotonic() + PATIENCE_S
        while not kept_on.crashes and time.monotonic() < end_s:
            time.sleep(0.01)
        kept_on.stop(signal.SIGTERM)

    stopping = threading.Thread(target=stop)
    stopping.start()
    assert kept_on.run() == 0
    stopping.join()


def test_pauses_grow_where_it_crashes_in_a_row_and_start_anew_after_a_calm_time(
    tmp_path: Path, listener, caplog
) -> None:
    times = iter([0.0, 1.0, 1.0, 2.0, 2.0, 100.0, 100.0, 101.0, 101.0, 102.0, 102.0])
    runs = tmp_path / "runs"
    program = f"mine.tell_ready()\nif number < 5:\n    {CRASH}"
    server = [sys.executable, "-c", SERVER + program, str(runs)]
    assert Keeper(server, listener, clock=lambda: next(times)).run() == 0
    assert [record.pause_s for record in caplog.records] == pytest.approx([0.01, 0.02, 0.01, 0.02])


def test_without_a_parent_there_is_nothing_kept(monkeypatch) -> None:
    monkeypatch.delenv(KEPT, raising=False)
    assert kept() is None


def test_the_kept_token_counts_where_none_was_given() -> None:
    assert authenticator_of(ServeOptions("127.0.0.1", new_token="kept")).token == "kept"
    assert authenticator_of(ServeOptions("127.0.0.1", token="own", new_token="kept")).token == "own"


COLD = ("-m", "tests.bench.service.process", '{"warms_up": false}')
"""The program, but that it compiles no kernel before it is ready: that takes ten seconds, twice, and no frame comes."""


def test_the_program_is_back_at_its_address_after_a_crash(device: Device, tmp_path: Path) -> None:
    program = [sys.executable, *COLD, "--device", device.name]
    process = subprocess.Popen(
        [*program, "--port", "0", "--token", "none", "--data", "none"],
        cwd=ROOT,
        env=os.environ | {"PROBELESS_KEYS": str(tmp_path)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        url = ready_url(process)
        (server,) = children(process.pid)
        os.kill(server, signal.SIGSEGV)  # as a fault of a driver; once is enough
        waited_until_s = time.monotonic() + PATIENCE_S
        while server in children(process.pid):
            assert time.monotonic() < waited_until_s, "the signal did not end it"
            time.sleep(0.01)
        wire = Wire(url)  # waits in the parent's socket
        wire.greet()
        assert ready_url(process) == url
        process.send_signal(signal.SIGTERM)
        assert wire.ending()[0] == 1012
        _, errors = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
    assert process.returncode == 0
    assert "the server crashed and is started again signal=SIGSEGV" in errors


def ready_url(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith("ready: open "):
            return line.split()[2]
    raise AssertionError("it ended before it was ready")
