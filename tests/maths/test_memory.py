"""Directional forgetting: what frames say nothing about stays, what they say decays as a moving average would."""

from __future__ import annotations

import numpy as np
import pytest

from server.maths.bayes import NormalEquations
from server.maths.memory import remembered
from tests.scenes.analytic import Floats

X = np.random.default_rng(1).normal(size=(6, 2))


def frame_of(columns: Floats, x: Floats = X, noise: float = 0.01, seed: int = 0) -> NormalEquations:
    """The normal equations of samples with rows `columns`."""
    y = columns @ x + noise * np.random.default_rng(1000 + seed).normal(size=(len(columns), x.shape[1]))
    return NormalEquations(columns.T @ columns, columns.T @ y, (y**2).sum(0), float(len(columns)))


def samples(seed: int, sees: slice = slice(0, 6)) -> Floats:
    """[50, 6] rows that see some of the unknowns."""
    columns = np.zeros((50, 6))
    columns[:, sees] = np.random.default_rng(seed).normal(size=columns[:, sees].shape)
    return columns


def test_what_later_frames_do_not_see_stays() -> None:
    """Three unknowns are seen once, the others 300 times after."""
    known = frame_of(samples(0, slice(0, 3)))
    for seed in range(300):
        frame = frame_of(samples(seed, slice(3, 6)), seed=seed)
        known = remembered(known, frame, 0.9) + frame
    np.testing.assert_allclose(known.matrix[:3, :3], frame_of(samples(0, slice(0, 3))).matrix[:3, :3], rtol=1e-9)
    np.testing.assert_allclose(np.linalg.solve(known.matrix, known.vector), X, atol=0.02)


@pytest.mark.parametrize("memory", [0.9, 0.5, 0.0])
def test_frames_that_are_alike_decay_as_in_a_moving_average(memory: float) -> None:
    columns = samples(3)
    known = plain = frame_of(columns)
    for seed in range(1, 40):
        frame = frame_of(columns, seed=seed)
        known, plain = remembered(known, frame, memory) + frame, plain.scaled(memory) + frame
    for found, expected in ((known.matrix, plain.matrix), (known.vector, plain.vector), (known.energy, plain.energy)):
        np.testing.assert_allclose(found, expected, rtol=1e-7)
    assert known.count == pytest.approx(plain.count)


def test_a_new_light_replaces_the_old() -> None:
    known = frame_of(samples(0))
    for seed in range(1, 30):
        frame = frame_of(samples(seed), -X, seed=seed)
        known = remembered(known, frame, 0.5) + frame
    np.testing.assert_allclose(np.linalg.solve(known.matrix, known.vector), -X, atol=0.02)


def test_a_weak_frame_takes_no_more_than_it_brings() -> None:
    """One sample beside 50: no direction is known worse than before, and the others as before."""
    known, weak = frame_of(samples(0)), frame_of(samples(1)[:1])
    after = remembered(known, weak, 0.1) + weak
    assert np.linalg.eigvalsh(after.matrix - known.matrix).min() > -1e-9 * np.trace(known.matrix)
    assert np.trace(after.matrix) < np.trace(known.matrix) * 1.001


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_residuals_stay_positive_and_finite(scale: float) -> None:
    known = frame_of(samples(0, slice(0, 2)), noise=0.5).scaled(scale)
    for seed in range(50):
        frame = frame_of(samples(seed, slice(seed % 5, seed % 5 + 2)), noise=0.5, seed=seed).scaled(scale)
        known = remembered(known, frame, 0.8) + frame
        left = known.less(np.linalg.lstsq(known.matrix, known.vector, rcond=None)[0]).energy
        assert np.isfinite(known.matrix).all()
        assert (left >= 0).all()
    assert np.linalg.eigvalsh(known.matrix).min() > -1e-9 * np.trace(known.matrix)
    variance = left / known.count
    np.testing.assert_allclose(variance, 0.25, rtol=0.5)


def test_nothing_known_or_nothing_seen() -> None:
    nothing, frame = frame_of(np.zeros((50, 6))), frame_of(samples(0))
    for known, seen in ((nothing, frame), (frame, nothing), (nothing, nothing)):
        after = remembered(known, seen, 0.9) + seen
        assert np.isfinite(after.matrix).all()
        assert np.isfinite(after.vector).all()
    np.testing.assert_allclose(remembered(frame, nothing, 0.9).matrix, frame.matrix, rtol=1e-9)
