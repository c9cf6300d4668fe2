"""Lamps in a reconstructed room: found through the stages, and not found where there is none."""

from __future__ import annotations

import pytest

from server.opencl.device import Device
from tests.bench.light.lamp import SCENE, search


@pytest.mark.parametrize("place", [0, 5])
def test_lamp_is_found(device: Device, place: int) -> None:
    result = search(device, f"synthetic:lamp?{SCENE}&place={place}")
    assert result.position_error_m() < 0.03  # seen: 0.011
    assert result.share_error() < 0.06  # seen: 0.033
    (lamp,), (true,) = result.found, result.lamps
    assert lamp.intensity / true.intensity == pytest.approx([1, 1, 1], abs=0.15)


@pytest.mark.parametrize("scene", ["lamp?lamps=0&light=6", "room?light=4&texture=1"])
def test_no_lamp_is_not_found(device: Device, scene: str) -> None:
    assert search(device, f"synthetic:{scene}&{SCENE}").found == ()
