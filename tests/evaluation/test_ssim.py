"""SSIM against scikit-image's."""

from __future__ import annotations

import numpy as np
import pytest

from tests.bench.rendering.ssim import ssim_map


def test_alike_pictures_and_sizes() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (32, 40, 3)).astype(np.uint8)
    assert np.allclose(ssim_map(picture, picture), 1.0)
    with pytest.raises(ValueError, match="different sizes"):
        ssim_map(picture, picture[:-1])


def test_against_an_independent_implementation() -> None:
    metrics = pytest.importorskip("skimage.metrics")
    generator = np.random.default_rng(1)
    a = np.kron(generator.integers(30, 220, (12, 16, 3)), np.ones((4, 4, 1))).astype(np.uint8)
    b = np.clip(a + generator.normal(0, 12, a.shape), 0, 255).astype(np.uint8)
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 255}
    _, true = metrics.structural_similarity(a, b, channel_axis=-1, full=True, **settings)
    inner = (slice(8, -8), slice(8, -8))  # borders are filled in other ways
    assert np.abs(ssim_map(a, b)[inner] - true.mean(axis=-1)[inner]).max() < 1e-6
