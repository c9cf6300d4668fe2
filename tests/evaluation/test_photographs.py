"""The evaluations on real photographs, on photographs made from a known light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from server.maths.sh import lambert_transfer
from tests.bench.truth.photometric_set import (
    PhotometricSet,
    Samples,
    angles_deg,
    ball_samples,
    find_ball_lights,
    find_light,
    find_statue_lights,
    judge_sums,
    read_photometric_set,
)
from tests.bench.truth.socrates import (
    BANDS,
    BustView,
    explained,
    find_effects,
    fit_light,
    plain_fit,
    without_effects,
)
from tests.data import data_folder
from tests.scenes import lights
from tests.scenes.lights import degrees_between, random_directions, unit

Floats = NDArray[np.float64]
LIGHTS = unit(np.random.default_rng(0).normal(size=(8, 3)) * [0.4, 0.4, 0.1] + [0, 0.2, 0.9])


def front(count: int, seed: int) -> Floats:
    """[count, 3] directions that face the camera."""
    directions = random_directions(count, seed)
    directions[:, 2] = np.abs(directions[:, 2])
    return directions


def lit(normals: Floats, albedo: Floats, directions: Floats) -> Floats:
    """[k, n, 3] pictures of matte surfaces, each light from one direction, with attached shadows."""
    return 0.8 * (albedo * np.maximum(directions @ normals.T, 0))[..., None] * [1.0, 0.9, 0.8]


def made_set(noise: float = 0.0) -> PhotometricSet:
    random = np.random.default_rng(1)
    ball, statue = front(8000, 2), front(8000, 3)
    albedo = random.uniform(0.3, 0.9, len(statue))
    pictures = [lit(ball, np.ones(len(ball)), LIGHTS), lit(statue, albedo, LIGHTS)]
    ball_pictures, statue_pictures = (np.clip(p + noise * random.normal(size=p.shape), 0, 1) for p in pictures)
    return PhotometricSet(LIGHTS, LIGHTS, ball_pictures, ball, statue_pictures)


def test_directions_of_known_lights() -> None:
    photographs = made_set(noise=0.01)
    # Four bands and a half of the sphere stand for a clamped cosine, and 160 independent samples: 2 degrees.
    assert angles_deg(find_ball_lights(photographs, 1), LIGHTS).max() < 2.0
    assert angles_deg(find_statue_lights(photographs, 1), LIGHTS).max() < 3.0


def test_outliers_do_not_turn_the_light() -> None:
    photographs = made_set()
    picture = photographs.ball[0].copy()
    shadowed = photographs.ball_normals[:, 0] > 0.6
    picture[shadowed] *= 0.1
    samples = ball_samples(photographs)
    robust, plain = (angles_deg([find_light(samples, picture, steps)], LIGHTS[:1])[0] for steps in (10, 0))
    assert robust < 0.5 * plain


def test_shares_of_sums() -> None:
    photographs = made_set()
    samples = ball_samples(photographs)
    sums = judge_sums(samples, photographs.ball[:5], 2)
    assert sums.shares.shape == (10, 2)
    np.testing.assert_allclose(sums.shares, 1, atol=0.01)
    assert sums.rests.max() < 0.01


def bust(light: Floats, count: int, seed: int, noise: float = 0.0) -> BustView:
    """A view of a bust without concavities under luminance coefficients `light` [25]."""
    normals = random_directions(count, seed)
    transfer = lambert_transfer(normals, BANDS)
    luminance = transfer @ light + noise * np.random.default_rng(seed).normal(size=count)
    return BustView(normals, transfer, normals @ random_directions(1, 100 + seed)[0], luminance)


def test_one_light_explains_all_views() -> None:
    light = np.zeros(25)
    light[:16] = lights.lobe_and_sky((0.2, -0.9, 0.4))[:, 1]
    views = [bust(light, 3000, seed, noise=0.01) for seed in range(3)]
    found = fit_light(views)
    assert found.explained > 0.98
    assert degrees_between(found.linear_direction, (0.2, -0.9, 0.4)) < 2
    assert degrees_between(found.direction, (0.2, -0.9, 0.4)) < 2
    assert found.explained == pytest.approx(plain_fit(views), abs=0.01)  # nothing is hidden here


def test_exposures_and_what_the_camera_hides_are_found() -> None:
    """And the light of a single view, which cannot tell them, is right without them only."""
    light = np.zeros(25)
    light[:16] = lights.lobe_and_sky((0.2, -0.9, 0.4))[:, 1]
    true_exposures, true_hidden = np.array([0.5, 1.1, 1.4]), 0.3 * light[0]
    seen = []
    for seed, exposure in enumerate(true_exposures):
        view = bust(light, 3000, seed, noise=0.01)
        shading = view.luminance - true_hidden * np.maximum(view.facing, 0)
        seen.append(replace(view, luminance=exposure * shading))
    effects = find_effects(seen)
    np.testing.assert_allclose(effects.exposures, true_exposures, rtol=0.01)
    assert effects.hidden == pytest.approx(true_hidden, rel=0.05)
    corrected = without_effects(seen, effects)
    assert fit_light(corrected).explained > 0.98
    for view, clean in zip(seen, corrected, strict=True):
        assert degrees_between(fit_light([clean]).linear_direction, (0.2, -0.9, 0.4)) < 2
        assert degrees_between(fit_light([view]).linear_direction, (0.2, -0.9, 0.4)) > 4


def test_explained_share() -> None:
    seen = np.array([1.0, 2.0, 3.0, 4.0])
    assert explained(seen, seen) == 1
    assert explained(seen, np.full(4, 2.5)) == 0


@pytest.mark.data
def test_real_ball_and_statue() -> None:
    photographs = read_photometric_set(data_folder("light_uw_photometric"))
    assert len(photographs.lights) == 12
    assert np.degrees(np.arccos(np.sum(photographs.lights * photographs.mirror_lights, axis=1))).max() < 9
    samples = Samples(photographs.ball_normals[::20], np.ones(len(photographs.ball_normals[::20])))
    found = [find_light(samples, picture[::20]) for picture in photographs.ball]
    assert angles_deg(found, photographs.lights).mean() < 5  # measured 4.4
