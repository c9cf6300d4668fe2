"""What the device of device.js has displayed, and how far things in it are from where they should be."""

from __future__ import annotations

import base64
import re
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import Page

_READ = """async () => {
  const base64 = (bytes) => new Promise((done) => {
    const reader = new FileReader();
    reader.onload = () => done(reader.result.split(",")[1]);
    reader.readAsDataURL(new Blob([bytes]));
  });
  const { framebufferWidth: width, framebufferHeight: height } = device.layer;
  const read = async ({ seen, ...rest }) => ({ ...rest, width, height, seen: await base64(seen) });
  return Promise.all(device.displayed.map(read));
}"""
NUMBER_AT = 4
"""Row and column of a pixel that says the picture's number."""


@dataclass(frozen=True)
class Displayed:
    """A display frame."""

    at: int
    """Which of the device's frames it showed: where it stood."""
    count: int
    """Its own number."""
    rgb: NDArray[np.uint8]
    """[h, w, 3] sRGB on the display's framebuffer."""
    layer_frame: int | None
    """Of which frame the virtual things were, as the page says."""
    time_ms: float = 0.0
    """On the page's clock."""

    @property
    def picture_age(self) -> int:
        """Display frames since the camera's picture that is seen was taken."""
        low, high = self.rgb[NUMBER_AT, NUMBER_AT, 1:].tolist()
        return self.count - (low + 256 * high)


def display(page: Page, count: int) -> list[Displayed]:
    """The next `count` display frames."""
    page.evaluate("count => Object.assign(device, { keeps: count, displayed: [] })", count)
    page.wait_for_function("count => device.displayed.length >= count && (device.keeps = 0, true)", arg=count)
    return [_read(each) for each in page.evaluate(_READ)]


def _read(each: dict[str, Any]) -> Displayed:
    rgba = np.frombuffer(base64.b64decode(each["seen"]), np.uint8).reshape(each["height"], each["width"], 4)
    frame = re.match(r"Frame (\d+)", each["caption"])
    return Displayed(
        each["at"], each["count"], rgba[::-1, :, :3], None if frame is None else int(frame[1]), each["time_ms"]
    )


def centroid_px(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """[2] column and row."""
    v, u = np.nonzero(mask)
    return np.array([u.mean(), v.mean()])


def shift_px(mask: NDArray[np.bool_], true_mask: NDArray[np.bool_]) -> float:
    """Between the centroids."""
    return float(np.linalg.norm(centroid_px(mask) - centroid_px(true_mask)))


def outline_px(mask: NDArray[np.bool_], true_mask: NDArray[np.bool_]) -> float:
    """Mean distance of each outline's pixels from the other one."""

    def edge(of: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return of & (cv2.erode(of.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)

    def distance(to: NDArray[np.bool_]) -> NDArray[np.float32]:
        return cv2.distanceTransform((~to).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)

    one, other = edge(mask), edge(true_mask)
    return float(max(distance(other)[one].mean(), distance(one)[other].mean()))
