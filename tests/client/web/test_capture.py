"""What a browser captures arrives as it was: the page's own capture code, with a device that shows known frames."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from playwright.sync_api import Page

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Hello, Wishes
from server.service.serve import BackgroundServer, start_in_background
from server.service.service import Service
from tests.client.web.conftest import PATIENCE_MS, OpenPage, wait_for_text
from tests.client.web.sequence import ACROSS, STRAIGHT, of_device
from tests.service.fakes import FAKE_DEVICE, FakePipeline, FakeResult, Lab, fake_mesh
from tests.service.proxy import impaired

CAMERA = CameraModel(width=120, height=160, fx=131.0, fy=133.0, cx=56.25, cy=83.5, depth_scale_m=0.00125)
DEPTH_SIZE = (48, 36)
FRAMES = 5
ROOM = "kitchen"
LEAST_PSNR_DB = 32.0


@dataclass
class Received:
    """What pipelines were given."""

    hellos: list[Hello | None] = field(default_factory=list)
    cameras: list[CameraModel] = field(default_factory=list)
    wishes: list[Wishes] = field(default_factory=list)
    frames: list[RgbdFrame] = field(default_factory=list)
    lab: Lab = field(default_factory=Lab)

    def build(
        self, _device: object, camera: CameraModel, wishes: Wishes, _room: object = None, asked: Hello | None = None
    ) -> FakePipeline:
        self.hellos.append(asked)
        self.cameras.append(camera)
        self.wishes.append(wishes)
        return _Recording(self)

    def wait(self, frames: int) -> list[RgbdFrame]:
        until_s = time.monotonic() + PATIENCE_MS / 1e3
        while len(self.frames) < frames and time.monotonic() < until_s:
            time.sleep(0.02)
        assert len(self.frames) >= frames
        return self.frames


class _Recording(FakePipeline):
    def __init__(self, received: Received) -> None:
        super().__init__(received.lab)
        self._received = received

    def process(self, frame: RgbdFrame, **wanted: bool) -> FakeResult:
        self._received.frames.append(frame)
        return super().process(frame, **wanted)


@pytest.fixture
def received() -> Received:
    return Received()


@pytest.fixture
def server(received: Received) -> Iterator[BackgroundServer]:
    room = SimpleNamespace(close=lambda: None, key_digest=None)
    service = Service(
        FAKE_DEVICE,
        pipeline_factory=received.build,
        mesh_loader=fake_mesh,
        room_factory=lambda _wishes, _name: room,
    )
    with start_in_background(service) as server:
        yield server


def frames_seen(count: int = FRAMES) -> list[RgbdFrame]:
    """Smooth colour, different on every side; depth of noise with holes; poses about all axes."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width] / CAMERA.height
    frames = []
    for index in range(count):
        random = np.random.default_rng(index)
        color = np.stack([250 * u, 250 * v, 60 + 30 * index + 0 * u], axis=-1).astype(np.uint8)
        depth = random.integers(0, 65536, DEPTH_SIZE, np.uint16) * (random.random(DEPTH_SIZE) > 0.2)
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(random.normal(size=3))[0]
        pose[:3, 3] = random.normal(size=3)
        frames.append(RgbdFrame(index, index / 30, color, depth.astype(np.uint16), pose))
    return frames


def start_capture(page: Page, source: str = "xr") -> None:
    page.locator(f"input[name=source][value={source}]").check()
    page.locator("#start").click()


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
    assert (hello.room, hello.room_key, hello.keep_s, hello.wishes.up) == (ROOM, "secret", 30.0, (0.0, 1.0, 0.0))


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
