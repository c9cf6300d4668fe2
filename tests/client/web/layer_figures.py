"""Layer mode in a page, measured: where a thing is on the screen, and where it should be, while the camera turns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from tests.client.web.displayed import Displayed, outline_px, shift_px

Shows = Callable[[NDArray[np.uint8]], NDArray[np.bool_]]
"""[h, w, 3] -> [h, w]: which pixels show a thing."""


@dataclass(frozen=True)
class Errors:
    """[display frames, 2] from the thing's centroid and its outline to the true ones, pixels of the camera."""

    moved_px: NDArray[np.float64]
    """As displayed."""
    still_px: NDArray[np.float64]
    """Where it would be if the layer were put over the picture as it is."""

    @property
    def shares(self) -> NDArray[np.float64]:
        """[2] of the mean error that moving leaves."""
        share: NDArray[np.float64] = self.moved_px.mean(axis=0) / self.still_px.mean(axis=0)
        return share


def errors_of(
    shown: list[Displayed],
    camera: CameraModel,
    shows: Shows,
    truth: Callable[[RgbdFrame], NDArray[np.bool_]],
    frames: list[RgbdFrame],
    sent: list[RgbdFrame],
) -> Errors:
    """`truth`: where a frame should show the thing. `frames`: the device's; `sent`: those that the server was given."""
    of_number = {frame.index: frame for frame in sent}
    moved, still = [], []
    for each in shown:
        if each.layer_frame is None:
            continue
        true, left = truth(frames[each.at]), truth(of_number[each.layer_frame])
        here = shows(cv2.resize(each.rgb, (camera.width, camera.height), interpolation=cv2.INTER_AREA))
        moved.append([shift_px(here, true), outline_px(here, true)])
        still.append([shift_px(left, true), outline_px(left, true)])
    return Errors(np.array(moved), np.array(still))
