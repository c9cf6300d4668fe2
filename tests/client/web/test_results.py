"""The page of a run, opened from disk in Chromium: nothing is fetched, nothing fails, and all of it can be worked."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from client.results.output_folder import OutputWriter
from tests.client.results_page import DESCRIPTION, OBJECT, output_of, write_run, write_until
from tests.client.web.constants import PATIENCE_MS
from tests.node import installed_modules

Open = Callable[..., Page]
SIZES = [(390, 844), (820, 1180), (1440, 900)]
FRAMES = 12


@pytest.fixture
def open_results(browser: Browser) -> Iterator[Open]:
    """Open the page of a folder from disk; errors, messages of the console and requests to elsewhere fail the test."""
    faults: list[str] = []
    contexts = []

    def open_(folder: Path, size: tuple[int, int] = (1000, 800), missing: bool = False) -> Page:
        context = browser.new_context(viewport={"width": size[0], "height": size[1]}, has_touch=size[0] < 1000)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(PATIENCE_MS)
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("console", lambda message: None if missing else faults.append(message.text))
        page.on("request", lambda request: faults.append(request.url) if not is_own(request.url, folder) else None)
        page.goto((folder / "index.html").as_uri())
        page.locator("#where strong").wait_for()
        return page

    yield open_
    for context in contexts:
        context.close()
    assert not faults


def is_own(url: str, folder: Path) -> bool:
    return url.startswith((folder.as_uri(), "data:", "blob:"))


def drawn(page: Page, selector: str) -> np.ndarray:
    """[h, w, 3] RGB of what an element looks like; a page from disk may not read its own canvases."""
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    png = np.frombuffer(page.locator(selector).screenshot(), np.uint8)
    return cv2.imdecode(png, cv2.IMREAD_COLOR_RGB)


def shown_frame(page: Page) -> int:
    return int(page.locator("#where strong").inner_text().removeprefix("Frame "))


def wait_for_frame(page: Page, frame: int) -> None:
    page.wait_for_function(f"() => document.querySelector('#where strong').textContent === 'Frame {frame}'")


def red_at_object(page: Page) -> bool:
    """Whether the middle of the virtual object is red in the picture that is shown."""
    picture = drawn(page, "#stage").astype(int)
    rows, columns = OBJECT
    row = (rows.start + rows.stop) * picture.shape[0] // (2 * 48)
    column = (columns.start + columns.stop) * picture.shape[1] // (2 * 64)
    red, green, blue = picture[row - 3 : row + 4, column - 3 : column + 4].mean((0, 1))
    return red > 150 and green < 90 and blue < 90


def wait_until_red(page: Page, is_red: bool) -> None:
    for _ in range(100):
        if red_at_object(page) == is_red:
            return
        page.wait_for_timeout(50)
    raise AssertionError(f"the object is {'not ' if is_red else ''}shown")


def test_the_player_steps_and_plays(tmp_path: Path, open_results: Open) -> None:
    page = open_results(write_run(tmp_path))
    first = shown_frame(page)
    assert first >= FRAMES // 2  # where the light is known best
    page.keyboard.press("Home")
    wait_for_frame(page, 0)
    page.keyboard.press("ArrowRight")
    wait_for_frame(page, 1)
    page.keyboard.press("Shift+ArrowRight")
    wait_for_frame(page, 11)
    page.keyboard.press("ArrowLeft")
    wait_for_frame(page, 10)
    page.locator("#previous").click()
    wait_for_frame(page, 9)
    page.locator("#scrub").focus()
    page.keyboard.press("ArrowLeft")
    wait_for_frame(page, 8)
    page.locator("#scrub").fill("3")
    wait_for_frame(page, 3)
    page.locator("#times-title").click()
    page.keyboard.press(" ")
    assert page.locator("#play").get_attribute("aria-label") == "Pause"
    page.wait_for_function("() => Number(document.getElementById('scrub').value) >= 6")
    page.keyboard.press(" ")
    assert page.locator("#play").get_attribute("aria-label") == "Play"
    stopped = shown_frame(page)
    page.wait_for_timeout(300)
    assert shown_frame(page) == stopped


def test_it_plays_at_the_rate_at_which_it_was_taken(tmp_path: Path, open_results: Open) -> None:
    """A tenth of a second between frames, by the page's own clock; a busy machine shows fewer, never earlier."""
    page = open_results(write_run(tmp_path))
    page.keyboard.press("Home")
    passed = page.evaluate(
        """() => new Promise((done) => {
            const began = performance.now(), scrub = document.getElementById("scrub");
            document.getElementById("play").click();
            const look = (now) =>
                Number(scrub.value) >= 8 ? done([now - began, Number(scrub.value)]) : requestAnimationFrame(look);
            requestAnimationFrame(look);
        })"""
    )
    assert passed[0] / 1000 >= 0.1 * passed[1] - 0.1


