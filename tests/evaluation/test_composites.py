"""Measures of composites on pictures whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest

from server.shading.composite import srgb_codes
from tests.bench.rendering.composites import (
    NOISE,
    RIM_PX,
    bleeding_slope,
    changed_pixels,
    chroma,
    grown,
    local_means,
    luminance,
    picture_errors,
    real_pixels_around,
    shadow_correlation,
    shadow_slope,
)
from tests.bench.rendering.flip import flip_map


def picture(seed: int = 3) -> np.ndarray:
    """[48, 64, 3] smooth codes with an edge in them."""
    v, u = np.mgrid[:48, :64]
    shown = np.stack([0.2 + 0.4 * u / 64, 0.3 + 0.3 * v / 48, np.where(u > 30, 0.6, 0.2)], axis=-1)
    return srgb_codes(shown + np.random.default_rng(seed).normal(0, 0.005, shown.shape))


@pytest.fixture
def flip() -> None:
    pytest.importorskip("flip_evaluator", reason="flip_evaluator is not installed: make install-bench")


@pytest.mark.usefixtures("flip")
def test_equal_pictures_have_no_error() -> None:
    error = flip_map(picture(), picture())
    assert error.shape == (48, 64)
    assert error.max() < 1e-6


@pytest.mark.usefixtures("flip")
def test_white_is_as_far_from_black_as_can_be() -> None:
    black, white = np.zeros((32, 32, 3), np.uint8), np.full((32, 32, 3), 255, np.uint8)
    assert flip_map(black, white).min() > 0.95
    np.testing.assert_allclose(flip_map(black, white), flip_map(white, black), atol=1e-6)


@pytest.mark.usefixtures("flip")
def test_a_shifted_picture_errs_at_its_edge() -> None:
    error = flip_map(picture(), np.roll(picture(), 2, axis=1))
    assert error[8:-8, 29:33].mean() > 5 * error[8:-8, 10:20].mean()
    assert flip_map(picture(), np.roll(picture(), 4, axis=1))[8:-8, 8:-8].mean() > error[8:-8, 8:-8].mean()


@pytest.mark.usefixtures("flip")
def test_only_changed_pixels_count() -> None:
    without, test = picture(), picture()
    with_objects = without.copy()
    with_objects[10:20, 10:20] = 255
    changed = changed_pixels(with_objects, without)
    assert changed.sum() == 100
    test[10:20, 10:20] = 255
    test[40:, :] = 0  # wrong, and far from what the objects change
    assert picture_errors(with_objects, test, changed).mean() < 0.02
    assert picture_errors(with_objects, without, changed).mean() > 0.4


@pytest.mark.usefixtures("flip")
def test_pictures_of_other_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="different sizes"):
        flip_map(picture(), picture()[:-1])


def test_one_code_is_a_change() -> None:
    shown = picture()
    other = shown.copy()
    other[5, 6, 2] ^= 1
    assert list(zip(*np.nonzero(changed_pixels(other, shown)), strict=True)) == [(5, 6)]


def test_masks_grow_by_squares() -> None:
    mask = np.zeros((9, 9), bool)
    mask[4, 4] = True
    assert grown(mask, 0).sum() == 1
    assert grown(mask, 2)[2:7, 2:7].all()
    assert grown(mask, 2).sum() == 25


def test_real_pixels_leave_out_the_objects_and_their_border() -> None:
    objects, changed = np.zeros((40, 40), bool), np.zeros((40, 40), bool)
    objects[10:20, 10:20] = True
    changed[10:20, 10:30] = True
    real = real_pixels_around(changed, objects)
    assert not real[9:21, 9:21].any()
    assert real[10:20, 21 : 30 + RIM_PX].all()
    assert not real[:, 30 + RIM_PX :].any()
    assert real[8, 8]  # rim, beside the border


def shadow(seed: int = 5) -> np.ndarray:
    """[1000, 3] a true darkening."""
    return -np.random.default_rng(seed).uniform(0, 0.3, (1000, 1)) * np.array([1.0, 0.9, 0.8])


def test_a_shadow_correlates_with_itself_at_any_strength() -> None:
    assert shadow_correlation(shadow(), shadow()) == pytest.approx(1)
    assert shadow_correlation(0.3 * shadow(), shadow()) == pytest.approx(1)
    assert shadow_correlation(-shadow(), shadow()) == pytest.approx(-1)
    assert abs(shadow_correlation(shadow(6), shadow())) < 0.15
    assert shadow_slope(0.3 * shadow(), shadow()).value == pytest.approx(0.3)


def test_noise_as_large_as_the_shadow_halves_what_is_explained() -> None:
    true = shadow()
    noise = np.random.default_rng(7).normal(0, luminance(true).std(), (1000, 1)) * np.ones(3)
    assert shadow_correlation(true + noise, true) == pytest.approx(0.5**0.5, abs=0.05)


def test_no_shadow_at_all_does_not_correlate() -> None:
    assert shadow_correlation(np.zeros((1000, 3)), shadow()) == 0
    assert shadow_slope(np.zeros((1000, 3)), shadow()).value == 0


def test_grey_has_no_chroma() -> None:
    np.testing.assert_array_equal(chroma(np.full((2, 3), 0.7)), np.zeros((2, 2)))
    np.testing.assert_allclose(chroma(np.array([0.5, 0.2, 0.1])), (0.3, -0.1))


def test_bleeding_is_told_by_colour_not_by_brightness() -> None:
    generator = np.random.default_rng(9)
    true = generator.uniform(0.05, 0.2, (500, 1)) * np.array([1.0, 0.2, 0.2])
    darker = true - generator.uniform(0, 0.3, (500, 1))
    assert bleeding_slope(darker, true).value == pytest.approx(1)
    assert bleeding_slope(0.5 * true, true).value == pytest.approx(0.5)
    assert bleeding_slope(0.2 - true, true).value == pytest.approx(-1)
    assert bleeding_slope(np.zeros_like(true), true).value == 0


def test_what_drowns_in_noise_says_nothing() -> None:
    true = np.full((50, 3), (0.5 * NOISE, 0.0, 0.0))
    found = bleeding_slope(true, true)
    assert found.samples == 0
    assert np.isnan(found.value)


def test_local_means_stay_inside_their_mask() -> None:
    mask = np.zeros((20, 30), bool)
    mask[:, :15] = True
    values = np.where(mask[..., None], (0.1, 0.2, 0.3), 99.0)
    means = local_means(values, mask)
    assert means.shape == (300, 3)
    np.testing.assert_allclose(means, np.tile((0.1, 0.2, 0.3), (300, 1)), atol=1e-12)


def test_means_of_a_noisy_truth_make_the_slope_right() -> None:
    """Noise on the truth makes a regression on it too small; its mean over the pixels around does not."""
    generator = np.random.default_rng(11)
    mask = np.ones((60, 80), bool)
    clean = np.zeros((60, 80, 3))
    clean[..., 0] = 0.03 * np.linspace(0, 1, 80)
    noisy = clean + generator.normal(0, 0.02, clean.shape)
    assert bleeding_slope(clean[mask], noisy[mask]).value < 0.5
    assert bleeding_slope(local_means(clean, mask), local_means(noisy, mask)).value == pytest.approx(1, abs=0.15)
