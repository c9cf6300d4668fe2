"""What a browser captures arrives as it was: the page's own capture code, with a device that shows known frames."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import closing
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from playwright.sync_api import Page

from protocol.messages import Wishes
from server.service.serve import BackgroundServer
from tests.client.web.conftest import OpenPage, wait_for_text
from tests.client.web.page import start_capture
from tests.client.web.received import CAMERA, DEPTH_SIZE, FRAMES, Received, frames_seen
from tests.client.web.sequence import ACROSS, STRAIGHT, of_device
from tests.service.proxy import impaired

ROOM = "kitchen"
LEAST_PSNR_DB = 32.0


@pytest.fixture
def build_pipeline(received: Received) -> Callable[..., object]:
    return received.build


@pytest.fixture
def server_options() -> dict[str, object]:
    """Rooms that do nothing."""
    room = SimpleNamespace(close=lambda: None, key_digest=None)
    return {"room_factory": lambda _wishes, _name: room}


def degrees_between(a: np.ndarray, b: np.ndarray) -> float:
    return math.degrees(np.linalg.norm(cv2.Rodrigues(a[:3, :3].T @ b[:3, :3])[0]))


@pytest.mark.parametrize("turned", [STRAIGHT, ACROSS], ids=["straight", "across"])
def test_colour_depth_pose_and_lens_arrive_as_they_were(
    server: BackgroundServer, received: Received, open_page: OpenPage, turned: object
) -> None:
    given = frames_seen()
    page = open_page(f"{server.url}/?room={ROOM}&key=secret", of_device(CAMERA, given, turned))
    start_capture(page)
    got = received.wait(FRAMES - 1)  # the first says which camera it is and is not sent
    camera = received.cameras[0]
    for name in ("width", "height", "fx", "fy", "cx", "cy"):
        assert getattr(camera, name) == pytest.approx(getattr(CAMERA, name), abs=1e-4)
    assert camera.depth_scale_m == pytest.approx(CAMERA.depth_scale_m, rel=1e-9)
    lens, (height, width) = camera.depth, DEPTH_SIZE
    assert lens is not None
    assert (lens.width, lens.height) == (width, height)
    assert lens.fx == pytest.approx(CAMERA.fx * width / CAMERA.width, abs=1e-4)
    assert lens.cy == pytest.approx((CAMERA.cy + 0.5) * height / CAMERA.height - 0.5, abs=1e-4)
    for frame, put_in in zip(got, given[1:], strict=False):
        assert np.array_equal(frame.depth, put_in.depth)
        assert np.abs(frame.world_from_camera[:3, 3] - put_in.world_from_camera[:3, 3]).max() < 1e-3
        assert degrees_between(frame.world_from_camera, put_in.world_from_camera) < 0.1
        assert cv2.PSNR(np.ascontiguousarray(frame.color), put_in.color) > LEAST_PSNR_DB
    hello = received.hellos[0]
    assert hello is not None
    assert (hello.room, hello.room_key, hello.keep_s) == (ROOM, "secret", 30.0)
    assert hello.wishes == Wishes(up=(0.0, 1.0, 0.0))  # the form shows what is the default everywhere


def test_a_lost_connection_is_resumed_and_the_picture_goes_on(
    server: BackgroundServer,
    received: Received,
    open_page: OpenPage,
    keep_picture: Callable[[Page, str], None],
) -> None:
    device = of_device(CAMERA, frames_seen(3), loops=True)
    with (
        impaired(server.url) as proxy,
        closing(open_page(proxy.url, device)) as page,
    ):  # it would come back to the proxy
        start_capture(page)
        received.wait(3)
        wait_for_text(page, "#state", "Live, captured here")
        proxy.refuses = True
        proxy.cut()
        wait_for_text(page, "#state", "Disconnected")
        keep_picture(page, "cut")
        before = len(received.frames)
        proxy.refuses = False
        received.wait(before + 3)
        wait_for_text(page, "#state", "Live, captured here")
        assert len(received.hellos) == 1  # resumed, not begun anew
        page.locator("#stop").click()
        wait_for_text(page, "#state", "waiting for a session")


def test_a_plain_camera_joins_a_room_by_a_marker_and_sends_no_depth(
    server: BackgroundServer, received: Received, open_page: OpenPage
) -> None:
    page = open_page(server.url)
    wait_for_text(page, "#lacks-xr", "augmented reality")
    assert page.locator("input[value=xr]").is_disabled()
    start_capture(page, "camera")
    wait_for_text(page, "#capture-said", "name a room that somebody else scans")
    page.locator("[name=room]").fill(ROOM)
    page.locator("#start").click()
    wait_for_text(page, "#capture-said", "Say which marker both cameras see")
    page.locator("[name=marker]").fill("7")
    page.locator("#start").click()
    frame = received.wait(1)[0]
    hello = received.hellos[0]
    assert hello is not None
    assert hello.marker is not None
    assert (hello.room, hello.marker.id, hello.marker.side_m) == (ROOM, 7, 0.1)
    assert not frame.has_depth
    assert frame.world_from_camera is None
    assert frame.color.std() > 10  # Chromium's test picture
