"""Shadows on clipped surface: against the twin, and where the answer is known. A clipped channel is a lower bound."""

from __future__ import annotations

import numpy as np
import pytest

from server.input.measure import linear_values
from server.maths.sh import LUMINANCE
from server.opencl.engine import Engine
from server.shading.composite import log_white, srgb_codes
from tests.reference import composite as twin
from tests.scenes import lights
from tests.scenes.analytic import Floats
from tests.scenes.composite_scene import (
    HEIGHT,
    TOLERANCE_M,
    VOLUME_FROM_CAMERA,
    WIDTH,
    Codes,
    buffer,
    compose,
    plane,
    samples,
)

WALL = buffer(*plane(1.0))
WARM = np.array([1.5, 1.0, 0.5])
AT_BOUND = twin.DEVIATION * np.sqrt(2 / np.pi)
"""Mean of the log radiance above the bound, of a surface that is expected right at it."""


def of_codes(codes: Codes) -> Floats:
    """[h, w, 4] radiance of a camera's picture."""
    return np.insert(linear_values("srgb8")[codes].astype(float), 3, 1, -1)


def shadowed(engine: Engine, codes: Codes, factor: float, white: Floats | None = None, restores: bool = True) -> Codes:
    light = lights.uniform(np.ones(3) if white is None else white)
    real = samples(4, factor)
    return compose(engine, codes, of_codes(codes), WALL, ratio=real, light=light, restores_clipped=restores)


def even(*code: int) -> Codes:
    return np.full((HEIGHT, WIDTH, 3), code, np.uint8)


def inside(picture: Codes) -> Floats:
    """[3] the codes in the picture's middle."""
    return picture[HEIGHT // 2, WIDTH // 2].astype(float)


@pytest.mark.parametrize("white", [(1.0, 1.0, 1.0), tuple(WARM), (1.0, 0.0, 0.0)])
def test_clipped_pixels_are_the_twins(engine: Engine, white: tuple[float, float, float]) -> None:
    """Noise of many clipped and outside pixels, and regions that are clipped in one, two and three channels."""
    random = np.random.default_rng(4)
    codes = random.integers(200, 300, (HEIGHT, WIDTH, 3)).clip(0, 255).astype(np.uint8)
    codes[:20, :30, 0] = codes[10:30, 20:, 1] = codes[25:, :, 2] = 255
    radiance = of_codes(codes)
    radiance[..., 3] = random.choice([1, 0, -1], (HEIGHT, WIDTH), p=[0.7, 0.2, 0.1])
    ratio = samples(4, random.uniform(0.2, 1.3, (HEIGHT // 4, WIDTH // 4, 3)))
    light = lights.uniform(white)
    found = compose(engine, codes, radiance, WALL, ratio=ratio, light=light, restores_clipped=True)
    pose = np.linalg.inv(VOLUME_FROM_CAMERA)
    arguments = (codes, radiance, WALL, pose, TOLERANCE_M, light, None, None, ratio)
    tint = log_white(np.array(white))
    expected = twin.composite(*arguments, log_white=tint)
    difference = np.abs(found.astype(int) - expected)
    assert difference.max() <= 1
    assert (difference > 0).mean() < 5e-3
    assert (expected != twin.composite(*arguments)).any(-1).mean() > 0.2


def test_white_surface_that_is_clipped_all_over_is_as_bright_as_the_tail_of_what_it_may_be(engine: Engine) -> None:
    for factor in (0.1, 0.5, 0.7):
        expected = srgb_codes(np.full(3, factor * np.exp(AT_BOUND)))
        np.testing.assert_allclose(inside(shadowed(engine, even(255, 255, 255), factor)), expected, atol=1)


def test_white_surface_in_warm_light_keeps_its_colour_in_a_shadow(engine: Engine) -> None:
    """Red is twice the bound: the picture shows 1, blue and green tell the rest. Without it the shadow is green."""
    true = 2.0 * WARM / WARM[0]
    codes = even(*srgb_codes(true))
    assert (codes[0, 0] == 255).tolist() == [True, True, False]
    expected = 0.4 * true
    found = linear_values("srgb8")[inside(shadowed(engine, codes, 0.4, WARM)).astype(int)]
    above = twin.restored(of_codes(codes), 5, 5, np.log(WARM / (WARM @ LUMINANCE))) / true
    assert 1.0 < above[0] < 1.05
    np.testing.assert_allclose(found, expected * above, rtol=0.02)
    plain = linear_values("srgb8")[inside(shadowed(engine, codes, 0.4, WARM, restores=False)).astype(int)]
    assert plain[0] < 0.55 * expected[0]


@pytest.mark.parametrize("code", [(255, 255, 255), (255, 240, 180), (254, 254, 100), (255, 20, 20)])
def test_no_factor_brightens_a_clipped_channel_and_a_deeper_shadow_is_never_brighter(
    engine: Engine, code: tuple[int, int, int]
) -> None:
    before = even(*code)
    is_clipped = np.array(code) >= 254
    last = np.zeros(3)
    for factor in (0.02, 0.2, 0.5, 0.8, 0.95, 0.999, 1.001, 1.3, 3.0):
        found = inside(shadowed(engine, before, factor))
        plain = inside(shadowed(engine, before, factor, restores=False))
        assert (found >= last).all()
        assert (found[is_clipped] <= np.array(code)[is_clipped]).all()
        assert (found[is_clipped] >= np.minimum(plain, code)[is_clipped]).all()
        np.testing.assert_array_equal(found[~is_clipped], plain[~is_clipped])
        last = found


def test_a_single_clipped_pixel_hardly_stands_out(engine: Engine) -> None:
    """Noise carries single pixels of an even surface over the bound: in a shadow they are still next to their
    neighbours, and the rim of a clipped region is half-way."""
    codes = even(253, 253, 253)
    codes[20, 20] = 255
    codes[:, 40:] = 255
    picture = linear_values("srgb8")[shadowed(engine, codes, 0.5)][..., 0]
    assert picture[20, 20] / picture[20, 10] == pytest.approx(
        np.exp(AT_BOUND / 25) / of_codes(codes)[0, 0, 0], rel=0.01
    )
    for column, share in ((40, 0.6), (41, 0.8), (42, 1.0), (50, 1.0)):
        assert picture[20, column] == pytest.approx(0.5 * np.exp(share * AT_BOUND), rel=0.01)


def test_a_dark_light_says_nothing_of_colour() -> None:
    np.testing.assert_array_equal(log_white(np.zeros(3)), 0)
    red = np.exp(log_white(np.array([1.0, 0.0, 0.0])))
    assert red[0] == pytest.approx(4.0)
    assert red[1] == red[2] == pytest.approx(0.25)