def test_before_and_after(tmp_path: Path, open_results: Open) -> None:
    page = open_results(write_run(tmp_path))
    wait_until_red(page, True)  # at first the object is to the right of the divider
    split = page.locator("#split")
    split.focus()
    page.keyboard.press("End")
    assert split.input_value() == "100"
    wait_until_red(page, False)
    frame = shown_frame(page)
    page.keyboard.press("ArrowLeft")
    assert (split.input_value(), shown_frame(page)) == ("99", frame)  # the keys move the divider, not the frames
    page.keyboard.press("Home")
    wait_until_red(page, True)
    box = page.locator("#stage").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 20, box["y"] + 20)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.9 * box["width"], box["y"] + 40, steps=4)
    page.mouse.up()
    assert split.input_value() == "90"
    wait_until_red(page, False)
    page.locator("label:has([value=with])").click()
    wait_until_red(page, True)
    page.keyboard.press("b")
    wait_until_red(page, False)
    assert page.locator("[value=without]").is_checked()


def test_a_finger_moves_the_divider(tmp_path: Path, open_results: Open) -> None:
    page = open_results(write_run(tmp_path), SIZES[0])
    box = page.locator("#stage").bounding_box()
    assert box is not None
    page.touchscreen.tap(box["x"] + 0.25 * box["width"], box["y"] + 0.5 * box["height"])
    assert page.locator("#split").input_value() == "25"


def test_the_scan_is_drawn_and_turned(tmp_path: Path, open_results: Open) -> None:
    page = open_results(write_run(tmp_path))
    page.locator("#view").scroll_into_view_if_needed()
    before = drawn(page, "#view").astype(int)
    ground = before[2, 2]
    assert np.mean(np.abs(before - ground).max(2) > 20) > 0.05
    page.locator("#view").focus()
    frame = shown_frame(page)
    for _ in range(4):
        page.keyboard.press("ArrowLeft")
    turned = drawn(page, "#view").astype(int)
    assert np.mean(np.abs(turned - before).max(2) > 20) > 0.02
    assert shown_frame(page) == frame
    page.locator("#from-camera").click()
    assert page.locator("#from-camera").get_attribute("aria-pressed") == "true"
    through = drawn(page, "#view").astype(int)
    assert np.mean(np.abs(through - ground).max(2) > 20) > 0.4  # the wall fills the camera's view
    page.locator("#from-outside").click()
    assert page.locator("#from-camera").get_attribute("aria-pressed") == "false"
    assert np.mean(np.abs(drawn(page, "#view").astype(int) - before).max(2) > 20) < 0.01


def test_light_times_and_plan_are_those_of_the_frame(tmp_path: Path, open_results: Open) -> None:
    page = open_results(write_run(tmp_path))
    page.keyboard.press("Home")
    wait_for_frame(page, 0)
    places = page.locator("#places .place:visible")
    assert places.count() == 2
    assert "duck <b>.glb" in places.nth(0).inner_text()
    assert "Mostly from above" in places.nth(0).inner_text()
    assert "Sure to about 13°" in places.nth(0).inner_text()
    assert "the light is soft, 0" in page.locator("#plan-out").inner_text()
    assert "invisible: at most 0.25/255" in page.locator("#plan-out").inner_text()
    assert page.locator("#plan-run").inner_text().split("\n") == ["Rasterize", "Composite"]
    assert page.locator("#stages tr.total td").nth(0).inner_text() == "12.0"
    assert page.locator("#notes").is_hidden()
    page.keyboard.press("ArrowRight")
    wait_for_frame(page, 1)
    assert "the light is soft, 1" in page.locator("#plan-out").inner_text()
    assert "<script>alert(1)</script>" in page.locator("#notes").inner_text()
    assert page.locator("#stages tr.total td").nth(0).inner_text() == "13.0"
    bars = drawn(page, "#bars")
    assert np.std(bars) > 10
    ball = drawn(page, "#places .ball >> nth=0")
    assert np.std(ball) > 10


