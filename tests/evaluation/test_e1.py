"""E1: pictures of reconstructed geometry under a known light, and the scores of what is estimated from them."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from client.sources.volume import default_volume, default_voxel
from client.synthetic.source import open_synthetic
from client.tuning.known_light import ALBEDO, BACKGROUND, ShadedView, moving_light, shaded_views
from protocol.messages import Wishes
from server.opencl.device import Device
from tests.bench.light.e1 import FRAMES, SEQUENCES, Thing, WithThings, light_of
from tests.bench.light.light_score import lag_of, score
from tests.scenes.lights import degrees_between, lobe_and_sky, uniform

COUNT = 3


@pytest.fixture(scope="module")
def views(device: Device) -> list[ShadedView]:
    source = open_synthetic(f"synthetic:table?size=160x120&frames={COUNT}")
    volume_m = default_volume(source, range(COUNT))
    frames = (source[i] for i in range(COUNT))
    return list(shaded_views(device, source.camera, frames, volume_m, default_voxel(volume_m), rays=162))


def test_an_open_surface_under_a_uniform_sky_shows_its_albedo(views: list[ShadedView]) -> None:
    shown = views[-1].under(uniform())
    covered = views[-1].covered
    assert 0.3 < covered.mean() < 0.9
    assert np.percentile(shown[covered], 90) == pytest.approx(ALBEDO, rel=0.01)
    assert shown[covered].max() < 1.01 * ALBEDO
    assert (shown[~covered] == BACKGROUND).all()
    assert shown[covered].min() < 0.7 * ALBEDO  # corners are dark


def test_the_picture_is_the_only_thing_replaced(views: list[ShadedView]) -> None:
    lit = views[1].lit(lobe_and_sky((0, 1, 1)))
    assert lit.frame.index == 1
    assert lit.frame.depth is views[1].frame.depth
    assert lit.frame.color.dtype == np.uint8
    assert (lit.frame.color != views[1].frame.color).any()
    red = views[1].under(lobe_and_sky((0, 1, 1)), np.array([0.5, 0.1, 0.1]))
    np.testing.assert_allclose(
        red[views[1].covered, 1], 0.2 * views[1].under(lobe_and_sky((0, 1, 1)))[views[1].covered, 1]
    )


def test_each_frame_has_the_light_of_its_number(views: list[ShadedView]) -> None:
    lights = [lobe_and_sky((x, 1, 0)) for x in range(COUNT)]
    for number, item in enumerate(moving_light(views, lambda index: lights[index])):
        assert item.sh is lights[number]


def test_the_score_is_that_of_the_light_in_the_picture(device: Device, views: list[ShadedView]) -> None:
    source = open_synthetic(f"synthetic:table?size=160x120&frames={COUNT}")
    volume_m = default_volume(source, range(COUNT))
    wishes = Wishes(preset="rm", volume_m=volume_m, voxel_m=default_voxel(volume_m))
    light = 0.5 * lobe_and_sky((1, 2, 1))
    honest = [view.lit(light) for view in views]
    lying = [replace(item, sh=lobe_and_sky((-1, 2, -1))) for item in honest]
    found, misled = (score(device, source.camera, frames, wishes) for frames in (honest, lying))
    assert len(found.dots) == len(found.differences) == len(found.lights) == COUNT
    assert min(found.dots) > 0.97  # seen: .979
    assert max(found.differences) < 0.5
    assert max(misled.dots) < 0.8
    assert min(misled.differences) > max(found.differences)


def test_the_light_goes_around_once_and_slowly() -> None:
    steps = [degrees_between(light_of(i)[[3, 1, 2], 0], light_of(i + 1)[[3, 1, 2], 0]) for i in range(FRAMES)]
    assert 0.3 < min(steps) < max(steps) < 2
    np.testing.assert_allclose(light_of(0), light_of(FRAMES), atol=1e-12)
    assert degrees_between(light_of(0)[[3, 1, 2], 0], (0, 1, 1)) < 1e-6  # 45 degrees high, from +z


def test_lateness_is_told_from_other_errors() -> None:
    true = [light_of(index) for index in range(40)]
    assert lag_of(true, true, 6) == (0, pytest.approx(0, abs=1e-5))
    assert lag_of([light_of(index - 4) for index in range(40)], true, 6) == (4, pytest.approx(0, abs=1e-5))
    still = [light_of(0)] * 40
    late, angle_deg = lag_of([light_of(7)] * 40, still, 6)  # wrong, but not late
    assert late == 0
    assert angle_deg == pytest.approx(degrees_between(light_of(0)[[3, 1, 2], 0], light_of(7)[[3, 1, 2], 0]))
    with pytest.raises(ValueError, match="6 frames do not show a lag of 6"):
        lag_of(true[:6], true[:6], 6)


def test_things_come_and_go() -> None:
    thing = Thing((0.0, 0.0, 0.0), 0.2, True, (0.2, 0.6))
    there = [index for index in range(100) if thing.solid(index, 100) is not None]
    assert there == list(range(20, 60))
    bottoms = [thing.solid(index, 100).center[1] - 0.1 for index in there]  # type: ignore[union-attr]
    assert bottoms[0] > 0.2
    assert bottoms[10] == pytest.approx(0)
    assert all(a > b for a, b in pairwise(bottoms[:6]))
    assert bottoms[-1] > 0.2


def test_a_thing_stands_before_the_table() -> None:
    source = WithThings(SEQUENCES[3], 40)
    before, with_it = source[2], source[14]
    assert (before.depth == source.source[2].depth).all()
    bare = source.source[14].depth
    nearer = (with_it.depth > 0) & ((bare == 0) | (with_it.depth < bare - 20.0))
    assert 0.01 < nearer.mean() < 0.3
    np.testing.assert_array_equal(source.source.pose(2), source.source.pose(14))
    assert len(SEQUENCES) == 5
    assert {sequence.is_still for sequence in SEQUENCES} == {True, False}
