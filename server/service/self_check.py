"""Self-check of a device: processes small synthetic frames and compares the results with known values."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from protocol.codec import one_line
from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.opencl.device import Device
from server.pipeline import FrameResult
from server.scene.mesh import Mesh
from server.scene.placement import Placement

CAMERA = CameraModel(width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=23.5)
VOLUME_M, VOXEL_M = (-1.0, -1.0, 0.0, 1.0, 1.0, 2.0), 0.02
BALL_M, RADIUS_M, WALL_M = (0.0, 0.0, 1.0), 0.4, 1.6
ALBEDO, AMBIENT = 0.5, 0.3

TOWARDS_LIGHT = np.array([0.5, -0.5, -0.7]) / np.linalg.norm([0.5, -0.5, -0.7])
LIGHT_BOUND_DEG = 10.0
"""A correct device finds the direction within 2 degrees; a wrong normal, ray or solver is tens of degrees off."""
EVEN_SKY = ((float(np.sqrt(4 * np.pi)),) * 3,)
"""Radiance 1 from all directions. An unoccluded surface then shows its own colour (white furnace test)."""
OBJECT_BOUND, LEAST_OBJECT_PIXELS = 6, 8


class CheckFailed(Exception):
    """A result is wrong; `check` is the name of the check."""

    def __init__(self, check: str, found: str) -> None:
        super().__init__(one_line(f"check {check!r}: {found}"))
        self.check = check


def check_answers(device: Device) -> None:
    """Run all checks. Raises CheckFailed at the first result out of bounds."""
    plain = Wishes(volume_m=VOLUME_M, voxel_m=VOXEL_M, as_thesis=True, ray_length_m=0.1, bands=2)
    result = _processed(device, plain, lambda _pipeline: None)
    check_picture(result)
    check_light(result)
    furnace = Wishes(volume_m=VOLUME_M, voxel_m=VOXEL_M, light=EVEN_SKY, albedo="constant", indirect="none")
    check_object(_processed(device, furnace, _place_triangle))


def check_picture(result: FrameResult) -> None:
    """Without virtual objects the output is the camera's image, byte for byte."""
    assert result.color is not None
    wrong = int((result.color != frame().color).any(axis=2).sum())
    if wrong:
        raise CheckFailed("picture", f"{wrong} pixels of a picture without virtual objects are not the camera's")


def check_light(result: FrameResult) -> None:
    """The estimated light direction is that which shaded the ball."""
    found = np.array(result.light.dominant_direction)
    if not np.isfinite([value for row in result.light.sh for value in row]).all():
        raise CheckFailed("light", "the light is not finite")
    off_deg = float(np.degrees(np.arccos(np.clip(found @ TOWARDS_LIGHT, -1, 1))))
    if not off_deg <= LIGHT_BOUND_DEG:
        raise CheckFailed("light", f"its direction is {off_deg:.1f} degrees off, at most {LIGHT_BOUND_DEG:g}")


def check_object(result: FrameResult) -> None:
    """Under uniform light a virtual triangle shows its own colour."""
    assert result.color is not None
    picture, own = frame().color.astype(int), int(_srgb(np.array(ALBEDO)))
    shown = np.abs(result.color.astype(int) - own).max(axis=2) <= OBJECT_BOUND
    pixels = int((shown & (np.abs(picture - own).max(axis=2) > OBJECT_BOUND)).sum())
    if pixels < LEAST_OBJECT_PIXELS:
        raise CheckFailed("object", f"{pixels} pixels show its colour, at least {LEAST_OBJECT_PIXELS} should")


def frame(index: int = 0) -> RgbdFrame:
    """A diffuse ball in front of a diffuse wall, lit by uniform ambient light and a distant lamp, without shadows."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    ray = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    center = np.array(BALL_M)
    a, b = (ray * ray).sum(axis=-1), ray @ center
    q = b * b - a * (center @ center - RADIUS_M**2)
    depth_m = np.where(q > 0, (b - np.sqrt(np.maximum(q, 0))) / a, WALL_M)
    outwards = (ray * depth_m[..., None] - center) / RADIUS_M
    normal = np.where((q > 0)[..., None], outwards, [0.0, 0.0, -1.0])
    radiance = ALBEDO * (AMBIENT + (1 - AMBIENT) * np.maximum(normal @ TOWARDS_LIGHT, 0))
    return RgbdFrame(
        index=index,
        timestamp_s=index / 30,
        color=np.repeat(_srgb(radiance)[..., None], 3, axis=-1),
        depth=np.round(depth_m * 1000).astype(np.uint16),
        world_from_camera=np.eye(4),
    )


def triangle() -> Mesh:
    """Right triangle with legs of 10 cm."""
    return Mesh(
        vertices=np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], np.float32),
        triangles=np.array([[0, 1, 2]], np.int32),
        vertex_colors=np.full((3, 3), ALBEDO, np.float32),
        normals=np.tile(np.array([[0, 0, 1]], np.float32), (3, 1)),
        up_axis="y",
    )


def _processed(device: Device, wishes: Wishes, prepare: Callable[[ClientSession], object]) -> FrameResult:
    """Result of the second frame, which sees the volume that the first one filled."""
    pipeline = ClientSession(device, CAMERA, wishes)
    try:
        prepare(pipeline)
        pipeline.process(frame())
        return pipeline.process(frame(1))
    finally:
        pipeline.close()


def _place_triangle(pipeline: ClientSession) -> None:
    pipeline.place_object("triangle", triangle(), Placement(position_m=(0.2, 0.1, 0.5)))


def _srgb(linear: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Linear values in [0, 1] -> 8-bit sRGB (IEC 61966-2-1)."""
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.round(255 * encoded).astype(np.uint8)
