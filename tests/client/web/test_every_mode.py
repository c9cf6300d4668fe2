"""Each mode of the page on a phone, a tablet and a desktop: nothing is out of sight, cut or covered; axe-core agrees.

One page goes through all modes against one real service. Its device has WebXR (device.js) and Chromium's fake camera.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from playwright.sync_api import Page

from client.options.source import open_source
from client.web.build import FOLDER
from server.service.serve import BackgroundServer
from tests.client.web.conftest import OpenPage, wait_for_text
from tests.client.web.page import start_capture, start_recording
from tests.client.web.sequence import of_device
from tests.client.web.watched import standing_camera
from tests.node import installed_modules

SIZES = {"phone": (390, 844), "tablet": (820, 1180), "desktop": (1280, 800)}
FAULTS = Path(__file__).with_name("faults.js").read_text("utf-8")
VIOLATIONS = "axe.run().then(({ violations }) => violations.map(({ id, nodes }) => `${id}: ${nodes[0].html}`))"
SAMPLE = FOLDER / "src" / "sample.probeless"
TABLE = "synthetic:table?light=7&size=160x120&frames=1"


def select_object(page: Page) -> None:
    """Select the object that the recording brought along, so that all tools are there."""
    page.wait_for_selector(".has-picture")
    page.locator("#objects").select_option(index=1)


def place(page: Page) -> None:
    page.locator("#object-tools").wait_for()
    page.locator("#place").focus()
    page.keyboard.press("Enter")
    wait_for_text(page, "#object-said", "placed")


def choose(page: Page, source: str, answer: str) -> None:
    page.locator(f"input[name=source][value={source}]").check()
    page.locator("[name=answer]").select_option(answer)


def stop(page: Page) -> None:
    page.locator("#stop").click()
    wait_for_text(page, "#state", "waiting for a session")


def forms(page: Page) -> Iterator[str]:
    """The form of each source, with all that it can ask for."""
    page.locator("details").evaluate_all("all => all.forEach((each) => { each.open = true; })")
    for source in ("xr", "camera", "recorded", "watch"):
        page.locator(f"input[name=source][value={source}]").check()
        yield f"form-{source}"


def recordings(page: Page) -> Iterator[str]:
    page.locator("#try").tap()
    wait_for_text(page, "#light-words", "Most of it comes from")
    select_object(page)
    yield "try"
    stop(page)
    choose(page, "recorded", "layer")
    start_recording(page, SAMPLE)
    wait_for_text(page, "#picture-caption", "Frame")
    select_object(page)
    yield "recorded-layer"
    stop(page)


def cameras_with_depth(page: Page) -> Iterator[str]:
    for answer in ("picture", "layer", "light"):
        choose(page, "xr", answer)
        start_capture(page)
        place(page)
        yield f"xr-{answer}"
        stop(page)


def plain_camera(page: Page) -> Iterator[str]:
    """Nobody has seen its marker: it shows what it sees itself, and says what to do."""
    page.locator("input[name=source][value=camera]").check()
    page.locator("[name=room]").fill("kitchen")
    page.locator("[name=marker]").fill("7")
    page.locator("#start").click()
    wait_for_text(page, "#stage-said", "Point the camera at marker 7")
    page.wait_for_function(
        "viewfinder.videoWidth > 0 && !viewfinder.paused && viewfinder.checkVisibility({ visibilityProperty: true })"
    )
    assert page.locator("#guide").is_hidden()  # nothing of the session before is left on the picture
    yield "camera"
    stop(page)
    assert page.evaluate("viewfinder.srcObject === null && getComputedStyle(viewfinder).visibility === 'hidden'")


def watching(page: Page, url: str) -> Iterator[str]:
    page.locator("[name=room]").fill("")
    page.locator("input[name=source][value=watch]").check()
    page.locator("#start").click()
    with standing_camera(url, open_source(TABLE)):
        page.wait_for_selector(".has-picture")
        place(page)
        yield "watch"


def look(page: Page, keep_picture: Callable[[Page, str], None], mode: str) -> list[str]:
    """What is wrong with a mode in each size, with a picture of each that has a fault."""
    found: list[str] = []
    for size, (width, height) in SIZES.items():
        page.set_viewport_size({"width": width, "height": height})
        page.evaluate("scrollTo(0, 0)")
        faults = (*page.evaluate(FAULTS), *page.evaluate(VIOLATIONS))
        found += [f"{mode}, {size}: {fault}" for fault in faults]
        if faults:
            keep_picture(page, f"mode-{mode}-{width}")
    return found


def test_nothing_is_wider_than_the_screen_cut_or_covered(
    real_server: BackgroundServer, open_page: OpenPage, keep_picture: Callable[[Page, str], None]
) -> None:
    source = open_source(TABLE)
    page = open_page(
        f"{real_server.url}/?preset=gr15fast", of_device(source.camera, [source[0]], loops=True), size=SIZES["phone"]
    )
    wait_for_text(page, "#state", "waiting for a session")
    page.evaluate((installed_modules() / "axe-core" / "axe.min.js").read_text("utf-8"))
    faults = look(page, keep_picture, "opening")
    for modes in (
        forms(page),
        recordings(page),
        cameras_with_depth(page),
        plain_camera(page),
        watching(page, real_server.url),
    ):
        for mode in modes:
            faults += look(page, keep_picture, mode)
            if page.locator("#full").is_visible():
                page.locator("#full").click()
                was_full = page.locator("#full").get_attribute("aria-pressed") == "false"
                faults += look(page, keep_picture, f"{mode}-{'page' if was_full else 'full'}")
                page.locator("#full").click()
    assert faults == []
