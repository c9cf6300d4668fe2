"""The page sends what the link carries: quality, size and rate, over a proxy that lets little through."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median

import cv2
import numpy as np
import pytest
from msgspec import structs
from playwright.sync_api import Page

from client.streaming.coding import frame_message
from protocol.frames import CameraModel, RgbdFrame
from protocol.h264 import is_key_picture
from protocol.messages import ColorImage, Hello, Wishes
from protocol.recording import write_message
from server.service.serve import BackgroundServer
from tests.client.web.conftest import OpenPage, wait_for_text
from tests.client.web.page import start_capture, start_recording
from tests.client.web.sequence import of_device
from tests.servers import fake_server
from tests.service.fakes import FakePipeline, FakeResult, Lab
from tests.service.proxy import impaired

CAMERA = CameraModel(width=480, height=360, fx=400.0, fy=400.0, cx=239.5, cy=179.5, depth_scale_m=0.001)
DEPTH_SIZE = (36, 48)
BYTES_PER_S = 2e6 / 8
DELAY_S = 0.02
COMPUTED_S = 0.25
"""Of a frame, where the page must see that a link is free: behind a slow server a frame may be on its way for longer,
so that a busy machine, which takes tens of milliseconds more now and then, is not taken for a narrow link."""
SETTLED, FULL, LOOKED_AT = 12, 4, 6
"""Answers until the page has found its rung; until the link is full, where it looks for none; those whose age is then
looked at."""
LONGEST_S = 60.0
YOUNGER = 0.75
"""Age of answered frames with adaptation over the age without, at most. Seen: 0.25 and 0.59."""


@dataclass
class Seen:
    """Every picture that the server was sent."""

    images: list[ColorImage] = field(default_factory=list)

    def wait(self, is_enough: Callable[[list[ColorImage]], bool]) -> None:
        until_s = time.monotonic() + LONGEST_S
        while not is_enough(self.images):
            assert time.monotonic() < until_s, [(image.width, len(image.data)) for image in self.images]
            time.sleep(0.05)


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> Seen:
    from protocol.colors import ColorReader

    seen, decode = Seen(), ColorReader.decode

    def noting(self: ColorReader, image: ColorImage) -> object:
        seen.images.append(image)
        return decode(self, image)

    monkeypatch.setattr(ColorReader, "decode", noting)
    return seen


class _Brief(FakePipeline):
    """Answers with a picture that takes few bytes, so that sending is what the link limits."""

    def process(self, frame: RgbdFrame, **wanted: bool) -> FakeResult:
        return replace(super().process(frame, **wanted), color=np.full_like(frame.color, 128))


class _Computing(_Brief):
    """Takes its time, and says how much."""

    def process(self, frame: RgbdFrame, **wanted: bool) -> FakeResult:
        began_s = time.perf_counter()
        time.sleep(COMPUTED_S)
        result = super().process(frame, **wanted)
        total = (time.perf_counter() - began_s) * 1e3
        return replace(result, timings=structs.replace(result.timings, total=total))


@pytest.fixture
def build_pipeline() -> Callable[..., object]:
    return lambda *_: _Brief(Lab())


def textured(count: int = 3) -> list[RgbdFrame]:
    """Pictures as full of detail as a room: about 100 kB at the best, 10 kB at the cheapest."""
    frames = []
    for index in range(count):
        random = np.random.default_rng(index)
        noise = random.integers(0, 256, (CAMERA.height // 2, CAMERA.width // 2, 3), np.uint8)
        color = cv2.resize(noise, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_CUBIC)
        depth = np.full(DEPTH_SIZE, 1500 + index, np.uint16)
        frames.append(RgbdFrame(index, index / 30, color, depth, np.eye(4)))
    return frames


def panned(count: int = 8) -> list[RgbdFrame]:
    """One picture past which the camera moves, there and back: what video is made for."""
    noise = np.random.default_rng(1).integers(0, 256, (CAMERA.height // 4, CAMERA.width // 4 + count, 3), np.uint8)
    wide = cv2.resize(noise, (CAMERA.width + 4 * count, CAMERA.height), interpolation=cv2.INTER_CUBIC)
    frames = []
    for index, place in enumerate([*range(count), *range(count - 2, 0, -1)]):
        color = np.ascontiguousarray(wide[:, 3 * place : 3 * place + CAMERA.width])
        frames.append(RgbdFrame(index, index / 30, color, np.full(DEPTH_SIZE, 1500, np.uint16), np.eye(4)))
    return frames


def note_ages(page: Page) -> None:
    """Keep how old each frame was when its answer was there: what the page itself measures."""
    page.evaluate(
        """() => {
          window.ages = [];
          const read = (stage) => Number(document.getElementById(`latency-${stage}`).textContent);
          const note = () => window.ages.push(read("packed") + read("answered"));
          const shown = document.getElementById("latency-all");
          new MutationObserver(note).observe(shown, { childList: true, characterData: true, subtree: true });
        }"""
    )


def settled_age_ms(page: Page, after: int = SETTLED) -> float:
    page.wait_for_function("count => window.ages.length >= count", arg=after + LOOKED_AT, timeout=1e3 * LONGEST_S)
    return median(page.evaluate("() => window.ages")[after:])


def is_best(image: ColorImage, first: ColorImage) -> bool:
    return image.width == CAMERA.width and len(image.data) > 0.9 * len(first.data)


@pytest.fixture
def computing() -> Iterator[BackgroundServer]:
    """A server whose pipelines take a real one's time."""
    with fake_server(lambda *_: _Computing(Lab())) as server:
        yield server


