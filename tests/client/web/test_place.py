"""The page of `probeless place` in a browser, opened from disk: a click gives the option that says the same."""

from __future__ import annotations

from pathlib import Path

import pytest
from playwright.sync_api import Page

from client.cli import run_command
from client.options.source import open_source
from tests.client.web.conftest import OpenPage
from tests.node import installed_modules

SOURCE = "synthetic:table?size=160x120&frames=3"


@pytest.fixture
def page(tmp_path: Path, open_page: OpenPage) -> Page:
    assert run_command(["place", SOURCE, "--object", "cup.obj", "--out", str(tmp_path)]) == 0
    return open_page((tmp_path / "place.html").as_uri(), size=(390, 844))


def test_a_tap_says_which_pixel_of_which_frame_it_is(page: Page) -> None:
    box = page.locator("#picture").bounding_box()
    page.touchscreen.tap(box["x"] + (80.5 / 160) * box["width"], box["y"] + (90.5 / 120) * box["height"])
    expected = f"probeless run '{SOURCE}' --object cup.obj@pixel:80,90:0 --out out/placed"
    assert page.locator("#command").inner_text() == expected
    depth_m = open_source(SOURCE)[0].depth[88, 80] / 1000
    assert page.locator("#said").inner_text() == f"Pixel 80, 90 of frame 0, {depth_m:.2f} m from the camera."
    page.locator("#stage").focus()
    page.keyboard.press("ArrowRight")
    assert "@pixel:82,90:0 " in page.locator("#command").inner_text()
    page.locator("#frame").focus()
    page.keyboard.press("ArrowRight")
    assert page.locator("#command").inner_text() == ""  # the camera has moved
    page.touchscreen.tap(box["x"] + 5, box["y"] + 5)
    assert ":1 --out" in page.locator("#command").inner_text()


def test_nothing_is_wider_than_a_phone_and_axe_finds_nothing(page: Page) -> None:
    page.locator("#stage").focus()
    page.keyboard.press("ArrowUp")
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.evaluate((installed_modules() / "axe-core" / "axe.min.js").read_text("utf-8"))
    assert page.evaluate("axe.run().then(found => found.violations.map(each => each.id))") == []
