"""The middle of what a picture sees: against the twin, over holes and sizes that are no multiple of the step."""

from __future__ import annotations

import numpy as np
import pytest

from server.light.view_middle import SHARE, STEP_PX, ViewMiddle
from server.opencl.device import Device
from server.opencl.engine import Engine
from tests.reference import view_middle as twin
from tests.scenes.solids import upload_surface
from tests.scenes.tolerance import relative_tolerance

EYE = np.array([0.3, -0.2, -1.5])


@pytest.mark.parametrize(("height", "width"), [(48, 64), (61, 83), (3, 5), (1, 1), (2, 400)])
def test_against_the_twin(engine: Engine, device: Device, height: int, width: int) -> None:
    random = np.random.default_rng(height)
    positions = random.uniform(0.5, 4.0, (height, width, 3)).astype(np.float32).astype(np.float64)
    valid = random.random((height, width)) < 0.6
    surface = upload_surface(engine, positions, np.zeros_like(positions), valid)
    found = ViewMiddle(engine, surface).seen_from(EYE)
    expected = twin.view_middle(np.dstack([positions, valid]), EYE, STEP_PX, SHARE)
    assert (found is None) == (expected is None)
    if found is not None:
        np.testing.assert_allclose(found, expected, rtol=relative_tolerance(device))


def test_without_surface_there_is_none(engine: Engine) -> None:
    nothing = np.zeros((8, 8), bool)
    surface = upload_surface(engine, np.ones((8, 8, 3)), np.ones((8, 8, 3)), nothing)
    assert ViewMiddle(engine, surface).seen_from(EYE) is None


def test_before_a_wall_it_lies_in_free_space(engine: Engine) -> None:
    """A wall 2 m ahead fills the picture: the middle is 0.2 m in front of it, on the axis."""
    u, v = np.meshgrid(np.arange(64) - 31.5, np.arange(48) - 23.5)
    wall = EYE + np.dstack([u / 20, v / 20, np.full_like(u, 2.0)])
    surface = upload_surface(engine, wall, np.zeros_like(wall), np.ones(u.shape, bool))
    found = ViewMiddle(engine, surface).seen_from(EYE)
    assert found is not None
    np.testing.assert_allclose(
        found, EYE + np.array([0, 0, 1.8]), atol=0.5 * 1 / 20
    )  # half a pixel: the samples' own offset
