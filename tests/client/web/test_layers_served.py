"""Layer mode against the real service, over a slow link."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from playwright.sync_api import Page

from server.opencl.device import Device
from tests.client.web.conftest import OpenPage
from tests.client.web.constants import PICTURES
from tests.client.web.displayed import display
from tests.client.web.layer_figures import errors_of
from tests.client.web.layer_session import Seen, begin, foot_of, guide_error_px, place_ball, show_ball, watched_server
from tests.client.web.page import wait_until
from tests.client.web.red_ball import TurningTable, is_red, silhouette
from tests.client.web.sequence import of_device
from tests.service.proxy import impaired

SIZE = (160, 120)
DELAY_S = 0.15
"""Each way: an answer takes 300 ms more."""


@pytest.fixture(scope="module")
def source() -> TurningTable:
    return TurningTable(SIZE, reach_deg=6.0, step_deg=0.5)


def test_a_ball_placed_by_touch_stays_where_it_stands_while_the_camera_turns(
    source: TurningTable, device: Device, open_page: OpenPage, keep_picture: Callable[[Page, str], None]
) -> None:
    seen, frames = Seen(), [source[i] for i in range(len(source))]
    with watched_server(device, seen) as server, impaired(server.url, DELAY_S) as link:
        page = open_page(link.url, of_device(source.camera, frames) | {"fps": 1e-6}, size=(600, 800))
        begin(page)
        place_ball(page, source, seen)
        show_ball(page, source)
        drawn = len(seen.frames) + 10
        wait_until(lambda: len(seen.frames) >= drawn, page)
        shown = display(page, 30)
        keep_picture(page, "layer_mode_served")
        guides_px = [guide_error_px(page, source, seen) for _ in range(8)]
        page.close()
    errors = errors_of(
        shown, source.camera, is_red, lambda frame: silhouette(source.camera, frame, foot_of(seen)), frames, seen.frames
    )
    PICTURES.mkdir(parents=True, exist_ok=True)
    worst = shown[int(np.argmax(errors.still_px[:, 0]))].rgb
    cv2.imwrite(str(PICTURES / "layer_mode_served_drawn.png"), cv2.cvtColor(worst, cv2.COLOR_RGB2BGR))
    assert errors.still_px[:, 0].mean() > 3
    assert (errors.shares < 0.25).all()
    assert max(each.picture_age for each in shown) <= 2
    assert max(guides_px) < 3  # what marks the ball is around it, and moves with it
