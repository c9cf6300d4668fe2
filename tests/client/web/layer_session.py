"""A page in layer mode against the real service: a camera turns above a table, where a red ball is placed by touch."""

from __future__ import annotations

import base64
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import Page

from protocol.frames import RgbdFrame, Viewpoint
from protocol.messages import Wishes
from server.client_session import ClientSession, FrameTurn
from server.opencl.device import Device
from server.pipeline import FrameResult
from server.scene.mesh import Mesh
from server.scene.placement import Placement
from server.service.serve import BackgroundServer
from server.service.service import Service
from server.service.warm_up import compile_for
from tests.client.web.page import wait_until
from tests.client.web.red_ball import TurningTable, red_ball

PRESET = "gr15fast"
IS_RED = """(pixels) => pixels?.some((value, i) => {
  return i % 4 === 0 && value > 90 && value > 3 * pixels[i + 1] && value > 3 * pixels[i + 2];
})"""
"""That something red is on the display."""
TOUCHED = (0.68, 0.62)
"""Of the picture's width and height as the camera looks straight ahead: the table, with nothing around."""


@dataclass
class Seen:
    """What the real pipeline was given."""

    frames: list[RgbdFrame] = field(default_factory=list)
    placed: list[Placement] = field(default_factory=list)
    is_placed: threading.Event = field(default_factory=threading.Event)


@contextmanager
def watched_server(device: Device, seen: Seen) -> Iterator[BackgroundServer]:
    """The real service, which notes what comes. The kernels that these sessions need are compiled, as those of any
    service that is ready."""

    class Watched(ClientSession):
        def process(
            self, frame: RgbdFrame | Viewpoint, *, watched: bool = False, turn: FrameTurn | None = None
        ) -> FrameResult:
            assert isinstance(frame, RgbdFrame)
            seen.frames.append(frame)
            return super().process(frame, watched=watched, turn=turn)

        def place_object(self, object_id: str, mesh: Mesh, placement: Placement) -> tuple[str, ...]:
            notes = super().place_object(object_id, mesh, placement)
            seen.placed.append(placement)
            seen.is_placed.set()
            return notes

    compile_for(device, Wishes(volume_m=(-1, -1, 0, 1, 1, 2), voxel_m=0.02, preset=PRESET, answer="layer"))
    with BackgroundServer(Service(device, pipeline_factory=Watched)) as server:
        yield server


def begin(page: Page) -> None:
    """Start the session of a page that has its device."""
    page.locator("input[name=source][value=xr]").check()
    page.locator("[name=answer]").select_option("layer")
    page.locator("[name=preset]").select_option(PRESET)
    page.locator("#start").click()
    page.locator("#picture-caption").filter(has_text="Frame").wait_for(state="attached")


def place_ball(page: Page, source: TurningTable, seen: Seen) -> None:
    """By touch, while the device shows its first frame."""
    camera, middle, first = source.camera, source[len(source) // 2], source[0]
    u, v = round(TOUCHED[0] * camera.width), round(TOUCHED[1] * camera.height)
    z = middle.depth[v, u] * camera.depth_scale_m
    there = middle.world_from_camera @ [(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z, 1.0]
    pixel = _seen_at(source, first, there[:3])
    page.locator("#model-file").set_input_files(
        {"name": "Red.glb", "mimeType": "model/gltf-binary", "buffer": red_ball()}
    )
    page.locator("#object-said").filter(has_text="can be placed now").wait_for(state="attached")
    page.locator("#place").click()
    page.touchscreen.tap(*_on_screen(page, pixel, (camera.width, camera.height)))
    wait_until(seen.is_placed.is_set, page)


def guide_error_px(page: Page, source: TurningTable, seen: Seen) -> float:
    """From the middle of what marks the selected ball to where its foot is in the picture on the display."""
    found = page.evaluate("() => ({ at: device.at, url: document.getElementById('guide').toDataURL('image/png') })")
    png = np.frombuffer(base64.b64decode(found["url"].partition(",")[2]), np.uint8)
    blue, _, red, alpha = np.moveaxis(cv2.imdecode(png, cv2.IMREAD_UNCHANGED).astype(int), -1, 0)
    rows, columns = np.nonzero((alpha > 128) & (red - blue > 80))
    middle = np.array([columns.mean(), rows.mean()])
    return float(np.linalg.norm(middle - _seen_at(source, source[found["at"]], np.array(foot_of(seen)))))


def show_ball(page: Page, source: TurningTable) -> None:
    """Wait for it on the display, then let the camera turn."""
    page.wait_for_function(f"() => ({IS_RED})(device.seen)")
    page.evaluate("fps => { device.fps = fps; }", source.steps_per_s)


def _seen_at(source: TurningTable, frame: RgbdFrame, point: NDArray[np.float64]) -> NDArray[np.float64]:
    camera, camera_from_world = source.camera, np.linalg.inv(frame.world_from_camera)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    turn = cv2.Rodrigues(camera_from_world[:3, :3])[0]
    return cv2.projectPoints(point, turn, camera_from_world[:3, 3], matrix, None)[0].ravel().astype(np.float64)


def _on_screen(page: Page, pixel: NDArray[np.float64], size: tuple[int, int]) -> tuple[float, float]:
    box = page.locator("#picture").bounding_box()
    assert box is not None
    scale = min(box["width"] / size[0], box["height"] / size[1])
    left = box["x"] + (box["width"] - scale * size[0]) / 2
    top = box["y"] + (box["height"] - scale * size[1]) / 2
    return left + scale * (pixel[0] + 0.5), top + scale * (pixel[1] + 0.5)


def foot_of(seen: Seen) -> tuple[float, float, float]:
    """Where the ball stands, metres in the world."""
    return seen.placed[0].position_m
