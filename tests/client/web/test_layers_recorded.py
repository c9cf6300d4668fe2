"""Layer mode over a recorded sequence, which the page itself displays."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from msgspec import structs
from numpy.typing import NDArray
from playwright.sync_api import Page

from client.display.layers import shown_picture
from protocol.frames import CameraModel, RgbdFrame
from protocol.images import encode_color, encode_depth
from protocol.messages import Frame, Hello
from protocol.recording import write_message
from server.service.serve import BackgroundServer
from tests.client.web.ball_scene import CAMERA, look
from tests.client.web.conftest import OpenPage, wait_for_text
from tests.client.web.displayed import Displayed
from tests.client.web.layer_drawing import (
    SLOW_S,
    colorful,
    composite,
    frame_at,
    is_ball,
    keep,
    turning,
)
from tests.client.web.layer_figures import errors_of
from tests.client.web.page import wait_for_drawing
from tests.client.web.received import Received
from tests.client.web.red_ball import turned

DISTORTION = (0.12, -0.2, 0.004, -0.003, 0.05)
_PICTURE = """() => ({
  url: document.getElementById("picture").toDataURL("image/png"),
  caption: document.getElementById("picture-caption").textContent,
})"""


def record(path: Path, camera: CameraModel, frames: list[RgbdFrame]) -> Path:
    """As the Python client does, without loss; the number of each frame in its upper left corner."""
    with path.open("wb") as file:
        write_message(file, Hello(client="test", camera=camera))
        for index, frame in enumerate(frames):
            color = frame.color.copy()
            color[:8, :8] = [0, index, 0]
            write_message(
                file,
                Frame(
                    frame=index,
                    timestamp_s=index / 30,
                    world_from_camera=tuple(frame.world_from_camera.ravel().tolist()),
                    color=encode_color(color, "png"),
                    depth=encode_depth(frame.depth, "zdelta"),
                ),
            )
    return path


def play(open_page: OpenPage, server: BackgroundServer, path: Path) -> Page:
    page = open_page(server.url, size=(600, 800))
    page.locator("input[name=source][value=recorded]").check()
    page.locator("[name=answer]").select_option("layer")
    page.locator("[name=recording]").set_input_files(path)
    page.locator("#start").click()
    wait_for_text(page, "#picture-caption", "Frame")
    wait_for_drawing(page)
    return page


def shown(page: Page) -> Displayed:
    """What the page shows now."""
    found = page.evaluate(_PICTURE)
    png = np.frombuffer(base64.b64decode(found["url"].partition(",")[2]), np.uint8)
    rgb: NDArray[np.uint8] = cv2.imdecode(png, cv2.IMREAD_COLOR_RGB).astype(np.uint8)
    frame = re.match(r"Frame (\d+)", found["caption"])
    return Displayed(int(rgb[4, 4, 1]), 0, rgb, None if frame is None else int(frame[1]))


def test_a_picture_of_a_lens_that_distorts_is_straightened_under_the_layer(
    serve: Callable[[float], BackgroundServer], open_page: OpenPage, tmp_path: Path
) -> None:
    camera = structs.replace(CAMERA, distortion=DISTORTION)
    pose = turned(4.0)
    path = record(tmp_path / "still.rec", camera, [frame_at(pose, 0, colorful())])
    drawn = shown(play(open_page, serve(0.0), path)).rgb
    keep("layer_mode_straightened", drawn)
    straight = shown_picture(colorful(), camera)
    assert np.abs(straight.astype(int) - colorful()).max() > 20
    error = np.abs(drawn - look(pose).over(straight))
    error[:14, :14] = 0  # the picture's number
    known = np.pad((straight > 0).any(axis=-1), 1).astype(np.uint8)
    is_inside = cv2.erode(known, np.ones((5, 5), np.uint8))[1:-1, 1:-1] > 0
    assert is_inside.mean() > 0.9
    assert error[is_inside].max() <= 3


def test_things_stay_where_they_stand_while_a_recorded_camera_turns(
    serve: Callable[[float], BackgroundServer],
    received: Received,
    open_page: OpenPage,
    keep_picture: Callable[[Page, str], None],
    tmp_path: Path,
) -> None:
    there = turning()
    frames = [*there, *there[-2:0:-1]]
    page = play(open_page, serve(SLOW_S), record(tmp_path / "turning.rec", CAMERA, frames))
    seen = [shown(page) for _ in range(25)]
    keep("layer_mode_recorded", seen[-1].rgb)
    errors = errors_of(seen, CAMERA, is_ball, lambda frame: is_ball(composite(frame)), frames, received.frames)
    assert errors.still_px[:, 0].mean() > 2
    assert (errors.shares < 0.25).all()
    page.locator("#latency").scroll_into_view_if_needed()
    keep_picture(page, "layer_mode_ages")
    assert float(page.locator("#age-layer-median").text_content()) > 1e3 * SLOW_S
    assert int(page.locator("#age-picture").text_content()) < 30
