"""The fit of what glossy surface reflects, against the integral that it stands for, in float64.

Karis published his fit (2014) without a bound: the bounds here are measured, and so tight that no constant of the fit
can be halved or doubled. The integral is that of GGX microfacets with Smith's masking and shadowing (height-correlated,
Heitz 2014) and Schlick's Fresnel term, for light of the same radiance from everywhere: a + b F0, where b is the
integral weighted by 1 - (1 - v.h)^5 and a by (1 - v.h)^5.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import dblquad

from server.maths.microfacets import reflected_share

Floats = NDArray[np.float64]
ROUGHNESS = np.linspace(0.1, 1.0, 10)
NOT_GRAZING = 0.25
"""Least cosine at which b is compared by directions: nearer to the horizon the fit is up to 0.49 off."""


def unit_rule(count: int) -> tuple[Floats, Floats]:
    """Nodes and weights [count] of Gauss' rule on 0 to 1."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return (nodes + 1) / 2, weights / 2


COSINES, WEIGHTS = unit_rule(24)
OF_DIRECTIONS = 2 * COSINES * WEIGHTS
"""Weights of COSINES in the mean over a hemisphere, by projected solid angle."""


def masked(alpha: float, cosine: Floats | float) -> Floats:
    """Smith's Lambda of GGX."""
    return np.asarray((np.sqrt(1 + alpha**2 * (1 / np.square(cosine) - 1)) - 1) / 2)


def integral(roughness: float, cosine: float, count: int = 160) -> tuple[float, float]:
    """(a, b) where the view is at `cosine`: over half vectors, distributed as the microfacets' normals."""
    alpha, (u, weights) = roughness**2, unit_rule(count)
    up = np.sqrt((1 - u) / (1 + (alpha**2 - 1) * u))[:, None]
    view_half = math.sqrt(1 - cosine**2) * np.sqrt(1 - up**2) * np.cos(math.pi * u) + cosine * up
    light_up = 2 * view_half * up - cosine
    is_lit = (light_up > 0) & (view_half > 0)
    seen = 1 / (1 + masked(alpha, cosine) + masked(alpha, np.where(is_lit, light_up, 1)))
    share = np.where(is_lit, seen * view_half / (up * cosine), 0) * np.outer(weights, weights)
    grazing = (1 - np.clip(view_half, 0, 1)) ** 5
    return float((share * grazing).sum()), float((share * (1 - grazing)).sum())


@pytest.mark.parametrize(("roughness", "cosine"), [(0.5, 0.3), (0.7, 0.9), (1.0, 0.5)])
def test_the_integral_is_that_of_the_brdf_over_directions_of_light(roughness: float, cosine: float) -> None:
    """By SciPy, from the textbook's D G F / (4 n.v n.l), over azimuth and squared cosine of the light."""
    alpha = roughness**2

    def brdf(turn: float, squared: float, *, is_a: bool) -> float:
        up = math.sqrt(squared)
        light = np.array([math.sqrt(1 - squared) * math.cos(turn), math.sqrt(1 - squared) * math.sin(turn), up])
        half = light + np.array([math.sqrt(1 - cosine**2), 0, cosine])
        half /= np.linalg.norm(half)
        grazing = (1 - light @ half) ** 5
        facets = alpha**2 / (math.pi * (half[2] ** 2 * (alpha**2 - 1) + 1) ** 2)
        seen = 1 / (1 + masked(alpha, cosine) + masked(alpha, up))
        return float(facets * seen * (grazing if is_a else 1 - grazing) / (4 * cosine * up))

    for is_a, found in zip((True, False), integral(roughness, cosine), strict=True):
        # Its share of the hemisphere is n.l dw = d(turn) d(squared) / 2, and both halves of the turn are alike.
        by_light = dblquad(lambda *at, is_a=is_a: brdf(*at, is_a=is_a), 1e-12, 1, 0, math.pi, epsabs=1e-5)[0]
        assert found == pytest.approx(by_light, abs=3e-4)


@pytest.fixture(scope="module")
def errors() -> Floats:
    """[roughness, cosine, a or b]: the fit less the integral."""
    exact = [[integral(roughness, cosine) for cosine in COSINES] for roughness in ROUGHNESS]
    roughness, cosine = np.meshgrid(ROUGHNESS, COSINES, indexing="ij")
    return np.stack(reflected_share(roughness, cosine), axis=-1) - np.array(exact)


def test_the_mean_over_all_directions_is_that_of_the_integral(errors: Floats) -> None:
    """Measured: 0.0052 (at roughness 1) and 0.163 (at 0.4)."""
    a, b = np.abs(np.einsum("rcs,c->sr", errors, OF_DIRECTIONS))
    assert a.max() < 0.007
    assert b.max() < 0.18


def test_no_direction_is_far_off(errors: Floats) -> None:
    """Measured: 0.082 and 0.192."""
    assert np.abs(errors[..., 0]).max() < 0.1
    assert np.abs(errors[:, COSINES > NOT_GRAZING, 1]).max() < 0.21


def test_what_head_on_reflectance_adds_is_taken_from_the_rest() -> None:
    """By the fit's form, a perfect mirror's share a + b depends on roughness alone."""
    sums = np.add(*reflected_share(np.full(9, 0.3), np.linspace(0, 1, 9)))
    assert np.ptp(sums) < 1e-12
