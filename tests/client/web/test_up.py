"""In a room that somebody else has opened, with another idea of what is up, objects stand and are moved by that."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from msgspec import structs

from protocol.frames import RgbdFrame
from server.client_session import FrameTurn
from server.service.serve import BackgroundServer
from tests.client.web.conftest import OpenPage, wait_for_text
from tests.client.web.page import start_capture, wait_until
from tests.client.web.sequence import of_device
from tests.client.web.wall import CAMERA, plane
from tests.service.fakes import FakePipeline, FakeResult, Lab

UP = cv2.Rodrigues(np.array([0.0, 0.0, 0.5]))[0] @ np.array([0.0, 1.0, 0.0])
"""Leaning by 29 degrees to the left."""


class _Leaning(FakePipeline):
    def process(self, frame: RgbdFrame, *, watched: bool = False, turn: FrameTurn | None = None) -> FakeResult:
        result = super().process(frame, watched=watched, turn=turn)
        return dataclasses.replace(result, light=structs.replace(result.light, up=tuple(UP.tolist())))


@pytest.fixture
def build_pipeline(lab: Lab) -> Callable[..., object]:
    return lambda *_: _Leaning(lab)


def test_what_is_level_is_so_in_the_room(server: BackgroundServer, lab: Lab, open_page: OpenPage, keep_picture) -> None:
    page = open_page(server.url, of_device(CAMERA, [plane()], loops=True))
    start_capture(page)
    wait_for_text(page, "#state", "Live, captured here")
    page.locator("#place").focus()
    page.keyboard.press("Enter")
    wait_for_text(page, "#object-said", "placed.")

    def places() -> list[np.ndarray]:
        return [np.array(entry[-1].position_m) for entry in lab.log if entry[0] in ("place", "move")]

    wait_until(lambda: len(places()) >= 1)
    for key in ("Shift+ArrowRight", "Shift+ArrowUp"):
        count = len(places())
        page.keyboard.press(key)
        wait_until(lambda count=count: len(places()) > count)
    keep_picture(page, "leaning_room")
    start, right, away = places()[-3:]
    expected = np.cross(UP, [0.0, 0.0, -1.0])  # level, as the camera's right is but for its lean
    assert right - start == pytest.approx(-0.1 * expected / np.linalg.norm(expected), abs=1e-6)
    assert away - right == pytest.approx([0.0, 0.0, -0.1], abs=1e-6)
