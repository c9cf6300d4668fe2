"""Fixtures: Debian's Chromium, a page in it, and where its pictures are kept."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from playwright.sync_api import Browser, Page, TimeoutError, sync_playwright

from server.opencl.device import Device
from server.service.serve import BackgroundServer
from tests.client.web.constants import PATIENCE_MS, PICTURES
from tests.client.web.page import said_by
from tests.servers import fake_server
from tests.service.fakes import Lab

if TYPE_CHECKING:
    from tests.client.web.received import Received

HERE = Path(__file__).parent
FLAGS = (
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--use-fake-ui-for-media-stream",
    "--use-fake-device-for-media-stream",
)

OpenPage = Callable[..., Page]


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """Chromium without a window."""
    path = shutil.which("chromium")
    if path is None:
        pytest.skip("there is no chromium: apt-get install chromium")
    own = ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=[*FLAGS, *own])
        yield browser
        browser.close()


@pytest.fixture
def open_page(browser: Browser) -> Iterator[OpenPage]:
    """Open a URL, with a device of WebXR where `device` says what it shows; faults of the page fail the test."""
    faults: list[str] = []
    contexts = []

    def open_(url: str, device: dict | None = None, size: tuple[int, int] = (360, 640)) -> Page:
        context = browser.new_context(viewport={"width": size[0], "height": size[1]}, has_touch=True)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(PATIENCE_MS)
        page.on("pageerror", lambda error: faults.append(str(error)))
        if device is not None:
            page.add_init_script(path=HERE / "device.js")
        page.goto(url)
        if device is not None:
            page.evaluate("given => device.load(given)", device)
        return page

    yield open_
    for context in contexts:
        context.close()
    assert not faults


@pytest.fixture
def lab() -> Lab:
    """What the test shares with the fake pipelines."""
    return Lab()


@pytest.fixture
def received() -> Received:
    """What the fake pipelines were given, where a test's server is of them."""
    from tests.client.web.received import Received

    return Received()


@pytest.fixture
def build_pipeline(lab: Lab) -> Callable[..., object]:
    """What makes the pipelines of `server`: fakes, unless a file has another fixture of this name."""
    return lab.build


@pytest.fixture
def server_options() -> dict[str, object]:
    """What else `server` is started with."""
    return {}


@pytest.fixture
def server(build_pipeline: Callable[..., object], server_options: dict[str, object]) -> Iterator[BackgroundServer]:
    """A server with fake pipelines."""
    with fake_server(build_pipeline, **server_options) as server:
        yield server


@pytest.fixture
def serve(received: Received) -> Iterator[Callable[[float], BackgroundServer]]:
    """Start a server whose pipelines take so many seconds to draw the ball of a frame."""
    from tests.client.web.layer_drawing import Drawing

    with ExitStack() as running:

        def start(takes_s: float) -> BackgroundServer:
            def build(_device: object, _camera: object, wishes: object, *_room: object) -> Drawing:
                received.wishes.append(wishes)
                return Drawing(received, takes_s)

            return running.enter_context(fake_server(build))

        yield start


@pytest.fixture
def watched(device: Device) -> Iterator[tuple[BackgroundServer, list]]:
    """A server with real pipelines, and what they were asked."""
    from tests.client.web.watched import watched_server

    with watched_server(device) as watched:
        yield watched


@pytest.fixture
def real_server(watched: tuple[BackgroundServer, list]) -> BackgroundServer:
    """The server of `watched`."""
    return watched[0]


@pytest.fixture
def asked(watched: tuple[BackgroundServer, list]) -> list:
    """What the pipelines of `watched` were asked."""
    return watched[1]


@pytest.fixture
def keep_picture() -> Callable[[Page, str], None]:
    """Keep what a page looks like."""

    def keep(page: Page, name: str) -> None:
        PICTURES.mkdir(parents=True, exist_ok=True)
        page.screenshot(path=PICTURES / f"{name}.png")

    return keep


def wait_for_text(page: Page, selector: str, text: str, times: int = 1) -> None:
    """Until the element says it; `times`: as much patience as usual, where a busy machine needs more."""
    try:
        page.locator(selector).filter(has_text=text).first.wait_for(state="attached", timeout=times * PATIENCE_MS)
    except TimeoutError as error:
        raise AssertionError(f"not {text!r}: {said_by(page, selector)}") from error
