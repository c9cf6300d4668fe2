"""A new user's way: from the page's address to an object on a real surface, against the real service."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from playwright.sync_api import Page

from client.options.source import open_source
from client.synthetic.scenes import desk
from client.web.build import FOLDER
from server.service.serve import BackgroundServer
from tests.client.web.conftest import OpenPage, wait_for_text
from tests.client.web.constants import PATIENCE_MS
from tests.client.web.page import on_screen, picture, wait_until
from tests.client.web.sequence import of_device
from tests.client.web.watched import TOUCHED, point_under
from tests.node import installed_modules

SIZES = {"phone": (390, 844), "tablet": (820, 1180), "desktop": (1440, 900)}
ON_THE_DESK = (150.0, 165.0)
"""A pixel of the sample in which the desk's top is seen in every frame."""
IPHONE = "Mozilla/5.0 (iPhone; CPU iPhone OS 18_5 like Mac OS X) AppleWebKit/605.1.15 Version/18.5 Safari/604.1"


def is_in_view(page: Page, selector: str) -> bool:
    return page.evaluate(
        """selector => { const box = document.querySelector(selector).getBoundingClientRect();
        return box.top >= -1 && box.bottom <= innerHeight + 1; }""",
        selector,
    )


def check(page: Page) -> None:
    """Nothing is wider than the screen, and axe-core finds nothing."""
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.evaluate((installed_modules() / "axe-core" / "axe.min.js").read_text("utf-8"))
    found = page.evaluate("axe.run().then(({ violations }) => violations.map(({ id, nodes }) => [id, nodes[0].html]))")
    assert found == []


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
def test_three_taps_lead_to_an_object_on_a_surface(
    real_server: BackgroundServer,
    asked: list,
    open_page: OpenPage,
    keep_picture: Callable[[Page, str], None],
    size: tuple[int, int],
) -> None:
    page = open_page(real_server.url, size=size)
    wait_for_text(page, "#state", "waiting for a session")
    check(page)
    page.locator("#try").tap()
    wait_until(lambda: len(asked) >= 1, page)
    assert asked[0][0] == "place"
    assert asked[0][1].position_m == desk.FREE_M  # the sample's own vase
    wait_for_text(page, "#state", "Live, captured here")
    page.wait_for_selector(".has-picture", timeout=PATIENCE_MS)
    assert page.evaluate("picture.width") == 320
    wait_until(lambda: picture(page).std() > 20, page)
    assert is_in_view(page, "#picture-frame")
    page.locator("#place").tap()
    page.touchscreen.tap(*on_screen(page, *ON_THE_DESK))
    wait_until(lambda: len(asked) >= 2, page)
    kind, placed = asked[1]
    assert kind == "place"
    assert abs(placed.position_m[1] - desk.TOP_M) < 0.01
    wait_for_text(page, "#light-words", "Most of it comes from")
    wait_for_text(page, "#light-where", "at the virtual object")
    check(page)
    keep_picture(page, f"begin_{size[0]}")
    page.locator("#details > summary").tap()
    check(page)


def test_presets_change_while_it_runs_and_undo_takes_back_without_losing_the_others(
    real_server: BackgroundServer, asked: list, open_page: OpenPage
) -> None:
    page = open_page(real_server.url, size=SIZES["phone"])
    page.locator("#try").tap()
    wait_for_text(page, "#state", "Live, captured here")
    page.wait_for_selector(".has-picture", timeout=PATIENCE_MS)
    assert page.locator("#undo").is_disabled()
    page.locator("#place").tap()
    page.touchscreen.tap(*on_screen(page, *ON_THE_DESK))
    wait_until(lambda: len(asked) == 2, page)
    page.locator("#live-preset").select_option("gr15fast")
    wait_for_text(page, "#plan-point", "gr15fast")
    assert page.locator("#objects option").count() == 1 + 2
    page.locator("#turn-left").tap()
    wait_until(lambda: asked[-1][0] == "move", page)
    assert asked[-1][1].yaw_deg == pytest.approx(15.0)
    page.locator("#undo").tap()
    wait_until(lambda: asked[-1][0] == "move" and asked[-1][1].yaw_deg == 0.0, page)
    page.locator("#undo").tap()
    wait_until(lambda: asked[-1][0] == "remove", page)
    assert page.locator("#objects option").count() == 1 + 1
    assert page.locator("#undo").is_disabled()


