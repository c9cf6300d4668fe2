"""Small screens: the tools leave the picture its room, what ends the session stays in sight, the form stands still."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from playwright.sync_api import Page

from server.service.serve import BackgroundServer
from tests.client.web.conftest import OpenPage, wait_for_text
from tests.client.web.page import start_capture
from tests.client.web.sequence import of_device
from tests.client.web.wall import CAMERA, plane

PLACES = """() => Object.fromEntries([".side", "#stop", "#full", "#selected-tools"].map(
    (name) => [name, document.querySelector(name).getBoundingClientRect().toJSON()]))"""


@pytest.mark.parametrize("answer", ["light", "picture"])
@pytest.mark.parametrize("size", [(360, 640), (640, 360)], ids=["upright", "across"])
def test_the_tools_of_a_selected_object_leave_most_of_the_screen(
    server: BackgroundServer,
    open_page: OpenPage,
    keep_picture: Callable[[Page, str], None],
    size: tuple[int, int],
    answer: str,
) -> None:
    width, height = size
    page = open_page(server.url, of_device(CAMERA, [plane()], loops=True), size=size)
    page.locator("input[value=xr]").check()
    page.locator("[name=answer]").select_option(answer)
    start_capture(page)
    wait_for_text(page, "#state", "Live, captured here")
    page.locator("#place").focus()
    page.keyboard.press("Enter")
    wait_for_text(page, "#object-said", "placed")
    keep_picture(page, f"tools_{answer}_{width}")
    found = page.evaluate(PLACES)
    panel = found[".side"]
    assert panel["width"] * panel["height"] < 0.37 * width * height
    assert panel["bottom"] <= height
    # In light mode the device itself draws, on the whole screen.
    for name in ("#stop", "#full") if answer == "picture" else ("#stop",):
        box = found[name]
        assert box["left"] >= panel["left"]
        assert box["right"] <= width
        assert box["bottom"] <= height
        assert min(box["width"], box["height"]) >= 44
    assert found["#selected-tools"]["top"] < height
    middle = page.evaluate("() => document.elementFromPoint(innerWidth / 3, innerHeight / 2).id")
    assert middle in ("picture-frame", "picture", "guide")


WHERE = """texts => texts.map((text) => {
    const state = document.getElementById("state"), said = state.textContent;
    state.textContent = text;
    const { top } = document.querySelector("input[value=xr]").getBoundingClientRect();
    state.textContent = said;
    return top;
})"""
STATES = ("Connecting…", "Connected, waiting for a session", "Connected, no new pictures", "Live")


def test_what_a_finger_is_about_to_press_does_not_move_when_the_page_connects(
    server: BackgroundServer, open_page: OpenPage
) -> None:
    page = open_page(server.url)
    wait_for_text(page, "#state", STATES[1])
    for width in (360, 600, 760, 900, 1200):
        page.set_viewport_size({"width": width, "height": 800})
        assert len(set(page.evaluate(WHERE, STATES))) == 1, width
