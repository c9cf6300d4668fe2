"""Objects by touch, against the real service: a finger places a vase where it points, and its shadow falls there."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Page

from client.options.source import open_source
from protocol.frames import CameraModel, RgbdFrame
from server.service.serve import BackgroundServer
from tests.client.web.conftest import OpenPage, wait_for_text
from tests.client.web.page import newer_pictures, on_screen, picture, start_capture, wait_until
from tests.client.web.sequence import of_device
from tests.client.web.visible_silhouette import may_be_seen
from tests.client.web.watched import SIZE, TOUCHED, point_under, wait_for

SOURCE = "synthetic:table?light=7&size=160x120&frames=1"
DRAGGED_TO = (52.0, 95.0)
"""Another one, at the front."""


def still() -> tuple[CameraModel, RgbdFrame]:
    source = open_source(SOURCE)
    assert source.up == (0.0, 1.0, 0.0)  # as in WebXR
    return source.camera, source[0]


def view(frame: RgbdFrame) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """camera_from_world as OpenCV's rotation vector and translation."""
    camera_from_world = np.linalg.inv(frame.world_from_camera)
    return cv2.Rodrigues(camera_from_world[:3, :3])[0], camera_from_world[:3, 3]


def matrix(camera: CameraModel) -> NDArray[np.float64]:
    """[3, 3] of the lens."""
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])


def test_a_vase_is_placed_by_touch_throws_a_shadow_and_is_moved_turned_and_deleted(
    real_server: BackgroundServer, asked: list, open_page: OpenPage, keep_picture: Callable[[Page, str], None]
) -> None:
    camera, frame = still()
    page = open_page(real_server.url, of_device(camera, [frame], loops=True), size=SIZE)
    start_capture(page)
    wait_for_text(page, "#state", "Live, captured here")
    newer_pictures(page)
    before = picture(page)
    assert np.abs(before - cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)).mean() < 4  # nothing virtual: the camera's

    page.locator("#place").click()
    page.touchscreen.tap(*on_screen(page, *TOUCHED))
    kind, placed = wait_for(asked, 1)
    assert kind == "place"
    assert np.abs(np.array(placed.position_m) - point_under(camera, frame, *TOUCHED)).max() < 0.01
    newer_pictures(page)
    keep_picture(page, "placed")
    after = picture(page)
    vase = may_be_seen(camera, frame, np.array(placed.position_m))
    assert np.abs(after - before)[vase].mean() > 15
    darker = (before - after)[~vase]
    assert (darker > 6).sum() > 80  # its shadow, on the table
    assert (darker < -6).sum() < 0.2 * (darker > 6).sum()

    page.locator("#turn-left").click()
    assert wait_for(asked, 2)[1].yaw_deg == pytest.approx(15.0)
    page.locator("#picture-frame").focus()
    page.keyboard.press("Shift+ArrowLeft")
    kind, moved = wait_for(asked, 3)
    assert kind == "move"
    shift = np.array(moved.position_m) - placed.position_m
    right = frame.world_from_camera[:3, 0] * [1, 0, 1]
    assert shift == pytest.approx(-0.1 * right / np.linalg.norm(right), abs=1e-6)
    newer_pictures(page)
    keep_picture(page, "moved")

    where = cv2.projectPoints(np.array(moved.position_m), *view(frame), matrix(camera), None)[0].ravel()
    page.mouse.move(*on_screen(page, *where - [0, 8]))
    page.mouse.down()
    page.mouse.move(*on_screen(page, *DRAGGED_TO), steps=3)
    page.mouse.up()
    here = point_under(camera, frame, *DRAGGED_TO)
    wait_until(lambda: np.abs(np.array(asked[-1][1].position_m) - here).max() < 0.01)

    page.locator("#picture-frame").focus()
    page.keyboard.press("Delete")
    wait_until(lambda: asked[-1][0] == "remove")
    newer_pictures(page)
    assert np.abs(picture(page) - before).mean() < 2
