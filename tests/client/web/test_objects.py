"""Objects by touch, against the real service: a finger places a vase where it points, and its shadow falls there."""

from __future__ import annotations

import base64
import time
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Page

from client.laptop.source import open_source
from protocol.frames import CameraModel, RgbdFrame
from server.opencl.device import Device
from server.pipeline import Pipeline
from server.scene.mesh import Mesh
from server.scene.placement import Placement
from server.service.serve import BackgroundServer, start_in_background
from server.service.service import Service
from tests.client.web.conftest import PATIENCE_MS, OpenPage, wait_for_text
from tests.client.web.sequence import of_device
from tests.client.web.test_capture import start_capture

SOURCE = "synthetic:table?light=7&size=160x120&frames=1"
SIZE = (600, 800)
TOUCHED = (112.0, 69.0)
"""Pixel of the table that a finger points at."""
DRAGGED_TO = (52.0, 95.0)
"""Another one, at the front."""


class Watched(Pipeline):
    """A real pipeline that tells what it was asked."""

    asked: list[tuple[str, Placement | None]]

    def place_object(self, object_id: str, mesh: Mesh, placement: Placement) -> tuple[str, ...]:
        notes = super().place_object(object_id, mesh, placement)
        self.asked.append(("place", placement))
        return notes

    def move_object(self, object_id: str, placement: Placement) -> None:
        super().move_object(object_id, placement)
        self.asked.append(("move", placement))

    def remove_object(self, object_id: str) -> None:
        super().remove_object(object_id)
        self.asked.append(("remove", None))


@pytest.fixture
def asked() -> list[tuple[str, Placement | None]]:
    return []


@pytest.fixture
def server(device: Device, asked: list) -> Iterator[BackgroundServer]:
    def build(*given: object) -> Watched:
        pipeline = Watched(*given)
        pipeline.asked = asked
        return pipeline

    with start_in_background(Service(device, pipeline_factory=build)) as server:
        yield server


def still() -> tuple[CameraModel, RgbdFrame]:
    source = open_source(SOURCE)
    assert source.up == (0.0, 1.0, 0.0)  # as in WebXR
    return source.camera, source[0]


def point_under(camera: CameraModel, frame: RgbdFrame, u: float, v: float) -> NDArray[np.float64]:
    z = frame.depth[round(v), round(u)] * camera.depth_scale_m
    point = np.array([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z, 1.0])
    return (frame.world_from_camera @ point)[:3]


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


def wait_until(holds: Callable[[], bool]) -> None:
    until_s = time.monotonic() + PATIENCE_MS / 1e3
    while not holds():
        assert time.monotonic() < until_s
        time.sleep(0.02)


def wait_for(asked: list, count: int) -> tuple[str, Placement | None]:
    wait_until(lambda: len(asked) >= count)
    return asked[-1]


def view(frame: RgbdFrame) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """camera_from_world as OpenCV's rotation vector and translation."""
    camera_from_world = np.linalg.inv(frame.world_from_camera)
    return cv2.Rodrigues(camera_from_world[:3, :3])[0], camera_from_world[:3, 3]


def matrix(camera: CameraModel) -> NDArray[np.float64]:
    """[3, 3] of the lens."""
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])


def on_screen(page: Page, u: float, v: float) -> tuple[float, float]:
    """Where on the page a pixel of the picture is."""
    box = page.locator("#picture").bounding_box()
    width, height = page.evaluate("() => [picture.width, picture.height]")
    assert box is not None
    scale = min(box["width"] / width, box["height"] / height)
    left = box["x"] + (box["width"] - scale * width) / 2
    top = box["y"] + (box["height"] - scale * height) / 2
    return left + scale * (u + 0.5), top + scale * (v + 0.5)


def test_a_vase_is_placed_by_touch_throws_a_shadow_and_is_moved_turned_and_deleted(
    server: BackgroundServer, asked: list, open_page: OpenPage, keep_picture: Callable[[Page, str], None]
) -> None:
    camera, frame = still()
    page = open_page(server.url, of_device(camera, [frame], loops=True), size=SIZE)
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


def may_be_seen(camera: CameraModel, frame: RgbdFrame, foot: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[height, width] where the vase can be, with a margin."""
    camera_from_world = np.linalg.inv(frame.world_from_camera)

    def pixel(height_m: float, aside_m: float) -> tuple[int, int]:
        x, y, z = camera_from_world[:3, :3] @ (foot + np.array([0.0, height_m, 0.0])) + camera_from_world[:3, 3]
        return round(camera.fx * (x + aside_m) / z + camera.cx), round(camera.fy * y / z + camera.cy)

    mask = np.zeros((camera.height, camera.width), np.uint8)
    corners = [pixel(height, aside) for height, aside in ((-0.08, -0.1), (-0.08, 0.1), (0.32, 0.1), (0.32, -0.1))]
    cv2.fillConvexPoly(mask, np.array(corners), 1)
    return mask == 1
