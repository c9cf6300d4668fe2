"""Light mode: the server answers with light alone, and three.js draws in the browser what our own renderer would."""

from __future__ import annotations

import base64
import dataclasses
import time
from collections.abc import Callable

import cv2
import numpy as np
import pytest
import trimesh
from msgspec import structs
from numpy.typing import NDArray
from playwright.sync_api import Page

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import ArrivingLight, Hello, Light, Welcome, Wishes
from server.client_session import ClientSession
from server.maths.sh import lambert_transfer
from server.opencl.device import Device
from server.scene.mesh import load_mesh
from server.scene.placement import Placement
from server.service.serve import BackgroundServer
from tests.client.web.conftest import OpenPage, wait_for_text
from tests.client.web.constants import PICTURES
from tests.client.web.page import start_capture
from tests.client.web.received import Received
from tests.client.web.sequence import of_device
from tests.client.web.wall import CAMERA, DEPTH_M, RADIUS_M, plane
from tests.service import fakes
from tests.service.fakes import FakeResult
from tests.service.wire import Wire

TOUCHED = (79.5, 74.5)
SH = np.zeros((16, 3))
SH[:9] = np.outer([2.0, 0.5, 0.4, -0.3, 0.15, -0.1, 0.12, 0.2, -0.15], [1.0, 0.9, 0.8])
TOLERANCE = 0.02


ROOM_SH = 0.4 * SH[:, ::-1] * [1.0, -1.0, 1.0]
"""The room's own light: darker, of other colours and from elsewhere."""


def rows(sh: NDArray[np.float64]) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, sh.tolist()))


class _Lit(fakes.FakePipeline):
    """A pipeline that finds one light in the room and another at each object."""

    def process(self, frame: RgbdFrame, **wanted: bool) -> FakeResult:
        result = super().process(frame, **wanted)
        at = tuple(
            ArrivingLight(
                of="object",
                index=index,
                position=(0.0, 0.0, -1.0),
                sh=rows(SH),
                sh_std=((None, None, None),) * 16,
                sh_webxr=(0.0,) * 27,
                dominant_direction=(0.0, 1.0, 0.0),
                dominant_intensity=1.0,
                spread_deg=70.0,
                valid=False,
                object=name,
            )
            for index, name in enumerate(sorted(self.objects))
        )
        return dataclasses.replace(result, light=structs.replace(result.light, sh=rows(ROOM_SH), at=at))


@pytest.fixture
def build_pipeline(received: Received) -> Callable[..., object]:
    def build(_device: object, _camera: CameraModel, wishes: Wishes, *_room: object) -> _Lit:
        received.wishes.append(wishes)
        return _Lit(received.lab)

    return build


def foot() -> NDArray[np.float64]:
    """Where the ball stands that is placed by a touch."""
    u, v = TOUCHED
    return np.array([(u - CAMERA.cx) / CAMERA.fx, (CAMERA.cy - v) / CAMERA.fy, -1.0]) * DEPTH_M


def ball_normals() -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """World normals [height, width, 3] of the ball, and where it is seen well within its outline."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (CAMERA.cy - v) / CAMERA.fy, -np.ones(u.shape)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    centre = foot() + np.array([0.0, RADIUS_M, 0.0])
    along = rays @ centre
    inside = along**2 - centre @ centre + RADIUS_M**2
    normals = (rays * (along - np.sqrt(np.maximum(inside, 0)))[..., None] - centre) / RADIUS_M
    return normals, (inside > 0) & ((-rays * normals).sum(axis=-1) > 0.35)


def linear(srgb: NDArray[np.uint8]) -> NDArray[np.float64]:
    value = srgb / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def drawn(page: Page) -> NDArray[np.uint8]:
    """[height, width, 4] of what was drawn over the room."""
    text = page.evaluate("() => btoa(device.seen.reduce((text, value) => text + String.fromCharCode(value), ''))")
    return np.frombuffer(base64.b64decode(text), np.uint8).reshape(CAMERA.height, CAMERA.width, 4)[::-1]


def test_three_js_shades_a_white_ball_as_we_do_and_no_picture_is_sent(
    server: BackgroundServer,
    received: Received,
    device: Device,
    open_page: OpenPage,
    keep_picture: Callable[[Page, str], None],
) -> None:
    page = open_page(server.url, of_device(CAMERA, [plane()], loops=True))
    page.locator("input[value=xr]").check()
    page.locator("[name=answer]").select_option("light")
    start_capture(page)
    wait_for_text(page, "#state", "Live, captured here")
    assert received.wishes[0].answer == "light"
    page.locator("#model").select_option("Ball")
    page.locator("#place").click()
    box = page.locator("#picture").bounding_box()
    scale = min(box["width"] / CAMERA.width, box["height"] / CAMERA.height)
    u, v = TOUCHED
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.touchscreen.tap(middle[0] + scale * (u - CAMERA.cx), middle[1] + scale * (v - CAMERA.cy))
    page.wait_for_function("() => device.seen?.some((value, i) => i % 4 === 3 && value > 0)")
    # Until its place is known it is drawn in the room's light.
    wait_for_text(page, "#light-unknown", "its direction may be off by 70°")
    keep_picture(page, "light_mode")
    normals, seen = ball_normals()
    expected = lambert_transfer(normals, 4) @ SH
    assert seen.sum() > 500
    end_s, shown = time.monotonic() + fakes.PATIENCE_S, drawn(page)
    while np.abs(linear(shown[..., :3]) / expected - 1)[seen].max() >= TOLERANCE and time.monotonic() < end_s:
        shown = drawn(page)
    cv2.imwrite(str(PICTURES / "light_mode_drawn.png"), cv2.cvtColor(shown, cv2.COLOR_RGBA2BGRA))
    assert (shown[seen, 3] == 255).all()
    assert np.abs(linear(shown[..., :3]) / expected - 1)[seen].max() < TOLERANCE
    assert (shown[0, :, 3] == 0).all()  # the room is seen beside it
    assert [entry[0] for entry in received.lab.log if entry[0] != "frame"] == ["place"]

    ours = our_picture(device)
    assert np.abs(linear(shown[..., :3]) / linear(ours) - 1)[seen].max() < TOLERANCE


def our_picture(device: Device) -> NDArray[np.uint8]:
    """The same ball by our own renderer, in the same light, with next to nothing of a room around it."""
    wishes = Wishes(
        light=tuple(map(tuple, SH.tolist())), tone_mapping="light", edges="hard", up=(0.0, 1.0, 0.0), indirect="none"
    )
    pipeline = ClientSession(device, CAMERA, wishes)
    ball = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS_M)
    ball.visual.vertex_colors = [255, 255, 255, 255]
    _ = ball.vertex_normals  # exported with it
    data = trimesh.Scene(ball).export(file_type="glb")
    pipeline.place_object("ball", load_mesh(data, "glb"), Placement(tuple(foot().tolist())))
    frame = plane()
    frame.depth[:-20], frame.depth[-20:] = 0, 3000
    try:
        return pipeline.process(frame).color
    finally:
        pipeline.close()


def test_a_session_that_wants_light_alone_gets_no_composites(server: BackgroundServer) -> None:
    wire = Wire(server.url)
    wire.say(Hello(client="test", camera=fakes.CAMERA, wishes=Wishes(answer="light")))
    assert isinstance(wire.hear(), Welcome)
    for index in range(3):
        wire.say(fakes.frame_message(index))
        answer = wire.hear()
        assert isinstance(answer, Light)
        assert answer.frame == index
    wire.hang_up()
