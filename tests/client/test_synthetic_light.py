"""The synthetic light: its basis against SciPy, its direction, its sign, its brightness."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import sph_harm_y

from client.synthetic.lighting.harmonics import basis, sphere_directions, unshadowed_transfer
from client.synthetic.lighting.lights import EXPOSURE, RING_SIZE, ring_light

REC709 = np.array([0.2126, 0.7152, 0.0722])


def scipy_basis(directions: np.ndarray) -> np.ndarray:
    """[n, 16] from SciPy's complex harmonics, which carry the Condon-Shortley phase."""
    x, y, z = directions.T
    polar, azimuth = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)
    columns = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), polar, azimuth)
            if order == 0:
                columns.append(value.real)
            else:
                columns.append(math.sqrt(2) * (-1) ** order * (value.real if order > 0 else value.imag))
    return np.stack(columns, axis=1)


def test_basis_against_scipy() -> None:
    directions = sphere_directions(2000)
    np.testing.assert_allclose(basis(directions), scipy_basis(directions), atol=1e-13)


def test_basis_signs_as_documented() -> None:
    np.testing.assert_allclose(
        basis(np.eye(3))[:, 1:4], 0.488603 * np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]), atol=1e-6
    )


def test_directions_are_even() -> None:
    directions = sphere_directions(4096)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-12)
    gram = basis(directions).T @ basis(directions) * 4 * np.pi / 4096
    np.testing.assert_allclose(gram, np.eye(16), atol=2e-4)


def test_unshadowed_transfer_against_quadrature() -> None:
    directions = sphere_directions(100_000)
    for normal in sphere_directions(7):
        cosines = np.maximum(directions @ normal, 0)
        expected = (cosines[:, None] * scipy_basis(directions)).sum(axis=0) * 4 * np.pi / 100_000 / np.pi
        np.testing.assert_allclose(unshadowed_transfer(normal[None])[0], expected, atol=2e-5)


def test_white_furnace() -> None:
    sky = np.zeros(16)
    sky[0] = math.sqrt(4 * math.pi)
    np.testing.assert_allclose(unshadowed_transfer(sphere_directions(50)) @ sky, 1, atol=1e-12)


@pytest.mark.parametrize("position", [*range(RING_SIZE), 2.7])
def test_ring_light(position: float) -> None:
    light = ring_light(position)
    azimuth, elevation = math.radians(45 * position), math.radians(40)
    stated = (math.cos(elevation) * math.sin(azimuth), math.sin(elevation), math.cos(elevation) * math.cos(azimuth))
    np.testing.assert_allclose(light.direction, stated, atol=1e-12)
    for channel in (*light.sh.T, light.sh @ REC709):
        l1 = channel[[3, 1, 2]]  # x, y, z
        np.testing.assert_allclose(l1 / np.linalg.norm(l1), stated, atol=1e-12)
    everywhere = sphere_directions(50_000)
    radiance = light.radiance(everywhere)
    assert radiance.min() > 0
    brightest = everywhere[(radiance @ REC709).argmax()]
    assert brightest @ light.direction > math.cos(math.radians(1))


def test_nothing_exceeds_the_exposure() -> None:
    light = ring_light(3)
    shaded = unshadowed_transfer(sphere_directions(50_000)) @ light.sh
    assert shaded.max() == pytest.approx(EXPOSURE, rel=1e-3)
    assert shaded.min() > 0
    np.testing.assert_allclose((unshadowed_transfer(light.direction[None]) @ light.sh).max(), EXPOSURE, rtol=1e-12)
    np.testing.assert_allclose(ring_light(3, 1.5).sh, 1.5 * light.sh, rtol=1e-12)