def test_a_file_that_is_too_large_for_a_room_is_made_to_fit(
    real_server: BackgroundServer, asked: list, open_page: OpenPage
) -> None:
    page = open_page(real_server.url, size=SIZES["phone"])
    page.locator("#try").tap()
    page.wait_for_selector(".has-picture", timeout=PATIENCE_MS)
    corners = np.array([[0, 0, 0], [2, 0, 0], [0, 0, 1], [0, 1.5, 0]])
    obj = "".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "f 1 2 3\nf 1 4 2\nf 1 3 4\nf 2 4 3\n"
    page.locator("#model-file").set_input_files({"name": "table.obj", "mimeType": "model/obj", "buffer": obj.encode()})
    wait_for_text(page, "#object-said", "table.obj can be placed now, 23 cm high (0.15 times what the file says)")
    page.locator("#place").tap()
    page.touchscreen.tap(*on_screen(page, *ON_THE_DESK))
    wait_until(lambda: len(asked) == 2, page)
    assert asked[1][1].scale == pytest.approx(0.15)


def test_two_taps_of_a_phone_with_depth_place_an_object(
    real_server: BackgroundServer, asked: list, open_page: OpenPage
) -> None:
    source = open_source("synthetic:table?light=7&size=160x120&frames=1")
    page = open_page(real_server.url, of_device(source.camera, [source[0]], loops=True), size=SIZES["phone"])
    page.locator("#use-camera").tap()
    wait_for_text(page, "#state", "Live, captured here")
    wait_for_text(page, "#object-hint", "it is put there")
    page.touchscreen.tap(*on_screen(page, *TOUCHED))
    wait_until(lambda: len(asked) == 1, page)
    place = np.array(asked[0][1].position_m)
    assert np.abs(place - point_under(source.camera, source[0], *TOUCHED)).max() < 0.01


def test_an_iphone_is_told_what_it_can_do(server: BackgroundServer, browser) -> None:
    with browser.new_context(user_agent=IPHONE, viewport={"width": 390, "height": 844}, has_touch=True) as context:
        page = context.new_page()
        page.goto(server.url)
        wait_for_text(page, "#device-hint", "Browsers on iPhone and iPad measure no depth")
        assert page.locator("#use-camera").is_hidden()
        check(page)


@pytest.mark.parametrize("answer", ["picture", "layer"])
def test_a_recording_fits_a_phone_in_every_mode(
    real_server: BackgroundServer, open_page: OpenPage, answer: str
) -> None:
    page = open_page(real_server.url, size=SIZES["phone"])
    page.locator("input[name=source][value=recorded]").check()
    page.locator("[name=answer]").select_option(answer)
    page.locator("[name=recording]").set_input_files(FOLDER / "src" / "sample.probeless")
    page.locator("#start").tap()
    wait_for_text(page, "#state", "Live, captured here")
    page.wait_for_selector(".has-picture", timeout=PATIENCE_MS)
    assert is_in_view(page, "#picture-frame")
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert page.locator("#objects option").count() == 1 + 1  # what was placed when it was recorded


WAKE = """navigator.__defineGetter__("wakeLock", () => ({ request: () => {
  window.held = (window.held ?? 0) + 1;
  return Promise.resolve({ addEventListener() {}, release() { window.held--; return Promise.resolve(); } });
} }));"""


def test_the_screen_stays_on_while_there_is_a_live_picture(real_server: BackgroundServer, open_page: OpenPage) -> None:
    page = open_page(real_server.url, size=SIZES["phone"])
    page.evaluate(WAKE)
    assert page.evaluate("window.held ?? 0") == 0
    page.locator("#try").tap()
    wait_for_text(page, "#state", "Live, captured here")
    page.wait_for_function("window.held === 1")
    page.locator("#stop").tap()
    page.wait_for_function("window.held === 0")
    assert page.locator("#try").is_visible()
