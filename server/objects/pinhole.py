"""A pinhole camera for rendering, without limits on its size."""

from __future__ import annotations

from dataclasses import dataclass

from protocol.frames import CameraModel


@dataclass(frozen=True)
class Pinhole:
    """Picture size and intrinsics in pixels; centres of pixels lie at integers."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


def finer(camera: CameraModel, parts: int) -> Pinhole:
    """The camera, its distortion ignored, with `parts` times as many pixels along either side.

    The centre of pixel (x, y) is that of pixel (parts x, parts y) here.
    """
    return Pinhole(
        width=parts * camera.width,
        height=parts * camera.height,
        fx=parts * camera.fx,
        fy=parts * camera.fy,
        cx=parts * camera.cx,
        cy=parts * camera.cy,
    )
