"""What the page says where the server is absent, full, leaving, started anew, of another version, or unwilling."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import SimpleNamespace

import pytest
from playwright.sync_api import Page

from protocol.limits import SUBPROTOCOL
from protocol.messages import Hello
from server.service.edge.authenticator import Authenticator
from server.service.graceful_shutdown import DRAINING, GOODBYE
from server.service.room_registry import key_digest_of
from server.service.serve import BackgroundServer
from server.service.service import Service
from tests.client.web.conftest import OpenPage, wait_for_text
from tests.client.web.constants import PATIENCE_MS
from tests.client.web.page import start_capture, wait_until
from tests.client.web.received import CAMERA, frames_seen
from tests.client.web.sequence import of_device
from tests.service import fakes
from tests.service.draining import draining
from tests.service.fakes import FAKE_DEVICE, Lab, fake_mesh
from tests.service.proxy import impaired
from tests.service.wire import Wire

StartServer = Callable[..., BackgroundServer]


@pytest.fixture
def lab() -> Lab:
    return Lab()


@pytest.fixture
def start(lab: Lab) -> Iterator[StartServer]:
    """Start a server with fake pipelines; keywords go to the service, but for `authenticator` and `port`."""
    servers: list[BackgroundServer] = []

    def start_one(authenticator: Authenticator | None = None, port: int = 0, **options: object) -> BackgroundServer:
        room = SimpleNamespace(close=lambda: None, key_digest=None)
        factories = {"pipeline_factory": lab.build, "mesh_loader": fake_mesh, "room_factory": lambda *_: room}
        servers.append(
            BackgroundServer(
                Service(FAKE_DEVICE, **factories | options), port=port, authenticator=authenticator or Authenticator()
            )
        )
        return servers[-1]

    yield start_one
    lab.release(1000)
    for server in servers:
        server.stop()


SETTLED = """() => {
  const text = document.getElementById("state").textContent;
  return !/^(Connect|Live)/.test(text) && text;
}"""


def state(page: Page) -> str:
    """What the page says of its connection, once it has settled."""
    said = page.wait_for_function(SETTLED).json_value()  # it may change the moment after
    assert "\n" not in said
    return said


def device() -> dict:
    return of_device(CAMERA, frames_seen(3), loops=True)


def test_a_server_that_is_gone(start: StartServer, open_page: OpenPage) -> None:
    with impaired(start().url) as proxy:
        page = open_page(proxy.url)
        wait_for_text(page, "#state", "waiting for a session")
        proxy.refuses = True
        proxy.cut()
        wait_for_text(page, "#state", "Disconnected")
        assert state(page).startswith("Disconnected: the server does not answer; see that it runs (probeless serve)")
        wait_for_text(page, "#state-countdown", "next try in")
        assert page.locator("#retry").is_visible()
        proxy.refuses = False
        page.evaluate("() => document.getElementById('retry').click()")  # it may be gone: the page tries by itself too
        wait_for_text(page, "#state", "waiting for a session")
        page.goto("about:blank")


def test_a_server_that_is_started_anew_gets_objects_again(start: StartServer, lab: Lab, open_page: OpenPage) -> None:
    first = start()
    page = open_page(first.url, device())
    start_capture(page)
    wait_for_text(page, "#state", "Live, captured here")
    page.locator("#place").focus()
    page.keyboard.press("Enter")  # in the middle of the picture
    wait_for_text(page, "#object-said", "placed")
    wait_until(lambda: any(entry[0] == "place" for entry in lab.log))
    placed = [entry for entry in lab.log if entry[0] == "place"]
    first.stop()
    wait_for_text(page, "#state", "Disconnected")
    assert state(page).startswith(("Disconnected: " + GOODBYE, "Disconnected: the server does not answer"))
    start(port=int(first.url.rpartition(":")[2]))
    wait_for_text(page, "#notes", "the session has begun anew")
    wait_for_text(page, "#state", "Live, captured here")
    wait_until(lambda: sum(entry[0] == "place" for entry in lab.log) >= 2, page)
    again = [entry for entry in lab.log if entry[0] == "place"]
    assert [entry[1] for entry in again] == 2 * [placed[0][1]]


def test_a_server_that_is_full(start: StartServer, open_page: OpenPage) -> None:
    server = start(max_sessions=1)
    wire = Wire(server.url)
    wire.greet()
    page = open_page(server.url, device())
    start_capture(page)
    said = state(page)
    assert said == "Not let in yet: all 1 sessions of this server are taken: try again later"
    wire.hang_up()
    wait_for_text(page, "#state", "Live, captured here")


def test_a_server_that_is_draining(start: StartServer, lab: Lab, open_page: OpenPage, monkeypatch) -> None:
    server = start()
    page = open_page(server.url)
    wait_for_text(page, "#state", "waiting for a session")
    with draining(server, lab, monkeypatch):
        wait_for_text(page, "#state", "draining")
        assert state(page) == f"Not let in yet: {DRAINING}"
    page.goto("about:blank")


def test_a_server_of_another_version(start: StartServer, open_page: OpenPage, monkeypatch) -> None:
    monkeypatch.setattr("server.service.edge.connection.SUBPROTOCOL", "probeless-v9")
    page = open_page(start().url)
    wait_for_text(page, "#state", "Refused")
    assert state(page) == (
        f"Refused: this server speaks probeless-v9, you asked for {SUBPROTOCOL}: use the same version on both sides; "
        "reload this page"
    )
    assert page.locator("#reload").is_visible()


@pytest.mark.parametrize(("query", "word"), [("", "missing"), ("/?token=another", "wrong")])
def test_a_wrong_token(start: StartServer, open_page: OpenPage, query: str, word: str) -> None:
    page = open_page(start(authenticator=Authenticator("a-token")).url + query)
    assert state(page) == (
        f"Refused: the token is {word}: use the URL that the server printed at its start, which ends in ?token=..."
    )


def test_a_room_with_another_key(start: StartServer, open_page: OpenPage) -> None:
    room = SimpleNamespace(close=lambda: None, key_digest=None, name="kitchen")
    server = start(room_factory=lambda *_: room)
    wire = Wire(server.url)
    wire.say(Hello(client="test", camera=fakes.CAMERA, room="kitchen", room_key="right"))
    wire.hear()
    assert room.key_digest == key_digest_of("right")
    page = open_page(f"{server.url}/?room=kitchen&key=wrong", device())
    wait_for_text(page, "#state", "waiting for a session of room “kitchen” with that key")
    start_capture(page)
    wait_for_text(page, "#state", "Refused")
    assert state(page) == "Refused: room 'kitchen' has a key of its own, and this is not it: ask who opened it"
    wire.hang_up()


def test_a_server_that_refuses_the_wishes_says_which(start: StartServer, open_page: OpenPage) -> None:
    page = open_page(f"{start().url}/?preset=auto", device())
    start_capture(page)
    assert state(page) == "Refused: preset auto is not for this fake: choose reg4"


def test_quality_is_changed_and_a_refusal_is_told(start: StartServer, lab: Lab, open_page: OpenPage) -> None:
    page = open_page(start(pipeline_factory=lambda *_: _Choosy(lab)).url, device())
    start_capture(page)
    wait_for_text(page, "#state", "Live, captured here")
    page.locator("#full").click()  # back to the whole page
    page.locator("[name=preset]").select_option("rm")
    wait_for_entry(page, lab, ("preset", "rm", None, None))
    page.locator("[name=preset]").select_option("auto")
    wait_for_text(page, "#capture-said", "this device was not measured: run probeless tune")
    assert "preset stays rm" in (page.locator("#capture-said").text_content() or "")
    assert page.locator("[name=preset]").input_value() == "rm"
    page.locator("[name=preset]").select_option("reg8")
    wait_for_entry(page, lab, ("preset", "reg8", None, None))
    wait_for_text(page, "#state", "Live, captured here")


def test_a_budget_is_changed_while_it_runs(start: StartServer, lab: Lab, open_page: OpenPage) -> None:
    page = open_page(start(pipeline_factory=lambda *_: fakes.FakePipeline(lab)).url, device())
    start_capture(page)
    wait_for_text(page, "#state", "Live, captured here")
    page.locator("#full").click()
    page.locator("[name=preset]").select_option("auto")
    wait_for_entry(page, lab, ("preset", "auto", 200.0, None))
    page.locator("[name=budget]").fill("120")
    page.locator("[name=budget]").blur()
    wait_for_entry(page, lab, ("preset", "auto", 120.0, None))


class _Choosy(fakes.FakePipeline):
    """On a device that was not measured."""

    def set_quality(self, preset: str, budget_ms: float | None, max_light_error_deg: float | None) -> None:
        if preset == "auto":
            raise ValueError("this device was not measured: run probeless tune")
        super().set_quality(preset, budget_ms, max_light_error_deg)


def wait_for_entry(page: Page, lab: Lab, entry: tuple) -> None:
    """Until the pipeline was asked this."""
    for _ in range(PATIENCE_MS // 50):
        if entry in lab.log:
            return
        page.wait_for_timeout(50)
    raise AssertionError(f"{entry} is not among {[each for each in lab.log if each[0] == entry[0]]}")
