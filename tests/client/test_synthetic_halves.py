"""The room that is half black and half white."""

from __future__ import annotations

import numpy as np
import pytest

from client.synthetic.scenes.halves import BLACK, WHITE
from client.synthetic.source import SyntheticSource, open_synthetic


@pytest.fixture(scope="module")
def halves() -> SyntheticSource:
    return open_synthetic("synthetic:halves?size=64x48&frames=240")


def test_black_on_the_left_and_white_on_the_right(halves: SyntheticSource) -> None:
    truth, pose = halves.truth(0), halves.pose(0)
    v, u = np.indices(truth.depth_m.shape)
    camera = halves.camera
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
    x = (rays * truth.depth_m[..., None]) @ pose[0, :3] + pose[0, 3]
    seen = truth.visible & (np.abs(x) > 1e-3)
    np.testing.assert_allclose(truth.albedo[seen], np.where(x < 0, BLACK, WHITE)[seen, None] * np.ones(3), rtol=1e-6)
    assert 0.2 < (x[seen] < 0).mean() < 0.8


def test_both_halves_are_seen_from_everywhere_on_the_way(halves: SyntheticSource) -> None:
    for index in (60, 120, 180):
        albedo = halves.truth(index).albedo[..., 0]
        assert (np.isclose(albedo, BLACK).mean(), np.isclose(albedo, WHITE).mean()) > (0.2, 0.2)
        assert halves.truth(index).radiance.max() < 1
