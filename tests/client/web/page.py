"""What a person does on the page, and what they see of it."""

from __future__ import annotations

import base64
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import Page

from tests.client.web.constants import PATIENCE_MS


def start_capture(page: Page, source: str = "xr") -> None:
    page.locator(f"input[name=source][value={source}]").check()
    page.locator("#start").click()


def start_recording(page: Page, path: Path, repeat: str = "loop") -> None:
    page.locator("input[name=source][value=recorded]").check()
    page.locator("[name=repeat]").select_option(repeat)
    page.locator("[name=recording]").set_input_files(path)
    page.locator("#start").click()


def picture(page: Page) -> NDArray[np.float64]:
    """[height, width] luma of what the page shows."""
    url = page.evaluate("() => document.getElementById('picture').toDataURL('image/png')")
    png = np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8)
    return cv2.imdecode(png, cv2.IMREAD_COLOR_RGB) @ np.array([0.2126, 0.7152, 0.0722])


def newer_pictures(page: Page, count: int = 3) -> None:
    """Until pictures of frames that were captured from now on are shown."""
    caption = "() => Number(document.getElementById('picture-caption').textContent.match(/Frame (\\d+)/)?.[1] ?? -1)"
    first = page.evaluate(caption)
    page.wait_for_function(f"first => ({caption})() >= first + {count}", arg=first)


def said_by(page: Page, *selectors: str) -> dict[str, str | None]:
    """What the page tells a person, and what these elements say: for a test that waited in vain."""
    names = [*selectors, "#state", "#stage-said", "#capture-said", "#object-said"]
    texts = page.evaluate("names => names.map(name => document.querySelector(name)?.textContent ?? null)", names)
    return dict(zip(names, texts, strict=True))


def wait_until(holds: Callable[[], bool], page: Page | None = None) -> None:
    """`page`: its events are handled meanwhile."""
    until_s = time.monotonic() + PATIENCE_MS / 1e3
    while not holds():
        assert time.monotonic() < until_s, page and said_by(page)
        if page is None:
            time.sleep(0.02)
        else:
            page.wait_for_timeout(20)


def wait_for_drawing(page: Page, count: int = 10) -> None:
    """Until the page has drawn so many times."""
    page.evaluate(
        """count => new Promise(done => {
        const draw = () => count-- > 0 ? requestAnimationFrame(draw) : done();
        draw();
    })""",
        count,
    )


def on_screen(page: Page, u: float, v: float) -> tuple[float, float]:
    """Where on the page a pixel of the picture is."""
    box = page.locator("#picture").bounding_box()
    width, height = page.evaluate("() => [picture.width, picture.height]")
    assert box is not None
    scale = min(box["width"] / width, box["height"] / height)
    left = box["x"] + (box["width"] - scale * width) / 2
    top = box["y"] + (box["height"] - scale * height) / 2
    return left + scale * (u + 0.5), top + scale * (v + 0.5)
