"""A room as a camera sees it, the faults that real depth pictures have, and what every answer must hold."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Light, Wishes
from server.pipeline import FrameResult
from tests.scenes.analytic import look, room, sphere
from tests.scenes.plain_light import PLAIN_LIGHT

CAMERA = CameraModel(width=96, height=72, fx=80.0, fy=80.0, cx=48.0, cy=36.0)
BOUNDS = (-1.2, -1.0, -0.5, 1.2, 1.0, 2.1)
USUAL = Wishes(volume_m=BOUNDS, voxel_m=0.04)
WISHES = msgspec.structs.replace(USUAL, **PLAIN_LIGHT)
SCENE = [room((-1.1, -0.9, -0.4), (1.1, 0.8, 2.0)), sphere((0.2, 0.4, 1.2), 0.35)]
SIZE = (CAMERA.height, CAMERA.width)
PYRAMID = 0.25 * np.array(
    [
        [[0, 1, 0], [1, 0, 1], [-1, 0, 1]],
        [[0, 1, 0], [1, 0, -1], [1, 0, 1]],
        [[0, 1, 0], [-1, 0, -1], [1, 0, -1]],
        [[0, 1, 0], [-1, 0, 1], [-1, 0, -1]],
    ]
)
Matrix = NDArray[np.float64]


def good_depth(view: Matrix) -> NDArray[np.uint16]:
    return np.rint(1000 * look(SCENE, CAMERA, view).depth_m).astype(np.uint16)


def frame_of(depth: NDArray[np.uint16], view: Matrix | None = None, index: int = 0) -> RgbdFrame:
    """A frame whose picture is shaded by a lamp to the upper left, where the scene is."""
    view = np.eye(4) if view is None else view
    try:
        shade = look(SCENE, CAMERA, view).normals @ np.array([-0.5, -0.7, -0.5])
    except ValueError:  # not a pose: the picture does not matter
        shade = np.zeros(SIZE)
    color = np.clip(90 + 110 * np.maximum(shade, 0), 0, 255).astype(np.uint8)
    return RgbdFrame(index, index / 30, np.repeat(color[..., None], 3, axis=-1), depth, view)


def numbers(value: Any) -> list[float]:
    """All numbers in nested lists and mappings; None is an explicit unknown."""
    if isinstance(value, dict):
        return [n for item in value.values() for n in numbers(item)]
    if isinstance(value, list | tuple):
        return [n for item in value for n in numbers(item)]
    return [float(value)] if isinstance(value, int | float) else []


def assert_sound(result: FrameResult) -> Light:
    """A picture of the camera's size, a finite light that can be sent, a rigid pose."""
    assert result.color.shape == (*SIZE, 3)
    assert result.color.dtype == np.uint8
    light = result.light
    assert np.isfinite(numbers(msgspec.to_builtins(light))).all()
    assert msgspec.json.decode(msgspec.json.encode(light), type=Light) == light
    assert np.isfinite(numbers(msgspec.to_builtins(result.timings))).all()
    rotation = result.world_from_camera[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert all("\n" not in note for note in result.notes)
    return light


BAD_DEPTH: dict[str, NDArray[np.uint16]] = {
    "empty": np.zeros(SIZE, np.uint16),
    "covered lens": np.full(SIZE, 1, np.uint16),
    "covered lens, 3 cm": np.full(SIZE, 30, np.uint16),
    "saturated": np.full(SIZE, 65535, np.uint16),
    "beyond 10 m": np.full(SIZE, 20_000, np.uint16),
    "one pixel": np.pad(np.full((1, 1), 1200, np.uint16), ((35, 36), (48, 47))),
    "one pixel in the corner": np.pad(np.full((1, 1), 1200, np.uint16), ((71, 0), (95, 0))),
    "noise": np.random.default_rng(0).integers(0, 65536, SIZE).astype(np.uint16),
    "alternating": np.indices(SIZE).sum(0).astype(np.uint16) % 2 * 1500,
}
