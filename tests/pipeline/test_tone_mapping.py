"""H through the whole spine: virtual things follow the picture's brightness; the thesis's white light."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from protocol.messages import Wishes
from server.client_session import ClientSession
from server.input.measure import linear_values
from server.maths.sh import LUMINANCE
from server.opencl.device import Device
from server.pipeline import FrameResult
from server.scene.placement import Placement
from tests.scenes import lights
from tests.scenes.lit_pole import BOUNDS, CAMERA, POLE_M, frame
from tests.scenes.meshes import shape_of
from tests.scenes.plain_light import PLAIN_LIGHT

LIGHT = 0.3 * lights.lobe_and_sky((0.5, -0.8, -0.3))
LINEAR = linear_values("srgb8").astype(np.float64)


def shown(device: Device, code: int, light: NDArray[np.float64] | None = LIGHT, **wished: Any) -> FrameResult:
    """An even floor of sRGB `code` with a pole on it."""
    given = None if light is None else tuple((float(r), float(g), float(b)) for r, g, b in light)
    wishes = Wishes(volume_m=BOUNDS, voxel_m=0.01, up=(0.0, -1.0, 0.0), light=given, edges="hard", **wished)
    pipeline = ClientSession(device, CAMERA, wishes)
    pipeline.place_object("pole", shape_of(trimesh.creation.box((0.08, 0.3, 0.08))), Placement(position_m=POLE_M))
    result = pipeline.process(replace(frame(), color=np.full((CAMERA.height, CAMERA.width, 3), code, np.uint8)))
    pipeline.close()
    return result


def of_the_pole(result: FrameResult) -> NDArray[np.float64]:
    """[3] linear mean of pixels on the pole."""
    foot = np.linalg.inv(frame().world_from_camera) @ [*POLE_M, 1.0]
    column, row = (round(CAMERA.fx * foot[i] / foot[2] + c) for i, c in ((0, CAMERA.cx), (1, CAMERA.cy)))
    return np.asarray(LINEAR[result.color[row - 10 : row - 5, column - 1 : column + 3]].mean(axis=(0, 1)))


def code_of(linear: float) -> int:
    return int(np.abs(LINEAR - linear).argmin())


def test_a_room_twice_as_bright_gives_virtual_things_twice_as_bright(device: Device) -> None:
    """Under a light that is given, which says nothing of it."""
    dark, bright = code_of(0.15), code_of(0.30)
    brighter = LINEAR[bright] / LINEAR[dark]
    kept, matched = (
        [of_the_pole(shown(device, c, tone_mapping=how)) for c in (dark, bright)] for how in ("light", "average")
    )
    np.testing.assert_allclose(matched[1] / matched[0], brighter, rtol=0.03)  # codes of about 100: a hundredth each
    np.testing.assert_allclose(kept[1] / kept[0], 1.0, rtol=0.01)
    run = shown(device, dark, tone_mapping="average").plan.run
    assert "match_average" in run


@pytest.mark.parametrize("code", [0, 255], ids=["black", "clipped"])
def test_nothing_to_match_is_said_and_keeps_the_lights_scale(device: Device, code: int) -> None:
    matched, kept = (shown(device, code, tone_mapping=how) for how in ("average", "light"))
    np.testing.assert_array_equal(matched.color, kept.color)
    reasons = {item.effect: item.reason for item in matched.plan.left_out}
    assert "the light's own scale holds" in reasons["match_average"]


def test_the_averages_are_matched_where_asked_for_and_in_the_thesis_where_the_light_is_estimated(
    device: Device,
) -> None:
    for wished, light, as_thesis, is_matched in (
        ("auto", LIGHT, False, False),
        ("auto", None, False, False),
        ("light", None, False, False),
        ("average", LIGHT, False, True),
        ("auto", None, True, True),
        ("auto", LIGHT, True, False),
        ("light", None, True, False),
    ):
        run = shown(device, 120, light, tone_mapping=wished, as_thesis=as_thesis).plan.run
        assert ("match_average" in run) == is_matched, (wished, light is None, as_thesis)


def test_white_light_keeps_its_luminance(device: Device) -> None:
    colored = LIGHT * [1.4, 1.0, 0.5]
    result = shown(device, 120, colored, light_color="white")
    np.testing.assert_allclose(result.light.sh, np.outer(colored @ LUMINANCE, np.ones(3)), rtol=1e-9)
    red, green, blue = of_the_pole(result)
    assert abs(red - green) < 0.01 * green
    assert abs(blue - green) < 0.01 * green
    tinted = of_the_pole(shown(device, 120, colored))
    assert tinted[0] > 1.2 * tinted[1]


def test_an_estimated_light_is_whitened_too(device: Device) -> None:
    """Of a floor of one colour, which is the light's where one albedo is assumed."""
    color = np.full((CAMERA.height, CAMERA.width, 3), (180, 120, 90), np.uint8)
    pipelines = [
        ClientSession(device, CAMERA, Wishes(volume_m=BOUNDS, voxel_m=0.01, light_color=c, **PLAIN_LIGHT))
        for c in ("estimated", "white")
    ]
    tinted, white = (np.array(p.process(replace(frame(), color=color)).light.sh) for p in pipelines)
    assert tinted[0, 0] > 1.3 * tinted[0, 2]
    np.testing.assert_allclose(white, np.outer(tinted @ LUMINANCE, np.ones(3)), atol=1e-9 * np.abs(tinted).max())
    for pipeline in pipelines:
        pipeline.close()