def test_a_frame_is_picked_in_the_chart(tmp_path: Path, open_results: Open) -> None:
    page = open_results(write_run(tmp_path))
    page.locator("#bars").scroll_into_view_if_needed()
    box = page.locator("#bars").bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + 44 + (box["width"] - 44) * 2.5 / FRAMES, box["y"] + 60)
    wait_for_frame(page, 2)


@pytest.mark.parametrize("size", SIZES, ids=["phone", "tablet", "desktop"])
def test_it_fits_and_axe_finds_nothing(tmp_path: Path, open_results: Open, size: tuple[int, int]) -> None:
    page = open_results(write_run(tmp_path, video=False), size)
    assert page.evaluate("() => document.documentElement.scrollWidth") <= size[0]
    small = page.evaluate(
        """() => [...document.querySelectorAll("button, select, #modes label")]
            .filter(each => Math.min(each.getBoundingClientRect().width, each.getBoundingClientRect().height) < 44)
            .map(each => each.id || each.textContent)"""
    )
    assert small == []
    page.evaluate((installed_modules() / "axe-core" / "axe.min.js").read_text("utf-8"))
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        found = page.evaluate(
            "async () => (await axe.run()).violations.map(({ id, nodes }) => [id, nodes.map((n) => n.html)])"
        )
        assert found == [], json.dumps(found)


def test_a_run_that_ended_early_says_so(tmp_path: Path, open_results: Open) -> None:
    with pytest.raises(KeyboardInterrupt):
        write_until(tmp_path, KeyboardInterrupt())
    page = open_results(tmp_path)
    assert "Ended early: interrupted, after 3 of 12 frames" in page.locator("#facts").inner_text()


def test_a_missing_picture_is_told(tmp_path: Path, open_results: Open) -> None:
    write_run(tmp_path)
    (tmp_path / "frames" / "000005.png").unlink()
    page = open_results(tmp_path, missing=True)
    page.locator("#scrub").fill("5")
    page.locator("#picture-said").filter(has_text="frames/000005.png is missing").wait_for()


def test_a_run_of_lights_alone(tmp_path: Path, open_results: Open) -> None:
    with OutputWriter(tmp_path, DESCRIPTION) as writer:
        for frame in range(3):
            writer.write_light(output_of(frame).light)
    page = open_results(tmp_path)
    page.locator("#picture-said").filter(has_text="light alone").wait_for()
    assert page.locator("#places .place:visible").count() == 2
    assert page.locator("#modes").is_hidden()


def test_one_frame_without_objects(tmp_path: Path, open_results: Open) -> None:
    only = output_of(0)
    assert only.captured is not None
    with OutputWriter(tmp_path, replace(DESCRIPTION, objects=(), total=1)) as writer:
        writer.write(replace(only, color=only.captured.color))
    page = open_results(tmp_path)
    assert page.locator("#divider").is_hidden()
    assert "no virtual object" in page.locator("#facts").inner_text()
    page.keyboard.press(" ")
    assert page.locator("#play").get_attribute("aria-label") == "Play"


def test_chromium_plays_the_video(tmp_path: Path, open_results: Open) -> None:
    pytest.importorskip("av")
    page = open_results(write_run(tmp_path, video=True))
    assert page.locator("#facts a").get_attribute("href") == "video.mp4"
    found = page.evaluate(
        """() => new Promise((done, fail) => {
            const video = Object.assign(document.createElement("video"), { src: "video.mp4", muted: true });
            document.body.append(video);
            video.onerror = () => fail(video.error.message);
            const shown = () => video.getVideoPlaybackQuality().totalVideoFrames;
            video.onended = () => done([video.videoWidth, video.videoHeight, video.duration, shown()]);
            video.play().catch(fail);
        })"""
    )
    assert found[:2] == [64, 48]
    assert found[2] == pytest.approx(1.1 + 1 / 30, abs=0.1)
    assert found[3] > 0
