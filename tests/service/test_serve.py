"""Starting and stopping the server: ports, devices, signals."""

import signal
import socket
import subprocess
import sys
import threading

import httpx
import pytest

from server.service.serve import BackgroundServer, ServeError, listen, serve, url_of
from server.service.service import Service
from tests.absent import NO_HARDWARE
from tests.data import ROOT
from tests.service.fakes import FAKE_DEVICE, PATIENCE_S, fake_mesh
from tests.service.serve_fake import SERVE_FAKE
from tests.service.wire import Wire


def test_port_in_use_is_one_line_and_status_1(capsys) -> None:
    with listen("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        assert serve("127.0.0.1", port) == 1
    said = capsys.readouterr()
    assert said.err == f"probeless: port {port} of 127.0.0.1 is in use: stop what uses it or choose another --port\n"
    assert said.out == ""


def test_unknown_device_is_one_line_and_status_1(capsys) -> None:
    assert serve(port=0, device_name="no such device") == 1
    said = capsys.readouterr()
    assert "no such device" in said.err
    assert said.err.count("\n") == 1


@pytest.mark.parametrize(("host", "port"), [("203.0.113.1", 0), ("no.such.host.invalid", 0), ("127.0.0.1", 70000)])
def test_address_that_is_not_here_is_said(host, port) -> None:
    with pytest.raises(ServeError, match="--port"):
        listen(host, port)


def test_url_of_all_addresses_is_one_that_opens() -> None:
    with listen("0.0.0.0", 0) as listener:
        assert url_of(listener) == f"http://localhost:{listener.getsockname()[1]}"


def test_ipv6_url_has_brackets() -> None:
    if not socket.has_ipv6:
        pytest.skip(f"{NO_HARDWARE}no IPv6")
    with listen("::1", 0) as listener:
        assert url_of(listener) == f"http://[::1]:{listener.getsockname()[1]}"


@pytest.mark.parametrize("shell", ["", "trap '' INT; "], ids=["as usual", "ignored, as by shells in the background"])
def test_interrupt_ends_the_server_in_order(shell: str) -> None:
    process = subprocess.Popen(
        ["sh", "-c", shell + 'exec "$0" -c "$1"', sys.executable, SERVE_FAKE],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        serves, ready = process.stdout.readline(), process.stdout.readline()
        url = ready.split()[2]
        assert url in serves
        assert httpx.get(f"{url}/healthz", trust_env=False).json()["ready"] is True
        wire = Wire(url)
        wire.greet()
        process.send_signal(signal.SIGINT)
        assert wire.ending()[0] == 1012
        said, errors = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
    assert process.returncode == 0
    assert said == "stopped\n"
    assert errors == ""


def test_stopping_in_background_closes_sockets_and_threads(lab) -> None:
    threads = threading.active_count()
    service = Service(FAKE_DEVICE, pipeline_factory=lab.build, mesh_loader=fake_mesh)
    server = BackgroundServer(service)
    wire = Wire(server.url)
    wire.greet()
    server.stop()
    assert wire.ending()[0] == 1012
    assert lab.closed.wait(PATIENCE_S)
    for thread in threading.enumerate():
        if thread.name.startswith("probeless"):
            thread.join(PATIENCE_S)
    wire.hang_up()
    assert threading.active_count() <= threads
    with pytest.raises(OSError, match="refused"):
        Wire(server.url)
