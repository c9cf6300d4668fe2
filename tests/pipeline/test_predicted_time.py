"""What a frame will take, before it was measured: enough to tell seconds from minutes."""

from __future__ import annotations

import pytest

from protocol.messages import Wishes
from server.opencl.device import Device
from server.quality.session_quality import RAY_S, SessionQuality


@pytest.mark.parametrize(
    ("wishes", "preset", "rays"),
    [
        (Wishes(preset="reg4"), "reg4", 160 * 120 * 81),
        (Wishes(preset="reg4", rays=1024, stride=1), "reg4", 640 * 480 * 1024),
        (Wishes(preset="reg4", rays=1024, stride=1), "rm", 640 * 480 * 1024),
        (Wishes(preset="rm"), "reg4", 160 * 120 * 81),
        (Wishes(preset="reg4", interleave=4, rays=64), "reg4", 160 * 120 * 16),
    ],
)
def test_it_is_that_of_all_rays(device: Device, wishes: Wishes, preset: str, rays: int) -> None:
    predicted_s = SessionQuality(device, wishes).predicted_s(preset, 640, 480)
    assert predicted_s == pytest.approx(rays * RAY_S / device.cl_device.max_compute_units)


def test_a_budget_needs_none(device: Device) -> None:
    assert SessionQuality(device, Wishes(preset="auto", budget_ms=200.0)).predicted_s("auto", 640, 480) == 0.0
