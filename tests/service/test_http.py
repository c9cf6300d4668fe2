"""Health, metrics and the page."""

import asyncio
import threading
import time
from pathlib import Path

import httpx
import pytest

from protocol.messages import TIMING_ROWS, Composite, Error, Hello
from server.service.app import create_app
from server.service.self_check import CheckFailed
from server.service.serve import BackgroundServer
from server.service.service import Service
from tests.service.fakes import CAMERA, FAKE_DEVICE, PATIENCE_S, REFUSE_MM, fake_mesh, frame_message
from tests.service.http import get, rows
from tests.service.wire import Wire


def test_health_counts_sessions(server, dial) -> None:
    response = get(server, "/healthz")
    assert response.status_code == 200
    assert response.json() == {"ready": True, "device": "a fake device", "sessions": 0}
    dial().greet()
    assert get(server, "/healthz").json()["sessions"] == 1


def test_health_and_metrics_say_what_is_kept_of_rooms(start_server, tmp_path: Path) -> None:
    folder = tmp_path / "rooms" / "study-1" / "0"
    folder.mkdir(parents=True)
    (folder / "save").write_bytes(bytes(1000))
    server = start_server(data=tmp_path / "rooms")
    end_s = time.monotonic() + PATIENCE_S
    while (state := get(server, "/healthz").json())["kept_rooms"] == 0:
        assert time.monotonic() < end_s
        time.sleep(0.1)
    assert (state["kept_rooms"], state["kept_bytes"]) == (1, 1000)
    found = rows(server)
    expected = {"kept_rooms": 1, "kept_bytes": 1000, "kept_removed_total": 0, "unsaved_rooms": 0}
    assert {name: found[f"probeless_{name}",] for name in expected} == expected
    assert found["probeless_rooms",] == 0


def test_clients_wait_for_the_warm_up(lab) -> None:
    warm, prepared = threading.Event(), threading.Event()
    service = Service(
        FAKE_DEVICE, pipeline_factory=lab.build, mesh_loader=fake_mesh, warm_up=lambda _: warm.wait(PATIENCE_S)
    )
    service.on_prepared = prepared.set
    with BackgroundServer(service) as server:
        response = get(server, "/healthz")
        assert response.status_code == 503
        assert response.json()["ready"] is False
        wire = Wire(server.url)
        wire.say(Hello(client="test", camera=CAMERA))
        warm.set()
        assert wire.hear().session == "session-1"
        assert prepared.wait(PATIENCE_S)
        assert get(server, "/healthz").status_code == 200
        wire.hang_up()


def test_failed_warm_up_is_told_to_everybody(lab) -> None:
    def fail(_: object) -> None:
        raise RuntimeError("kernel volume.cl does not build")

    prepared = threading.Event()
    service = Service(FAKE_DEVICE, pipeline_factory=lab.build, mesh_loader=fake_mesh, warm_up=fail)
    service.on_prepared = prepared.set
    with BackgroundServer(service) as server:
        assert prepared.wait(PATIENCE_S)
        response = get(server, "/healthz")
        assert response.status_code == 503
        assert "volume.cl" in response.json()["failure"]
        wire = Wire(server.url)
        wire.say(Hello(client="test", camera=CAMERA))
        code, reason, messages = wire.ending()
        assert code == 1011
        assert "volume.cl" in reason
        assert messages == [Error(reason=reason, fatal=True)]


def test_a_wrong_answer_of_the_device_is_named(lab) -> None:
    def fail(_: object) -> None:
        raise CheckFailed("light", "its direction is 41.0 degrees off, at most 10")

    prepared = threading.Event()
    service = Service(FAKE_DEVICE, pipeline_factory=lab.build, mesh_loader=fake_mesh, warm_up=fail)
    service.on_prepared = prepared.set
    with BackgroundServer(service) as server:
        assert prepared.wait(PATIENCE_S)
        state = get(server, "/healthz").json()
        assert (state["ready"], state["failed_check"]) == (False, "light")
        assert "check 'light': its direction is 41.0 degrees off" in state["failure"]
        assert rows(server)["probeless_ready",] == 0


def test_metrics_have_every_row_before_the_first_frame(server) -> None:
    found = rows(server)
    for stage in (*TIMING_ROWS, "total", "host"):
        assert found["probeless_stage_seconds_count", stage] == 0
    for name in (
        "decode_seconds_count",
        "encode_seconds_count",
        "queue_age_seconds_count",
        "frames_processed_total",
        "reads_total",
        "copies_total",
        "sessions",
    ):
        assert found[f"probeless_{name}",] == 0
    for reason in ("replaced", "refused", "unreadable", "invalid"):
        assert found["probeless_frames_dropped_total", reason] == 0


def test_metrics_count_what_happened(server, dial, lab) -> None:
    lab.hold = True
    wire, watcher = dial(), dial()
    wire.greet()
    watcher.watch()
    wire.say(frame_message(0))
    lab.next_entered()
    wire.say(frame_message(1), frame_message(2))
    deadline_s = time.monotonic() + PATIENCE_S
    while rows(server)["probeless_frames_dropped_total", "replaced"] < 1 and time.monotonic() < deadline_s:
        time.sleep(0.01)  # a busy server may take the first before the second has arrived
    lab.release(2)
    wire.hear_until(Composite)
    wire.hear_until(Composite)
    wire.say(frame_message(3, REFUSE_MM))
    lab.release()
    wire.hear()
    found = rows(server)
    assert found["probeless_frames_processed_total",] == 2
    assert found["probeless_frames_dropped_total", "replaced"] == 1
    assert found["probeless_frames_dropped_total", "refused"] == 1
    assert found["probeless_stage_seconds_sum", "rendering"] == pytest.approx(2 * 3.25e-3)
    assert found["probeless_stage_seconds_count", "total"] == 2
    assert found["probeless_decode_seconds_count",] == 3
    assert found["probeless_encode_seconds_count",] == 2
    assert found["probeless_queue_age_seconds_count",] == 3
    assert found["probeless_sessions",] == 1
    assert found["probeless_watchers",] == 1


def test_each_service_has_its_own_registry(start_server) -> None:
    first, second = start_server(), start_server()
    wire = Wire(first.url)
    wire.greet()
    assert rows(first)["probeless_sessions",] == 1
    assert rows(second)["probeless_sessions",] == 0
    wire.hang_up()


@pytest.fixture
def service(lab) -> Service:
    return Service(FAKE_DEVICE, pipeline_factory=lab.build, mesh_loader=fake_mesh)


def get_in_process(service: Service, page_folder: Path, path: str) -> httpx.Response:
    """A request to the app itself, without a socket."""

    async def ask() -> httpx.Response:
        transport = httpx.ASGITransport(create_app(service, page_folder))
        async with httpx.AsyncClient(transport=transport, base_url="http://test") as http:
            return await http.get(path)

    return asyncio.run(ask())


def test_page_is_served_from_its_folder(service, tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("<title>probeless</title>")
    (tmp_path / "main.js").write_text("let x;")
    assert get_in_process(service, tmp_path, "/").text == "<title>probeless</title>"
    assert get_in_process(service, tmp_path, "/main.js").text == "let x;"
    assert get_in_process(service, tmp_path, "/absent.js").status_code == 404
    assert get_in_process(service, tmp_path, "/healthz").status_code == 503  # nobody has started it


def test_missing_page_is_said_in_one_line(service, tmp_path: Path) -> None:
    response = get_in_process(service, tmp_path / "dist", "/")
    assert response.status_code == 404
    assert response.text.count("\n") == 1
    assert "dist/index.html is missing" in response.text
