"""Coverage of intervals: 95 % where the deviations are right, and what they do where they are not."""

from __future__ import annotations

import numpy as np
import pytest

from tests.bench.light.coverage import Estimate, coverage
from tests.scenes.lights import lobe_and_sky, random_directions

SPREAD = 0.01


def estimates(claimed: float, scale: float = 1.0) -> list[Estimate]:
    """Noise of SPREAD, of which `claimed` times is owned up to; the light scaled as no picture can tell."""
    generator = np.random.default_rng(0)
    result = []
    for direction in random_directions(400, 1):
        true = lobe_and_sky(direction)
        found = true + generator.normal(0, SPREAD, true.shape)
        result.append(Estimate(scale * found, np.full(true.shape, scale * claimed * SPREAD), true))
    return result


@pytest.mark.parametrize("scale", [1.0, 0.6])
def test_honest_deviations_cover_95_percent(scale: float) -> None:
    shares = coverage(estimates(1.0, scale))
    assert shares.shape == (16,)
    np.testing.assert_allclose(shares, 0.95, atol=0.03)


def test_too_sure_and_too_timid_are_told_apart() -> None:
    assert coverage(estimates(0.5)).mean() == pytest.approx(0.673, abs=0.02)  # P(|z| < 0.98)
    assert coverage(estimates(3.0)).mean() > 0.999


def test_an_unknown_deviation_does_not_count() -> None:
    true = lobe_and_sky((0, 1, 0))
    unknown = Estimate(0 * true, np.full(true.shape, np.inf), true)
    assert np.isnan(coverage([unknown])).all()
    known = estimates(0.5)
    np.testing.assert_array_equal(coverage([*known, unknown]), coverage(known))
    partly = Estimate(known[0].mean, np.where(np.arange(16)[:, None] < 4, known[0].std, np.inf), known[0].true)
    assert np.isfinite(coverage([partly])).tolist() == [True] * 4 + [False] * 12
