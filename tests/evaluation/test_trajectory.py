"""The absolute trajectory error of benchmarks, over poses whose error is known."""

from __future__ import annotations

import numpy as np
import pytest

from server.maths.registration import motion_of_twist
from tests.bench.geometry.trajectory import aligned_ate_rmse_m


def test_one_rigid_motion_is_no_error() -> None:
    """Two positions off by the same distance to opposite sides leave the best motion where it was."""
    pytest.importorskip("evo", reason="evo is not installed: make install-bench")
    rng = np.random.default_rng(0)
    truth = [motion_of_twist(rng.normal(size=6)) for _ in range(10)]
    moved = [motion_of_twist(rng.normal(size=6)) @ pose for pose in truth]
    elsewhere = motion_of_twist(rng.normal(size=6))
    assert aligned_ate_rmse_m([elsewhere @ pose for pose in truth], truth) == pytest.approx(0, abs=1e-12)
    assert aligned_ate_rmse_m(moved, truth) > 0.1
    corners = [np.eye(4) for _ in range(4)]
    for pose, place in zip(corners, [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)], strict=True):
        pose[:3, 3] = place
    wider = [pose.copy() for pose in corners]
    for pose in wider[:2]:
        pose[:3, 3] *= 1.1
    assert aligned_ate_rmse_m(wider, corners) == pytest.approx(0.1 / np.sqrt(2), rel=1e-6)
