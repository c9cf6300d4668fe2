"""A given light through the whole spine: it is written as given, and the shadow falls on the side away from it."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from protocol.messages import Wishes
from server.client_session import ClientSession
from server.maths.sh import rotate_sh, webxr_from_world
from server.opencl.device import Device
from server.pipeline import FrameResult
from server.scene.placement import Placement
from tests.scenes import lights
from tests.scenes.lights import degrees_between
from tests.scenes.lit_pole import BOUNDS, CAMERA, GREY, POLE_M, VIEW, frame
from tests.scenes.meshes import shape_of


def shown(device: Device, light: NDArray[np.float64], axes: str) -> FrameResult:
    """The floor with a pole of 30 cm on it under `light` [n, 3]."""
    rows = tuple((float(r), float(g), float(b)) for r, g, b in light)
    wishes = Wishes(volume_m=BOUNDS, voxel_m=0.01, up=(0.0, -1.0, 0.0), light=rows, light_axes=axes)  # type: ignore[arg-type]
    pipeline = ClientSession(device, CAMERA, wishes)
    pipeline.place_object("pole", shape_of(trimesh.creation.box((0.08, 0.3, 0.08))), Placement(position_m=POLE_M))
    result = pipeline.process(frame())
    pipeline.close()
    return result


def shadow_to_the_right(result: FrameResult) -> float:
    """How much darker the floor is right of the pole's foot than left of it, codes, mean of 30 x 20 pixels each."""
    darker = GREY - result.color.astype(float).mean(axis=2)
    foot = np.linalg.inv(VIEW) @ [*POLE_M, 1.0]
    column, row = (round(CAMERA.fx * foot[i] / foot[2] + c) for i, c in ((0, CAMERA.cx), (1, CAMERA.cy)))
    rows = slice(row - 10, row + 10)
    return float(darker[rows, column + 8 : column + 38].mean() - darker[rows, column - 38 : column - 8].mean())


@pytest.mark.parametrize("side", [-1.0, 1.0], ids=["from the left", "from the right"])
def test_shadow_falls_away_from_the_light(device: Device, side: float) -> None:
    toward = side * VIEW[:3, 0] + [0.0, -0.6, 0.0]
    light = lights.lobe_and_sky(toward)
    result = shown(device, light, "world")
    np.testing.assert_allclose(result.light.sh, light, rtol=1e-12)
    np.testing.assert_array_equal(result.light.sh_std, 0)
    assert result.light.valid
    assert degrees_between(result.light.dominant_direction, toward) < 1e-4
    assert -side * shadow_to_the_right(result) > 2.0  # codes; measured 4 and 5


def test_light_in_webxr_axes_is_the_same_picture(device: Device) -> None:
    """As a panorama gives it: up is +y, and the camera's heading -z."""
    light = lights.lobe_and_sky((0.8, -0.6, 0.3))
    turned = rotate_sh(light, webxr_from_world(np.array([0.0, -1.0, 0.0]), VIEW[:3, 2]))
    world, webxr = shown(device, light, "world"), shown(device, turned, "webxr")
    np.testing.assert_allclose(webxr.light.sh, light, atol=1e-9)
    assert np.abs(webxr.color.astype(int) - world.color).max() <= 1


def test_nothing_is_estimated(device: Device) -> None:
    """Under a light that the picture contradicts: it is still the one that is given."""
    light = lights.uniform((5.0, 0.1, 0.1))
    result = shown(device, light, "world")
    np.testing.assert_allclose(result.light.sh, light, rtol=1e-12)
    assert result.light.dominant_lights == ()
