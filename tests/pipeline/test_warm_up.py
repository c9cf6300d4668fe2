"""What warming up is for: no session waits for a compiler in the middle of its frames."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from protocol.messages import Wishes
from server.client_session import ClientSession
from server.maths.direct_lights import split_light
from server.opencl.device import Device, open_device
from server.scene.mesh import Mesh
from server.scene.placement import Placement
from server.service.warm_up import SHARP_LIGHT, warm_up
from tests.scenes.plain_light import PLAIN_LIGHT
from tests.scenes.rooms import BOUNDS, CAMERA, VOXEL_M, frame_at, view_at


@pytest.fixture(scope="module")
def warm() -> tuple[Device, set[object]]:
    """A device of its own that was warmed up, and the programs that it then has."""
    device = open_device(None)
    warm_up(device)
    return device, set(device.programs._programs)


@pytest.mark.parametrize(
    "asked",
    [
        {},
        {"preset": "gr15fast"},
        {"preset": "art4"},
        {"light": SHARP_LIGHT},
        {"answer": "layer"},
        {"preset": "gr15fast", "light": SHARP_LIGHT, "answer": "layer"},
        {"as_thesis": True},
        PLAIN_LIGHT,
    ],
)
def test_later_sessions_compile_nothing(warm: tuple[Device, set[object]], asked: dict[str, Any]) -> None:
    device, built = warm
    pipeline = ClientSession(device, CAMERA, Wishes(volume_m=BOUNDS, voxel_m=VOXEL_M, **asked))
    square = Mesh(
        vertices=np.array([[0, 0, 0], [0.3, 0, 0], [0, 0.3, 0], [0.3, 0.3, 0]], np.float32),
        triangles=np.array([[0, 1, 2], [1, 3, 2]], np.int32),
        vertex_colors=np.full((4, 3), 0.5, np.float32),
        normals=np.tile(np.array([[0, 0, 1]], np.float32), (4, 1)),
        up_axis="y",
    )
    pipeline.place_object("square", square, Placement(position_m=(-0.6, 0.6, 0.6)))
    for step in range(2):
        plan = pipeline.process(frame_at(view_at(step), step, given=view_at(step))).plan
    pipeline.close()
    assert "shadow_map" in plan.run or "light" not in asked
    assert set(device.programs._programs) == built


def test_the_light_of_the_warm_up_is_sharp() -> None:
    assert split_light(np.array(SHARP_LIGHT)).discs
