"""Layers against their float64 twin, and layers whose every pixel is known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from server.opencl.device import Device
from server.opencl.engine import Engine
from server.shading.layer import DEPTH_SCALE_M, NEUTRAL, NOTHING, Layer, LayerPart, compose_layer
from tests.reference import composite as twin
from tests.scenes.composite_scene import (
    HEIGHT,
    LIGHT,
    NONE_TAKEN,
    TOLERANCE_M,
    VOLUME_FROM_CAMERA,
    WALL,
    WIDTH,
    Codes,
    Floats,
    buffer,
    camera_picture,
    compose,
    mixture_of,
    plane,
    samples,
)
from tests.scenes.lanes import KINDS

CAMERA_FROM_VOLUME = np.linalg.inv(VOLUME_FROM_CAMERA)


def layer_of(engine: Engine, *mixed: Any, **named: Any) -> Layer:
    return compose_layer(engine, mixture_of(engine, *mixed, **named))


def whole(part: LayerPart | None, color: int = 0, channels: int = 4) -> tuple[Codes, Codes]:
    """Colour and depth [HEIGHT, WIDTH] of a part, `color` and 0 outside of it."""
    colors, depths = np.full((HEIGHT, WIDTH, channels), color, np.uint8), np.zeros((HEIGHT, WIDTH), np.uint16)
    if part is not None:
        height, width = part.depth.shape
        box = slice(part.y, part.y + height), slice(part.x, part.x + width)
        colors[box], depths[box] = part.color, part.depth
    return colors, depths


def hard_scene() -> tuple[Codes, tuple[Any, ...], Floats]:
    """Four parts a pixel; a leaning disc that a wall cuts through, shadows, gaps in the wall and in the picture.

    What is shown, what is mixed, and its fine depths.
    """
    random = np.random.default_rng(8)
    shown, radiance = camera_picture()
    radiance[..., 3] = random.choice([1, 0, -1], (HEIGHT, WIDTH), p=[0.8, 0.1, 0.1])
    v, u = np.mgrid[: 2 * HEIGHT, : 2 * WIDTH] / 2
    fine = (u - 30) ** 2 + (v - 20) ** 2 < 300
    inverse_depths = np.where(fine, 1 / (1.0 + 0.01 * (u - 30)), 0).astype(np.float32).astype(float)
    virtual = buffer(*plane(0.8, 0.7), fine[::2, ::2])
    real = buffer(*plane(1.0), random.random((HEIGHT, WIDTH)) < 0.9)
    ratio = samples(4, random.uniform(0.0, 2.2, (HEIGHT // 4, WIDTH // 4, 3)))
    ratio.values[: len(ratio.values) // 3, :, :3] = 1  # a part of the picture is not touched
    ratio.values[-4:, -6:, :3] = 4.5  # one is brighter than there are codes for
    ratio.values[-4:, :4, :3] = 0.004  # and one is as dark as below things that stand on it
    occluded = samples(2, random.uniform(0, 0.2, (HEIGHT // 2, WIDTH // 2, 3)))
    occluded.values[..., 3] = virtual.positions[1::2, 1::2, 3]
    return shown, (radiance, real, virtual, occluded, ratio), inverse_depths


@KINDS
@pytest.mark.parametrize("is_smooth", [True, False])
def test_layer_is_the_twins(device: Device, is_smooth: bool, kind: type[Engine]) -> None:
    engine = kind(device)
    _, (radiance, real, *virtual), fine = hard_scene()
    fine = fine if is_smooth else None
    found = layer_of(engine, radiance, real, *virtual, inverse_depths=fine)
    mixed = twin.mix(radiance, real, CAMERA_FROM_VOLUME, TOLERANCE_M, LIGHT, *virtual, inverse_depths=fine)
    colors, factors, virtual_depths, real_depths = twin.layer(DEPTH_SCALE_M, mixed)
    (got_colors, got_depths), (got_factors, got_real) = (
        whole(found.virtual),
        whole(found.ratio, NEUTRAL, channels=3),
    )
    np.testing.assert_array_equal(got_colors[..., 3], colors[..., 3])  # sixteenths: no rounding
    if is_smooth:
        assert set(np.unique(colors[..., 3])) <= set(np.rint(np.arange(17) / 16 * 255))
        assert len(np.unique(colors[..., 3])) > 8
    # Rounding to a code: neighbours may swap.
    for got, expected in ((got_colors, colors), (got_factors, factors), (got_depths, virtual_depths)):
        difference = np.abs(got.astype(int) - expected)
        assert difference.max() <= 1
        assert (difference > 0).mean() < 5e-3
    np.testing.assert_array_equal(got_depths == 0, colors[..., 3] == 0)
    np.testing.assert_array_equal((got_factors != NEUTRAL).any(-1), (factors != NEUTRAL).any(-1))
    assert (got_real[(factors != NEUTRAL).any(-1)] > 0).all()
    inside = got_real > 0
    assert np.abs(got_real[inside].astype(int) - real_depths[inside]).max() <= 1
    assert (factors == 255).any()
    assert 0 < inside.mean() < 1
    engine.close()


def test_depth_of_real_surface_goes_one_pixel_beyond_what_is_changed(engine: Engine) -> None:
    """A client that interpolates at the rim needs it; farther out the layer is empty."""
    _, (radiance, real, *virtual), fine = hard_scene()
    ratio = virtual[-1].values
    ratio[:, :, :3] = 1
    ratio[2:4, 3:5, :3] = ratio[-4:-2, -5:-3, :3] = 2  # two places, with a gap between them
    factors, depths = whole(layer_of(engine, radiance, real, *virtual, inverse_depths=fine).ratio, NEUTRAL, channels=3)
    changed = (factors != NEUTRAL).any(-1)
    beside = np.pad(changed, 1)
    near = np.any([beside[1 + y : 1 + y + HEIGHT, 1 + x : 1 + x + WIDTH] for y in (-1, 0, 1) for x in (-1, 0, 1)], 0)
    assert not depths[~near].any()
    assert (depths[near & ~changed] > 0).any()


def test_parts_are_no_larger_than_what_they_hold(engine: Engine) -> None:
    _, (radiance, real, *virtual), fine = hard_scene()
    found = layer_of(engine, radiance, real, *virtual, inverse_depths=fine)
    assert found.virtual is not None
    assert found.ratio is not None
    covered, changed = found.virtual.color[..., 3] > 0, (found.ratio.color != NEUTRAL).any(-1)
    assert all(edge.any() for edge in (covered[0], covered[-1], covered[:, 0], covered[:, -1]))
    assert found.ratio.y > 0  # the upper part is not touched
    assert not changed[0].any()  # where the surface goes on, the part does for a pixel
    assert changed[1].any()


def linear_of(codes: Floats) -> Floats:
    x = np.clip(codes / 255, 0, 1)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def test_layer_over_the_camera_picture_is_the_composite(engine: Engine) -> None:
    """But for the rounding of colours, of factors (which are not told apart above 3.97) and of the picture."""
    shown, (radiance, real, virtual, occluded, ratio), fine = hard_scene()
    mixed = (radiance, real, virtual, occluded, replace(ratio, values=np.minimum(ratio.values, 3.9)))
    picture = compose(engine, shown, *mixed, inverse_depths=fine).astype(int)
    layer = layer_of(engine, *mixed, inverse_depths=fine)
    (colors, _), (factors, _) = whole(layer.virtual), whole(layer.ratio, NEUTRAL, channels=3)
    coverage = np.rint(colors[..., 3:] / 255 * 16) / 16
    assert (colors[..., :3] < 255).all()  # what is brighter than white shows in mixtures
    bounds = []
    for half in (-0.5, 0.5):
        own, root = linear_of(colors[..., :3] + half), np.where(factors == NEUTRAL, NEUTRAL, factors + half) / NEUTRAL
        bounds.append(twin.srgb_codes(coverage * own + (1 - coverage) * root**2 * radiance[..., :3]).astype(int))
    inside = radiance[..., 3] >= 0
    assert ((bounds[0] - 1 <= picture) & (picture <= bounds[1] + 1))[inside].all()
    assert (picture != shown).any(-1).mean() > 0.3
    assert (bounds[1] - bounds[0])[coverage[..., 0] == 1].max() <= 2


def test_outside_the_rectified_picture_there_is_nothing_to_mix_with(engine: Engine) -> None:
    _, (radiance, real, *virtual), fine = hard_scene()
    radiance = np.array(radiance)
    radiance[..., 3] = 1
    inside = layer_of(engine, radiance, real, *virtual, inverse_depths=fine)
    radiance[:, :30, 3] = -1
    outside = layer_of(engine, radiance, real, *virtual, inverse_depths=fine)
    before, after = (whole(layer.virtual)[0][:, :30, 3] for layer in (inside, outside))
    np.testing.assert_array_equal(after, np.where(before > 0, 255, 0))
    assert (before != after).any()
    assert (whole(outside.ratio, NEUTRAL, channels=3)[0][:, :30] == NEUTRAL).all()
    assert (whole(inside.ratio, NEUTRAL, channels=3)[0][:, :30] != NEUTRAL).any()


def test_nothing_virtual_is_a_layer_of_nothing(engine: Engine) -> None:
    _, radiance = camera_picture()
    assert layer_of(engine, radiance, WALL) is NOTHING
    nowhere = buffer(*plane(0.5), False)
    for ratio in (None, samples(4, 1.0), samples(4, 1 - 1e-6), samples(4, 0.5, 0.0)):
        assert layer_of(engine, radiance, WALL, nowhere, NONE_TAKEN, ratio) == NOTHING


def test_an_object_behind_real_surface_is_not_in_the_layer(engine: Engine) -> None:
    """A leaning plane cuts through the wall: its nearer part is there, with its own depth, the farther is not."""
    _, radiance = camera_picture()
    points, normals = plane(1.0, 0.6)
    layer = layer_of(engine, radiance, WALL, buffer(points, normals), NONE_TAKEN)
    colors, depths = whole(layer.virtual)
    z = (points @ CAMERA_FROM_VOLUME[:3, :3].T + CAMERA_FROM_VOLUME[:3, 3])[..., 2]
    hidden, seen = z > 1 + TOLERANCE_M + 1e-5, z < 1 + TOLERANCE_M - 1e-5
    assert min(hidden.mean(), seen.mean()) > 0.3
    assert not colors[hidden].any()
    assert not depths[hidden].any()
    assert (colors[seen][:, 3] == 255).all()
    np.testing.assert_allclose(DEPTH_SCALE_M * depths[seen], z[seen], atol=0.51 * DEPTH_SCALE_M)
    assert layer.ratio is None


def test_a_quarter_of_the_light_is_half_the_code_of_all(engine: Engine) -> None:
    _, radiance = camera_picture()
    layer = layer_of(engine, radiance, WALL, ratio=samples(4, 0.25))
    assert layer.virtual is None
    assert layer.ratio is not None
    assert layer.ratio.depth.shape == (HEIGHT, WIDTH)
    assert (layer.ratio.x, layer.ratio.y) == (0, 0)
    assert np.abs(layer.ratio.color.astype(int) - NEUTRAL // 2).max() <= 1
    np.testing.assert_allclose(DEPTH_SCALE_M * layer.ratio.depth, 1.0, atol=0.51 * DEPTH_SCALE_M)


def test_what_is_too_near_or_too_far_for_its_depth_keeps_one(engine: Engine) -> None:
    """0 would say that the pixel says nothing."""
    _, radiance = camera_picture()
    for z, code in ((0.2 * DEPTH_SCALE_M, 1), (90.0, 65535)):
        virtual = buffer(*plane(z))
        layer = layer_of(engine, radiance, buffer(*plane(100.0)), virtual, NONE_TAKEN)
        assert layer.virtual is not None
        assert set(layer.virtual.depth.ravel()) == {code}
