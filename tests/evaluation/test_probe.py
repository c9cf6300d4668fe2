"""Spheres rendered under a known light: the passive probe, the active one, and the marker that says where they are."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from protocol.frames import CameraModel
from tests.bench.truth.probe import (
    ProbeError,
    Sphere,
    active_probe,
    find_sphere,
    passive_probe,
    sphere_pixels,
)
from tests.reference.sh import lambert_bands, sh_basis
from tests.scenes import lights
from tests.scenes.lights import degrees_between

CAMERA = CameraModel(width=320, height=240, fx=300.0, fy=300.0, cx=159.5, cy=119.5)
SPHERE = Sphere(np.array([0.05, -0.02, 0.6]), 0.1)
LIGHT = lights.lobe((0.4, -0.7, -0.6), (1.0, 0.8, 0.5)) + lights.uniform((0.2, 0.3, 0.4))
TURN = Rotation.from_euler("xyz", [30, -70, 10], degrees=True).as_matrix()
BAND = np.sqrt(np.arange(16)).astype(int)

Floats = NDArray[np.float64]


def hits(camera: CameraModel, sphere: Sphere) -> tuple[NDArray[np.bool_], Floats, Floats]:
    """Where a sphere is [h, w], its normals and the views there [n, 3], from the quadratic's textbook solution."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
    a, b = (rays**2).sum(-1), -2 * rays @ sphere.center_m
    c = sphere.center_m @ sphere.center_m - sphere.radius_m**2
    seen = b * b - 4 * a * c > 0
    rays, a, b = rays[seen], a[seen], b[seen]
    points = rays * ((-b - np.sqrt(b * b - 4 * a * c)) / (2 * a))[:, None]
    return seen, (points - sphere.center_m) / sphere.radius_m, rays / np.linalg.norm(rays, axis=1, keepdims=True)


SEEN, NORMALS, VIEWS = hits(CAMERA, SPHERE)


def matte(light: Floats, albedo: float, turn: Floats) -> Floats:
    """[h, w, 3] of the sphere alone."""
    picture = np.zeros((CAMERA.height, CAMERA.width, 3))
    picture[SEEN] = albedo * (sh_basis(NORMALS @ turn.T, 4) * lambert_bands(4)[BAND]) @ light
    return picture


def mirror(light: Floats, turn: Floats) -> Floats:
    """[h, w, 3] likewise."""
    picture = np.zeros((CAMERA.height, CAMERA.width, 3))
    reflected = VIEWS - 2 * np.sum(VIEWS * NORMALS, axis=1, keepdims=True) * NORMALS
    picture[SEEN] = sh_basis(reflected @ turn.T, 4) @ light
    return picture


def test_pixels_of_the_sphere() -> None:
    pixels = sphere_pixels(CAMERA, SPHERE, least_facing=0.0)
    seen = np.zeros_like(SEEN)
    seen[pixels.rows, pixels.columns] = True
    np.testing.assert_array_equal(seen, SEEN)
    np.testing.assert_allclose(pixels.normals, NORMALS, atol=1e-9)


def test_a_sphere_that_is_not_there() -> None:
    for center in ([5.0, 0.0, 0.6], [0.0, 0.0, -0.6]):
        with pytest.raises(ProbeError, match="not in the picture"):
            sphere_pixels(CAMERA, Sphere(np.array(center), 0.1))


@pytest.mark.parametrize("turn", [np.eye(3), TURN], ids=["camera", "world"])
def test_passive_probe_shades_as_the_light_did(turn: Floats) -> None:
    found = passive_probe(matte(LIGHT, 0.5, turn), sphere_pixels(CAMERA, SPHERE), 4, turn)
    facing = NORMALS[np.sum(NORMALS * VIEWS, axis=1) < -0.2]
    transfer = sh_basis(facing @ turn.T, 4) * lambert_bands(4)[BAND]
    truth = transfer @ LIGHT
    # Exact data: what is left is the prior's least strength.
    np.testing.assert_allclose(transfer @ found.mean, truth, atol=1e-3 * truth.max())


