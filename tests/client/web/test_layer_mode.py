"""Layer mode: what the server has drawn for an earlier frame, over the newest picture, where its camera sees it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Page

from protocol.frames import RgbdFrame
from server.service.serve import BackgroundServer
from tests.client.web.ball_scene import CAMERA, linear, look
from tests.client.web.conftest import OpenPage, wait_for_text
from tests.client.web.displayed import display
from tests.client.web.layer_drawing import (
    SLOW_S,
    STEP_DEG,
    WALL_CODE,
    colorful,
    composite,
    frame_at,
    is_ball,
    keep,
    turning,
)
from tests.client.web.layer_figures import errors_of
from tests.client.web.page import start_capture
from tests.client.web.received import Received
from tests.client.web.red_ball import DEGREES_PER_S, turned
from tests.client.web.sequence import of_device

NUMBER_PX = 10
"""Side of the corner that holds a picture's number, with what it is mixed with where the picture is enlarged."""


def open_layers(open_page: OpenPage, server: BackgroundServer, frames: list[RgbdFrame], **device: object) -> Page:
    """A page whose session has shown its first layer."""
    page = open_page(server.url, of_device(CAMERA, frames) | {"fps": DEGREES_PER_S / STEP_DEG} | device)
    page.locator("input[value=xr]").check()
    page.locator("[name=answer]").select_option("layer")
    start_capture(page)
    wait_for_text(page, "#picture-caption", "Frame")
    wait_for_text(page, "#state", "Live, captured here")
    return page


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
