"""Layer mode: what the server has drawn for an earlier frame, over the newest picture, where its camera sees it."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Page

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Wishes
from server.service.serve import BackgroundServer
from server.service.service import Service
from tests.client.web.ball_scene import CAMERA, linear, look
from tests.client.web.conftest import PICTURES, OpenPage, wait_for_text
from tests.client.web.displayed import display
from tests.client.web.layer_figures import errors_of
from tests.client.web.page import start_capture
from tests.client.web.received import Received
from tests.client.web.red_ball import DEGREES_PER_S, turned
from tests.client.web.sequence import of_device
from tests.service import fakes
from tests.service.fakes import FAKE_DEVICE, FakeResult, fake_mesh

SLOW_S = 0.3
STEP_DEG, REACH_DEG = 0.5, 10.0
WALL_CODE = 150
NUMBER_PX = 10
"""Side of the corner that holds a picture's number, with what it is mixed with where the picture is enlarged."""


class Drawing(fakes.FakePipeline):
    """A pipeline that takes its time to draw the ball, exactly."""

    def __init__(self, received: Received, takes_s: float) -> None:
        super().__init__(received.lab)
        self._received, self._takes_s = received, takes_s

    def process(self, frame: RgbdFrame, **_: Any) -> FakeResult:
        self._received.frames.append(frame)
        time.sleep(self._takes_s)
        return dataclasses.replace(super().process(frame), layer=look(frame.world_from_camera).layer())


@pytest.fixture
def received() -> Received:
    return Received()


@pytest.fixture
def serve(received: Received) -> Iterator[Callable[[float], BackgroundServer]]:
    """A server whose pipeline takes so many seconds for a frame."""
    running = []

    def start(takes_s: float) -> BackgroundServer:
        def build(_device: object, _camera: CameraModel, wishes: Wishes, *_room: object) -> Drawing:
            received.wishes.append(wishes)
            return Drawing(received, takes_s)

        service = Service(FAKE_DEVICE, pipeline_factory=build, mesh_loader=fake_mesh)
        running.append(BackgroundServer(service))
        return running[-1].__enter__()

    yield start
    for each in running:
        each.__exit__(None, None, None)


def frame_at(pose: NDArray[np.float64], index: int, color: NDArray[np.uint8] | None = None) -> RgbdFrame:
    wall = np.full((CAMERA.height, CAMERA.width, 3), WALL_CODE, np.uint8) if color is None else color
    return RgbdFrame(index, index / 30, wall, look(pose).wall_depth, pose)


def turning() -> list[RgbdFrame]:
    angles = np.arange(-REACH_DEG, REACH_DEG + STEP_DEG / 2, STEP_DEG)
    return [frame_at(turned(angle), index) for index, angle in enumerate(angles)]


def open_layers(open_page: OpenPage, server: BackgroundServer, frames: list[RgbdFrame], **device: object) -> Page:
    """A page whose session has shown its first layer."""
    page = open_page(server.url, of_device(CAMERA, frames) | {"fps": DEGREES_PER_S / STEP_DEG} | device)
    page.locator("input[value=xr]").check()
    page.locator("[name=answer]").select_option("layer")
    start_capture(page)
    wait_for_text(page, "#picture-caption", "Frame")
    wait_for_text(page, "#state", "Live, captured here")
    return page


def keep(name: str, rgb: NDArray[Any]) -> None:
    PICTURES.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(PICTURES / f"{name}.png"), cv2.cvtColor(rgb.astype(np.uint8), cv2.COLOR_RGB2BGR))


def colorful() -> NDArray[np.uint8]:
    """[h, w, 3] every channel from dark to bright."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    return np.stack([20 + 1.4 * u, 10 + 2 * v, 250 - u - 0.7 * v], axis=-1).astype(np.uint8)


def test_over_its_own_picture_a_layer_is_the_linear_composition_and_others_find_webgl_as_they_left_it(
    serve: Callable[[float], BackgroundServer],
    received: Received,
    open_page: OpenPage,
    keep_picture: Callable[[Page, str], None],
) -> None:
    pose, picture = turned(4.0), colorful()
    page = open_layers(open_page, serve(0.0), [frame_at(pose, 0, picture)], isOdd=True)
    assert received.wishes[0].answer == "layer"
    shown = display(page, 3)[-1]
    keep_picture(page, "layer_mode")
    keep("layer_mode_drawn", shown.rgb)
    expected = look(pose).over(picture)
    error = np.abs(shown.rgb - expected)
    error[:NUMBER_PX, :NUMBER_PX] = 0  # the picture's number
    assert error.max() <= 2
    assert np.abs(expected - picture).max(axis=-1)[CAMERA.height // 4 :].max() > 40  # there is something virtual
    assert page.evaluate("() => device.changed") == []


def test_the_cameras_picture_is_of_now_however_slow_the_server_is(
    serve: Callable[[float], BackgroundServer], open_page: OpenPage
) -> None:
    page = open_layers(open_page, serve(SLOW_S), turning())
    shown = display(page, 60)
    assert max(each.picture_age for each in shown) <= 2
    assert min(each.picture_age for each in shown) >= 0
    layers = {each.layer_frame for each in shown}
    assert len(layers) < len(shown) / 2  # one layer is seen from many places
    wait_for_text(page, "#age-picture", "0")
    assert float(page.locator("#age-layer").text_content() or "") > 1e3 * SLOW_S


def is_ball(rgb: NDArray[Any]) -> NDArray[np.bool_]:
    """Redder than the wall."""
    return linear(rgb[..., 0]) - linear(rgb[..., 1]) > 0.06


def is_shadow(rgb: NDArray[Any]) -> NDArray[np.bool_]:
    """Darker than the wall, and not the ball."""
    dark = linear(rgb[..., 1]) < 0.6 * linear(np.uint8(WALL_CODE))
    near_ball = cv2.dilate(is_ball(rgb).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    dark[:NUMBER_PX, :NUMBER_PX] = False
    return dark & ~near_ball


@pytest.mark.parametrize("scale", [1, 2])
def test_virtual_things_and_shadows_are_where_the_newest_camera_sees_them(
    serve: Callable[[float], BackgroundServer], received: Received, open_page: OpenPage, scale: int
) -> None:
    frames = turning()
    page = open_layers(open_page, serve(SLOW_S), frames, scale=scale)
    shown = display(page, 40)
    for shows in (is_ball, is_shadow):
        errors = errors_of(
            shown, CAMERA, shows, lambda frame, shows=shows: shows(composite(frame)), frames, received.frames
        )
        assert errors.still_px[:, 0].mean() > 4  # they would be far off
        assert (errors.shares < 0.25).all()
        assert errors.moved_px.mean(axis=0).max() < 0.5
    keep(f"layer_mode_moved_{scale}", shown[int(np.argmax(errors.still_px[:, 0]))].rgb)


def composite(frame: RgbdFrame) -> NDArray[np.uint8]:
    """[h, w, 3] sRGB: what its camera would see."""
    wall = np.full((CAMERA.height, CAMERA.width, 3), WALL_CODE, np.uint8)
    picture: NDArray[np.uint8] = look(frame.world_from_camera).over(wall).round().astype(np.uint8)
    return picture
