"""The averages that H rests on, against the float64 twin and in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from server.light.light_estimation import ASSUMED_ALBEDO
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.shading.tone_mapping import EVERY, LEAST_LUMINANCE, AverageMemory, Averages
from tests.reference.sh import open_transfer
from tests.scenes.tolerance import relative_tolerance
from tests.scenes.toned_picture import COLS, LIGHT, ROWS, UP, Case


@pytest.mark.parametrize("indirect", [True, False])
def test_averages_are_the_twins(device: Device, engine: Engine, indirect: bool) -> None:
    case = Case()
    found, expected = case.measured(engine, indirect=indirect), case.expected(indirect=indirect)
    assert found.samples == expected.samples > 8
    # Sums of less than a hundred values in float32.
    tolerance = 10 * relative_tolerance(device)
    assert found.picture == pytest.approx(expected.picture, rel=tolerance)
    assert found.shading == pytest.approx(expected.shading, rel=tolerance)


def test_twice_the_picture_is_twice_the_gain(engine: Engine) -> None:
    case, brighter = Case(), Case()
    brighter.radiance[..., :3] *= 2
    assert brighter.measured(engine).gain == pytest.approx(2 * case.measured(engine).gain, rel=1e-5)


def test_a_surface_of_the_assumed_albedo_needs_no_gain(engine: Engine) -> None:
    """In the open its radiance is that albedo times R; every third sample, each of one value."""
    case = Case()
    case.openness[:], case.radiance[..., 3], case.has_surface[:] = 1.0, 1.0, True
    case.transfer[:] = open_transfer(UP, 4)
    case.radiance[..., :3] = ASSUMED_ALBEDO * 2.0 * (open_transfer(UP, 4) @ LIGHT)
    averages = case.measured(engine, indirect=False)
    assert averages.samples == len(range(0, ROWS, EVERY)) * len(range(0, COLS, EVERY))
    assert averages.gain == pytest.approx(1.0, rel=1e-5)


def test_the_memory_holds_still_and_follows_the_exposure() -> None:
    memory, frame = AverageMemory(), Averages(0.2, 0.5, 9)
    assert memory.update(Averages(0.0, 0.0, 0), 1.0).gain == 1.0  # nothing yet
    assert memory.update(frame, 1.0) == frame
    longer = memory.update(Averages(0.4, 1.0, 9), 2.0)
    assert (longer.picture, longer.shading) == pytest.approx((0.4, 1.0))
    black = memory.update(Averages(0.0, 0.5, 9), 1.0)
    assert black.gain == pytest.approx(frame.gain)
    jumped = memory.update(Averages(0.4, 0.5, 9), 1.0)
    assert frame.gain < jumped.gain < 1.5 * frame.gain


def test_what_cannot_be_matched_keeps_the_lights_scale(engine: Engine) -> None:
    """No usable pixel, no surface, a black picture, a black light: 1, and it is known that it is not a measurement."""
    cases = {name: Case() for name in ("clipped", "no surface", "black")}
    cases["clipped"].radiance[..., 3] = 0.0
    cases["no surface"].has_surface[:] = False
    cases["black"].radiance[..., :3] = 0.5 * LEAST_LUMINANCE
    for name, case in cases.items():
        averages = case.measured(engine)
        assert (averages.are_known, averages.gain) == (False, 1.0), name
    dark = Case().measured(engine, np.zeros((16, 3)), indirect=False)
    assert dark.shading == 0.0
    assert (dark.are_known, dark.gain) == (False, 1.0)
