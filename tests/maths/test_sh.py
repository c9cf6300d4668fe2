"""Spherical harmonics against scipy, quadrature, and the constants of the conventions."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from server.maths import sh
from tests.data import data_folder
from tests.reference.sh import lambert_bands, sh_basis, sphere_rule
from tests.scenes import lights
from tests.scenes.lights import random_directions, unit

AXES = np.concatenate([np.eye(3), -np.eye(3)])
NEAR_POLES = unit([[1e-9, 0, 1], [0, -1e-7, 1], [1e-5, 1e-5, -1], [0, 1e-3, -1]])
DIRECTIONS = np.concatenate([AXES, NEAR_POLES, random_directions(200, 1)])
UP = np.array([0.0, 1.0, 0.0])

Floats = NDArray[np.float64]


@pytest.mark.parametrize("bands", range(1, 7))
def test_basis_is_scipys(bands: int) -> None:
    np.testing.assert_allclose(sh.sh_basis(DIRECTIONS, bands), sh_basis(DIRECTIONS, bands), rtol=1e-12, atol=1e-13)


def test_constants_of_the_conventions() -> None:
    x, y, z = DIRECTIONS.T
    basis = sh.sh_basis(DIRECTIONS, 3)
    published = {0: 0.282095 + 0 * x, 1: 0.488603 * y, 2: 0.488603 * z, 3: 0.488603 * x, 4: 1.092548 * x * y}
    published |= {
        5: 1.092548 * y * z,
        6: 0.315392 * (3 * z * z - 1),
        7: 1.092548 * x * z,
        8: 0.546274 * (x * x - y * y),
    }
    for index, values in published.items():
        np.testing.assert_allclose(basis[:, index], values, atol=1e-6)


def test_basis_is_orthonormal() -> None:
    points, weights = sphere_rule(8, 16)  # products of two functions have degree 10 at most: exact
    basis = sh.sh_basis(points, 6)
    np.testing.assert_allclose(basis.T @ (weights[:, None] * basis), np.eye(36), atol=1e-13)


def test_basis_takes_any_shape() -> None:
    stacked = DIRECTIONS[:6].reshape(2, 3, 3)
    np.testing.assert_array_equal(sh.sh_basis(stacked, 4).reshape(6, 16), sh.sh_basis(DIRECTIONS[:6], 4))


def test_lambert_bands_are_the_textbooks() -> None:
    np.testing.assert_allclose(sh.LAMBERT_BANDS, lambert_bands(6), atol=1e-15)


def test_lambert_transfer_integrates_the_clamped_cosine() -> None:
    points, weights = sphere_rule(200, 400)
    basis = sh_basis(points, 6)
    for normal in np.concatenate([AXES, random_directions(4, 2)]):
        integral = (weights * np.maximum(points @ normal, 0) / np.pi) @ basis
        # The cosine's crease is not a polynomial: the rule's error falls with the square of its 1/200 spacing.
        np.testing.assert_allclose(sh.lambert_transfer(normal, 6), integral, atol=5e-5)


def test_white_under_a_uniform_sky_shades_to_its_radiance() -> None:
    shaded = sh.lambert_transfer(DIRECTIONS, 6) @ lights.uniform((1.0, 2.0, 0.5), 6)
    np.testing.assert_allclose(shaded, np.tile([1.0, 2.0, 0.5], (len(DIRECTIONS), 1)), rtol=1e-13)


@pytest.mark.parametrize("count", [1, 32, 81, 169, 1024])
def test_fibonacci_directions_are_even(count: int) -> None:
    directions = sh.spherical_fibonacci(count)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-12)
    assert np.linalg.norm(directions.mean(0)) < 1 / count + 1e-12 if count > 1 else True
    if count >= 32:  # as a quadrature rule it keeps four bands orthonormal to a few percent, better with more
        basis = sh_basis(directions, 3)
        assert np.abs(4 * np.pi / count * basis.T @ basis - np.eye(9)).max() < 4 / count


@pytest.mark.parametrize("count", [1024, 81, 5])
def test_bundles_are_the_same_directions_and_narrow(count: int) -> None:
    lattice = sh.spherical_fibonacci(count)
    bundled = sh.in_bundles(lattice)
    np.testing.assert_array_equal(np.unique(bundled, axis=0), np.unique(lattice, axis=0))
    whole = count // sh.BUNDLE * sh.BUNDLE
    lengths = [np.linalg.norm(d[:whole].reshape(-1, sh.BUNDLE, 3).mean(axis=1), axis=1) for d in (bundled, lattice)]
    if whole:
        assert np.mean(lengths[0]) > (0.99 if count == 1024 else 0.88)
        assert np.mean(lengths[1]) < 0.75


@pytest.mark.parametrize("bands", [2, 4, 6])
def test_rotated_coefficients_are_those_of_the_rotated_function(bands: int) -> None:
    random = np.random.default_rng(3)
    for rotation in Rotation.random(6, random_state=4).as_matrix():
        coefficients = random.normal(size=(bands * bands, 3))
        turned = sh_basis(DIRECTIONS, bands) @ sh.rotate_sh(coefficients, rotation)
        np.testing.assert_allclose(turned, sh_basis(DIRECTIONS @ rotation, bands) @ coefficients, atol=1e-11)


def test_rotation_moves_the_dominant_direction() -> None:
    light = lights.lobe_and_sky((0.3, 0.8, -0.2))
    rotation = Rotation.from_euler("xyz", [20, -50, 130], degrees=True).as_matrix()
    np.testing.assert_allclose(
        sh.dominant_direction(sh.rotate_sh(light, rotation)), rotation @ sh.dominant_direction(light), atol=1e-12
    )


def test_luminance_is_rec_709() -> None:
    np.testing.assert_allclose(sh.luminance_sh(np.eye(3)), [0.2126, 0.7152, 0.0722], atol=1e-12)


# ---- dominant light ----------------------------------------------------------------------------------------------


def directional(direction: Floats, irradiance: float, ambient: float, bands: int = 4) -> Floats:
    """[n, 3] a light from one direction (white facing it shades to `irradiance`) and an even sky, projected."""
    delta = np.pi * irradiance * sh_basis(direction, bands)  # irradiance / pi of L delta is L / pi
    return np.tile(delta[:, None], 3) + lights.uniform((ambient,) * 3, bands)


@pytest.mark.parametrize("direction", DIRECTIONS[:14])
def test_dominant_direction_of_a_directional_light(direction: Floats) -> None:
    np.testing.assert_allclose(sh.dominant_direction(directional(direction, 2.0, 0.5)), direction, atol=1e-12)


@pytest.mark.parametrize("bands", [3, 4, 6])
def test_dominant_intensity_of_a_directional_light(bands: int) -> None:
    # A light of irradiance s has coefficients s pi Y(d), the unit light of the fit (16 pi / 17) Y(d): it shades facing
    # white to 1 with three bands (4 / 17 (1 + 2 + 5 / 4) = 1), where the whole series would need pi. The least squares
    # solution is thus exactly 17 / 16 s, whatever the even sky and the bands above the third.
    for direction in DIRECTIONS[:14]:
        for irradiance in (0.01, 1.0, 30.0):
            found = sh.dominant_intensity(directional(direction, irradiance, 0.7, bands))
            assert found == pytest.approx(17 / 16 * irradiance, rel=1e-12)


def test_dominant_intensity_minimises_the_irradiance_error() -> None:
    points, weights = sphere_rule(8, 16)
    light = np.random.default_rng(5).normal(size=(16, 3))
    light[:, 1] += lights.lobe((0.2, 0.5, 1.0))[:, 1]
    transfer = sh.lambert_transfer(points, 3)
    shaded = transfer @ (light[:9] @ [0.2126, 0.7152, 0.0722])
    unit_light = 16 * np.pi / 17 * sh_basis(sh.dominant_direction(light), 3)
    model = np.stack([transfer @ unit_light, np.ones(len(points))], axis=1)  # the light, and a free even sky
    root = np.sqrt(weights)
    best = np.linalg.lstsq(root[:, None] * model, root * shaded, rcond=None)[0]
    assert best[0] > 0
    assert sh.dominant_intensity(light) == pytest.approx(best[0], rel=1e-12)


def test_no_dominant_light_where_there_is_none() -> None:
    for light in (np.zeros((16, 3)), lights.uniform((3.0, 3.0, 3.0))):
        np.testing.assert_array_equal(sh.dominant_direction(light), 0)
        assert sh.dominant_intensity(light) == 0


# ---- WebXR -------------------------------------------------------------------------------------------------------


def test_webxr_axes() -> None:
    for up, view in zip(random_directions(50, 6), random_directions(50, 7), strict=True):
        rotation = sh.webxr_from_world(up, view)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
        np.testing.assert_allclose(rotation @ up, UP, atol=1e-12)
        x, _, z = rotation @ view
        assert x == pytest.approx(0, abs=1e-12)
        assert z <= 0


@pytest.mark.parametrize("up", AXES)
@pytest.mark.parametrize("sign", [1, -1])
def test_webxr_axes_of_a_view_along_up(up: Floats, sign: float) -> None:
    rotation = sh.webxr_from_world(up, sign * up)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(rotation @ up, UP, atol=1e-12)


def test_webxr_floats_are_interleaved_and_turned() -> None:
    up, view = np.array([0.0, 0, 1]), np.array([0.0, 1, 0])  # a z-up world seen along +y
    light = lights.lobe(up, (1.0, 0.5, 0.25)) + lights.lobe(view, (0.0, 0.0, 1.0))
    floats = sh.webxr_floats(light, sh.webxr_from_world(up, view))
    assert len(floats) == 27
    red, green, blue = (np.array(floats[channel::3]) for channel in range(3))
    np.testing.assert_allclose(green, red / 2, atol=1e-12)
    np.testing.assert_allclose(red, lights.lobe(UP)[:9, 0], atol=1e-12)  # from above: along +y
    np.testing.assert_allclose(blue, 0.25 * lights.lobe(UP)[:9, 0] + lights.lobe((0, 0, -1))[:9, 0], atol=1e-12)


def test_webxr_floats_of_two_bands() -> None:
    floats = sh.webxr_floats(np.ones((4, 3)), np.eye(3))
    np.testing.assert_allclose(floats, [1.0] * 12 + [0.0] * 15, atol=1e-12)


# ---- panoramas ---------------------------------------------------------------------------------------------------


def lat_long(height: int, width: int) -> Floats:
    """[h, w, 3] d = (sin t cos p, cos t, -sin t sin p), t from the top row, p = 2 pi column / width."""
    t = np.pi * (np.arange(height) + 0.5)[:, None] / height
    p = 2 * np.pi * (np.arange(width) + 0.5)[None] / width
    return np.stack([np.sin(t) * np.cos(p), np.cos(t) + 0 * p, -np.sin(t) * np.sin(p)], -1)


def test_panorama_of_a_band_limited_light() -> None:
    light = lights.lobe_and_sky((0.4, -0.3, 0.8))
    directions = lat_long(128, 256)
    projected = sh.project_panorama(sh_basis(directions, 4) @ light, 4, directions)
    np.testing.assert_allclose(projected, light, atol=3e-4)  # midpoints in 128 rows: error of order (pi / 128)^2
    assert np.abs(sh.project_panorama(np.ones((16, 32, 3)), 2, lat_long(16, 32))[0] - np.sqrt(4 * np.pi)).max() < 1e-12


@pytest.mark.data
def test_panorama_reproduces_the_published_uffizi() -> None:
    tables = json.loads(data_folder("sh_tables/published_sh9.json").read_text())
    published = np.array(tables["orange_book"]["Uffizi Gallery"])
    picture = cv2.imread(str(data_folder("hdr/uffizi_latlong_1200x600.hdr")), cv2.IMREAD_UNCHANGED)[..., ::-1]
    projected = 0.1004 * sh.project_panorama(picture.astype(float), 3, lat_long(*picture.shape[:2]))
    # Relative to the whole row: single coefficients near zero have no relative error.
    assert np.linalg.norm(projected - published) < 0.01 * np.linalg.norm(published)
    assert np.abs(projected - published).max() < 0.01 * np.abs(published).max()


@pytest.mark.parametrize("bands", [1, 3, 4, 6])
def test_the_remembered_matrix_turns_as_coefficients_are_turned(bands: int) -> None:
    """Also when it is asked for again, for another rotation in between, and from a view of a larger matrix."""
    random = np.random.default_rng(bands)
    for _ in range(2):
        for axis in ((0.3, -1.1, 0.4), (0.0, 2.0, 0.1)):
            pose = np.eye(4)
            pose[:3, :3] = cv2.Rodrigues(np.array(axis))[0]
            coefficients = random.normal(size=(bands * bands, 3))
            found = sh.sh_rotation(pose[:3, :3], bands) @ coefficients
            np.testing.assert_allclose(found, sh.rotate_sh(coefficients, pose[:3, :3]), atol=1e-10)
