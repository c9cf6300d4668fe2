"""The fit of a sky and a few lights: its model, its derivatives, and that it goes downhill."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from server.maths.directional_fit import DirectionalFit, directional_sh
from tests.scenes import lights
from tests.scenes.lights import random_directions

Floats = NDArray[np.float64]
PARAMETERS = np.array([0.7, 0.5, -0.2, 0.4, 0.05, -0.3, 0.9, 0.1, 0.2])
"""A sky and two lights."""


def fit_of(target: Floats, sharp: bool = False) -> DirectionalFit:
    """In a metric that is neither even nor diagonal."""
    root = np.eye(16) + 0.3 * np.random.default_rng(1).normal(size=(16, 16))
    return DirectionalFit(root, root @ target, 4, sharp)


def test_model_is_a_sky_and_the_lights() -> None:
    fit = fit_of(np.zeros(16))
    model = 0.7 * np.eye(16)[0]
    for vector, flatness in ((PARAMETERS[1:4], PARAMETERS[4]), (PARAMETERS[5:8], PARAMETERS[8])):
        length = np.linalg.norm(vector)
        model += length * directional_sh(vector / length, np.sqrt(2 * flatness), 4)
    np.testing.assert_allclose(fit.linearised(PARAMETERS)[0], fit.root @ model, atol=1e-12)
    np.testing.assert_allclose(
        fit.unit_lights(PARAMETERS) @ [0.7, *(np.linalg.norm(PARAMETERS[i : i + 3]) for i in (1, 5))],
        fit.root @ model,
        atol=1e-12,
    )


@pytest.mark.parametrize("sharp", [False, True])
def test_derivatives_against_differences(sharp: bool) -> None:
    fit, step = fit_of(lights.lobe((0.1, 0.2, 0.3))[:, 0], sharp), 1e-6
    jacobian = fit.linearised(PARAMETERS)[1]
    for index in range(len(PARAMETERS)):
        move = step * np.eye(len(PARAMETERS))[index]
        difference = (fit.linearised(PARAMETERS + move)[0] - fit.linearised(PARAMETERS - move)[0]) / (2 * step)
        wanted = 0 * difference if sharp and index in (4, 8) else difference
        np.testing.assert_allclose(jacobian[:, index], wanted, atol=1e-7)


def test_refining_lessens_the_misfit_within_the_limits() -> None:
    for seed in range(5):
        target = np.random.default_rng(seed).normal(size=16) + 2 * lights.lobe(random_directions(1, seed)[0])[:, 0]
        fit = fit_of(target)
        start = fit.with_next(fit.sky())
        end = fit.refined(start)
        assert fit.misfit(end) < min(fit.misfit(start), fit.misfit(fit.sky()))
        far = fit.refined(
            np.array([5.0, *(-20 * start[1:4]), 0.4])
        )  # the wrong way round: steps that fail are taken back
        assert fit.misfit(far) <= fit.misfit(fit.sky())
        assert end[0] >= 0
        assert end[4] >= 0
