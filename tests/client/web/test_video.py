"""What a browser captures goes as video where it is asked for and can be: the picture as it was, also after a loss."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from playwright.sync_api import Page

pytest.importorskip("av")

from protocol.h264 import is_key_picture
from protocol.messages import ColorImage
from server.service.serve import BackgroundServer
from tests.client.web.conftest import OpenPage, wait_for_text
from tests.client.web.page import start_capture
from tests.client.web.received import CAMERA, Received, frames_seen
from tests.client.web.sequence import STRAIGHT, of_device

LEAST_PSNR_DB = 30.0
PICTURES = 40


@pytest.fixture
def build_pipeline(received: Received) -> Callable[..., object]:
    return received.build


@pytest.fixture
def images(monkeypatch: pytest.MonkeyPatch) -> list[ColorImage]:
    """Every picture that the server reads."""
    from protocol.colors import ColorReader

    seen: list[ColorImage] = []
    decode = ColorReader.decode

    def noting(self: ColorReader, image: ColorImage) -> object:
        seen.append(image)
        return decode(self, image)

    monkeypatch.setattr(ColorReader, "decode", noting)
    return seen


def capture_as_video(page: Page) -> None:
    page.locator("input[name=source][value=xr]").check()
    page.locator("select[name=color]").select_option("h264")
    start_capture(page)


def psnr_db(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - b) ** 2)))


def test_colour_goes_as_video_and_arrives_as_it_was(
    server: BackgroundServer,
    received: Received,
    images: list[ColorImage],
    open_page: OpenPage,
    keep_picture: Callable[[Page, str], None],
) -> None:
    given = frames_seen()
    page = open_page(server.url, of_device(CAMERA, given, STRAIGHT, loops=True), (900, 700))
    page.locator("input[name=source][value=xr]").check()
    keep_picture(page, "capture_as_video")
    capture_as_video(page)
    got = received.wait(PICTURES)
    for frame in got[:PICTURES]:
        assert max(psnr_db(frame.color, one.color) for one in given) > LEAST_PSNR_DB
    assert {image.codec for image in images} == {"h264"}
    keys = [is_key_picture(image.data) for image in images]  # an encoder makes more of its own where the scene changes
    assert keys[0]
    assert keys.count(True) < len(keys) / 4


def test_a_picture_that_the_server_drops_is_followed_by_a_key_picture(
    server: BackgroundServer, received: Received, images: list[ColorImage], open_page: OpenPage
) -> None:
    page = open_page(server.url, of_device(CAMERA, frames_seen(), STRAIGHT, loops=True))
    capture_as_video(page)
    received.wait(5)
    (readers,) = server.service._parsers._videos
    readers.stop()  # the reader dies, and what it knew with it
    readers._stopped = False
    told = len(received.frames)
    received.wait(told + 10)
    assert [is_key_picture(image.data) for image in images].count(True) >= 2
    newest = received.frames[-1].color
    assert max(psnr_db(newest, one.color) for one in frames_seen()) > LEAST_PSNR_DB


def test_where_the_server_reads_no_video_it_goes_as_jpeg_and_says_so(
    server: BackgroundServer,
    received: Received,
    images: list[ColorImage],
    open_page: OpenPage,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("protocol.colors.IS_POSSIBLE", False)
    page = open_page(server.url, of_device(CAMERA, frames_seen(), STRAIGHT, loops=True))
    capture_as_video(page)
    received.wait(3)
    assert {image.codec for image in images} == {"jpeg"}
    wait_for_text(page, "#notes", "This server reads no video: colour is sent as JPEG.")