def test_a_narrow_link_gets_smaller_pictures_younger_frames_and_the_best_again_when_it_eases(
    computing: BackgroundServer, seen: Seen, open_page: OpenPage, keep_picture: Callable[[Page, str], None]
) -> None:
    device = of_device(CAMERA, textured(), loops=True)
    age_without_ms = age_without_adapting_ms(computing, seen, open_page)
    seen.images.clear()
    narrow = impaired(computing.url, DELAY_S, BYTES_PER_S / 2)
    with narrow as link, closing(open_page(link.url, device, (900, 900))) as page:
        note_ages(page)
        start_capture(page)
        wait_for_text(page, "#sending", "Sent now: full size, quality 90")
        wait_for_text(page, "#sending", "half size, quality")
        age_ms = settled_age_ms(page)
        first, last = seen.images[0], seen.images[-1]
        assert (first.width, first.height) == (CAMERA.width, CAMERA.height)
        assert (last.width, last.height) == (CAMERA.width // 2, CAMERA.height // 2)
        assert len(last.data) < len(first.data) / 4
        page.locator("#full").click()  # back to the whole page
        page.locator("#details > summary").click()
        page.locator("#sending").focus()
        assert page.evaluate("document.activeElement.id") == "sending"
        assert page.locator("#sending").get_attribute("aria-live") is None
        keep_picture(page, "sending_half")
        assert age_ms < YOUNGER * age_without_ms

        eased = len(seen.images)
        link.bytes_per_s = None
        wait_for_text(page, "#sending", "Sent now: full size, quality 90", times=4)  # rung by rung
        # On a busy machine it may have left the best again.
        seen.wait(lambda images: any(is_best(image, first) for image in images[eased:]))
        page.goto("about:blank")


def age_without_adapting_ms(server: BackgroundServer, seen: Seen, open_page: OpenPage) -> float:
    """Age of frames over the same link where the page sends all at the best quality."""
    device = of_device(CAMERA, textured(), loops=True)
    narrow = impaired(server.url, DELAY_S, BYTES_PER_S / 2)
    with narrow as link, closing(open_page(link.url, device, (900, 900))) as page:
        note_ages(page)
        page.locator("input[name=source][value=xr]").check()
        page.locator("[name=adapt]").select_option("no")
        start_capture(page)
        age_ms = settled_age_ms(page, FULL)
        assert {image.width for image in seen.images} == {CAMERA.width}
        wait_for_text(page, "#sending", "Sent now: full size, quality 90")
        page.goto("about:blank")
    return age_ms


@pytest.mark.skipif(importlib.util.find_spec("av") is None, reason="the server reads no video without PyAV")
def test_video_gets_fewer_bits_and_goes_on(server: BackgroundServer, seen: Seen, open_page: OpenPage) -> None:
    device = of_device(CAMERA, panned(), loops=True)
    with impaired(server.url, DELAY_S, BYTES_PER_S) as link, closing(open_page(link.url, device, (900, 900))) as page:
        page.locator("input[name=source][value=xr]").check()
        page.locator("select[name=color]").select_option("h264")
        link.bytes_per_s = BYTES_PER_S / 6
        start_capture(page)
        wait_for_text(page, "#sending", "% of its bit rate")  # each share on the way is said for two pictures only
        seen.wait(takes_fewer_bits)
        page.goto("about:blank")
    assert {(image.codec, image.width) for image in seen.images} == {("h264", CAMERA.width)}
    keys = [is_key_picture(image.data) for image in seen.images]
    assert keys[0]
    assert keys.count(True) < len(keys) / 3


def takes_fewer_bits(video: list[ColorImage]) -> bool:
    """Ten pictures in a row take half of what the first ones took; key pictures are left out."""
    sizes = [len(image.data) for image in video if not is_key_picture(image.data)]
    return len(sizes) > 20 and median(sizes[-10:]) < 0.5 * median(sizes[:3])


def test_a_recording_is_sent_as_it_is_when_the_link_is_free(
    server: BackgroundServer, seen: Seen, open_page: OpenPage, tmp_path: Path
) -> None:
    """Frames wait in the page for the link, not in the link, so they are not older than the link makes them."""
    messages = [frame_message(frame, CAMERA) for frame in recorded_frames()]
    with (tmp_path / "textured.rec").open("wb") as file:
        for message in (Hello(client="test", camera=CAMERA, wishes=Wishes(poses="given")), *messages):
            write_message(file, message)
    ages_ms = {}
    for adapts in ("yes", "no"):
        narrow = impaired(server.url, DELAY_S, BYTES_PER_S / 2)
        with narrow as link, closing(open_page(link.url, size=(900, 900))) as page:
            note_ages(page)
            page.locator("input[name=source][value=recorded]").check()
            page.locator("[name=adapt]").select_option(adapts)
            start_recording(page, tmp_path / "textured.rec")
            wait_for_text(page, "#sending", "Sent now: as recorded, ")
            ages_ms[adapts] = settled_age_ms(page, SETTLED if adapts == "yes" else FULL)
            page.goto("about:blank")
    assert {image.data for image in seen.images} <= {message.color.data for message in messages}
    assert ages_ms["yes"] < YOUNGER * ages_ms["no"]


def recorded_frames() -> list[RgbdFrame]:
    """The same pictures with depth of their size."""
    return [replace(frame, depth=np.full((CAMERA.height, CAMERA.width), 1500, np.uint16)) for frame in textured()]
