"""Who only watches places objects, too: the server finds the surface in its own scan, and the session gets them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from client.options.source import open_source
from protocol.messages import Composite
from server.scene.placement import Placement, SpotPlacement
from server.service.serve import BackgroundServer
from tests.client.web.conftest import OpenPage, wait_for_text
from tests.client.web.page import on_screen, wait_until
from tests.client.web.watched import SIZE, TOUCHED, point_under, standing_camera, wait_for

SOURCE = "synthetic:table?light=7&size=160x120&frames=1"


@pytest.fixture
def captured(real_server: BackgroundServer) -> Iterator[list[Composite]]:
    """The answers to a camera that stands still, until the end of the test."""
    with standing_camera(real_server.url, open_source(SOURCE)) as answers:
        yield answers


def test_a_watcher_places_drags_and_removes(
    real_server: BackgroundServer, asked: list, captured: list[Composite], open_page: OpenPage
) -> None:
    source = open_source(SOURCE)
    page = open_page(real_server.url, size=SIZE)
    wait_for_text(page, "#state", "Live")
    page.wait_for_selector(".has-picture")
    page.locator("#place").tap()
    page.touchscreen.tap(*on_screen(page, *TOUCHED))
    kind, placed = wait_for(asked, 1)
    assert kind == "place"
    assert isinstance(placed, SpotPlacement)
    assert placed.spot.on == "ray"
    wait_until(lambda: any(answer.placed for answer in captured), page)
    (found,) = next(answer.placed for answer in captured if answer.placed)
    under = point_under(source.camera, source[0], *TOUCHED)
    assert np.abs(np.array(found.position_m) - under).max() < 0.01
    page.wait_for_function("!document.getElementById('selected-tools').hidden")
    page.locator("#turn-left").tap()
    kind, turned = wait_for(asked, 2)
    assert kind == "move"
    assert isinstance(turned, Placement)
    assert (turned.position_m, turned.yaw_deg) == (pytest.approx(found.position_m), pytest.approx(15.0))
    page.locator("#remove").tap()
    assert wait_for(asked, 3)[0] == "remove"