def test_passive_probe_with_noise_and_highlight() -> None:
    random = np.random.default_rng(1)
    picture = matte(LIGHT, 0.5, np.eye(3)) + 0.005 * random.normal(size=(CAMERA.height, CAMERA.width, 3))
    clean = np.ones(SEEN.shape, bool)
    clean[100:110, 170:190] = False
    picture[~clean] = 5.0
    pixels = sphere_pixels(CAMERA, SPHERE)
    found = passive_probe(picture, pixels, 3, usable=clean).mean
    spoiled = passive_probe(picture, pixels, 3).mean
    truth = (sh_basis(pixels.normals, 4) * lambert_bands(4)[BAND]) @ LIGHT

    def error(light: Floats) -> float:
        shaded = (sh_basis(pixels.normals, 3) * lambert_bands(3)[BAND[:9]]) @ light
        return float(np.sqrt(np.mean((shaded - truth) ** 2)) / truth.mean())

    assert error(found) < 0.02
    assert error(spoiled) > 3 * error(found)


def test_passive_probe_needs_pixels() -> None:
    pixels = sphere_pixels(CAMERA, SPHERE)
    with pytest.raises(ProbeError, match="too few"):
        passive_probe(np.zeros((240, 320, 3)), pixels, 4, usable=np.zeros((240, 320), bool))


@pytest.mark.parametrize("turn", [np.eye(3), TURN], ids=["camera", "world"])
def test_active_probe(turn: Floats) -> None:
    found = active_probe(mirror(LIGHT, turn), CAMERA, SPHERE, 4, turn)
    # The rim (cosine below 0.05) and the cone behind the sphere are filled with the mean: about 1 % of all directions.
    assert np.linalg.norm(found - LIGHT) < 0.04 * np.linalg.norm(LIGHT)


def test_active_probe_under_an_even_sky_is_exact() -> None:
    sky = lights.uniform((1.0, 2.0, 3.0))
    np.testing.assert_allclose(active_probe(mirror(sky, np.eye(3)), CAMERA, SPHERE, 4), sky, atol=1e-9)


def marker_picture(camera: CameraModel, side_m: float, camera_from_marker: Floats, marker_id: int) -> NDArray[np.uint8]:
    """[h, w] a marker on a white sheet, by the homography of its plane."""
    cells = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), marker_id, 240)
    sheet = np.full((400, 400), 255, np.uint8)
    sheet[80:320, 80:320] = cells
    marker_from_sheet = np.array(
        [[side_m / 240, 0, -199.5 * side_m / 240], [0, -side_m / 240, 199.5 * side_m / 240], [0, 0, 1]]
    )
    lens = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    homography = lens @ camera_from_marker[:3][:, [0, 1, 3]] @ marker_from_sheet
    size = (camera.width, camera.height)
    return cv2.warpPerspective(sheet, homography, size, flags=cv2.INTER_AREA, borderValue=128)


def test_marker_says_where_the_sphere_is() -> None:
    camera = CameraModel(width=640, height=480, fx=600.0, fy=600.0, cx=319.5, cy=239.5)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [180 + 25, 15, 8], degrees=True).as_matrix()
    pose[:3, 3] = [-0.05, 0.03, 0.7]
    picture = marker_picture(camera, 0.1, pose, 7)
    beside = np.array([0.12, 0.02, 0.05])
    found = find_sphere(picture, camera, 7, 0.1, beside, 0.05)
    truth = pose[:3, :3] @ beside + pose[:3, 3]
    assert found.radius_m == 0.05
    assert np.linalg.norm(found.center_m - truth) < 0.004  # a quarter of a pixel of 1.2 mm, times the lever of 13 cm
    assert degrees_between(found.center_m, truth) < 0.2
    with pytest.raises(ProbeError, match="marker 8 is seen 0 times"):
        find_sphere(picture, camera, 8, 0.1, beside, 0.05)
