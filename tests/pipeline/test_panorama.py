"""A panorama as the light (S2): its axes, its solid angles, published coefficients, and files that are none."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from server.light.panorama import PanoramaError, panorama_directions, panorama_sh, read_panorama
from server.maths.sh import dominant_direction, webxr_from_world
from tests.data import data_folder
from tests.reference.sh import sh_basis
from tests.scenes import lights
from tests.scenes.lights import degrees_between

Floats = NDArray[np.float64]


def written(folder: Path, radiance: Floats, name: str = "sky.hdr") -> Path:
    """A file of RGB radiance."""
    path = folder / name
    assert cv2.imwrite(str(path), radiance[..., ::-1].astype(np.float32))
    return path


def spot(row: int, column: int) -> Floats:
    """[32, 64, 3] black but for one pixel."""
    picture = np.zeros((32, 64, 3))
    picture[row, column] = 1.0
    return picture


@pytest.mark.parametrize(
    ("row", "column", "direction"),
    [
        (0, 20, (0, 1, 0)),
        (31, 20, (0, -1, 0)),
        (15, 31, (0, 0, -1)),
        (15, 47, (1, 0, 0)),
        (15, 15, (-1, 0, 0)),
        (15, 0, (0, 0, 1)),
        (15, 63, (0, 0, 1)),
    ],
    ids=["top", "bottom", "middle", "right", "left", "first column", "last column"],
)
def test_axes(row: int, column: int, direction: tuple[int, int, int]) -> None:
    """Within a pixel's diagonal of 5.6 degrees."""
    assert degrees_between(panorama_directions(32, 64)[row, column], direction) < 4.1
    assert degrees_between(dominant_direction(panorama_sh(spot(row, column), 3)), direction) < 4.1


def test_as_seen_by_the_first_camera() -> None:
    """A lamp right of the middle is to the right of what an OpenCV camera looks along; the top is above."""
    up, view = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    world_from_webxr = webxr_from_world(up, view).T
    lamp = world_from_webxr @ dominant_direction(panorama_sh(spot(10, 40), 3))
    assert lamp[2] > 0.5  # ahead
    assert lamp[0] > 0.2  # to the right
    assert lamp[1] < -0.2  # above


def test_solid_angles() -> None:
    """An even sky has its own radiance: rows near the poles count for less."""
    np.testing.assert_allclose(panorama_sh(np.ones((32, 64, 3)), 4)[0], np.sqrt(4 * np.pi), rtol=1e-12)
    polar, level = panorama_sh(spot(0, 5), 1)[0, 0], panorama_sh(spot(16, 5), 1)[0, 0]
    rows = np.cos(np.linspace(0, np.pi, 33))
    assert polar / level == pytest.approx((rows[0] - rows[1]) / (rows[16] - rows[17]), rel=1e-12)


def test_a_band_limited_light_comes_back() -> None:
    light = lights.lobe_and_sky((0.4, -0.3, 0.8))
    picture = sh_basis(panorama_directions(128, 256), 4) @ light
    np.testing.assert_allclose(panorama_sh(picture, 4), light, atol=3e-4)  # midpoints: (pi / 128)^2


def test_file_of_radiance(tmp_path: Path) -> None:
    radiance = np.random.default_rng(0).uniform(0.1, 20, (16, 32, 3))
    read = read_panorama(written(tmp_path, radiance))
    # Radiance's shared exponent keeps 8 bits of the largest channel.
    np.testing.assert_allclose(read, radiance, atol=0.2, rtol=0.01)


def test_a_large_panorama_is_shrunk_without_changing_the_light(tmp_path: Path) -> None:
    light = np.abs(lights.lobe_and_sky((0.4, -0.3, 0.8)))
    small = np.clip(sh_basis(panorama_directions(64, 128), 4) @ light, 0, None)
    read = read_panorama(written(tmp_path, small.repeat(16, axis=0).repeat(16, axis=1)))
    assert read.shape == (512, 1024, 3)
    found, written_light = panorama_sh(read, 4), panorama_sh(small, 4)
    np.testing.assert_allclose(found, written_light, atol=0.01 * np.abs(written_light).max())


def test_eight_bits_are_srgb(tmp_path: Path) -> None:
    path = tmp_path / "sky.png"
    cv2.imwrite(str(path), np.full((16, 32, 3), 188, np.uint8))
    np.testing.assert_allclose(read_panorama(path), 0.503, atol=0.001)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "No such file"),
        (b"", "not a picture"),
        (b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 16 +X 32\nab", "not a picture"),
        (np.ones((16, 16, 3)), "twice as wide"),
        (np.zeros((16, 32, 3)), "black"),
    ],
    ids=["absent", "empty", "truncated", "square", "black"],
)
def test_files_that_are_no_panoramas(content: bytes | Floats | None, words: str, tmp_path: Path) -> None:
    path = tmp_path / "sky.hdr"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        written(tmp_path, content)
    with pytest.raises(PanoramaError, match=words) as caught:
        read_panorama(path)
    assert "\n" not in str(caught.value)


@pytest.mark.data
def test_published_uffizi() -> None:
    """The Orange Book's nine coefficients; its axes d = (sin t cos p, cos t, -sin t sin p), p = 2 pi column / width,
    are ours with x and z in each other's place (its columns run to the left of a right-handed frame)."""
    tables = json.loads(data_folder("sh_tables/published_sh9.json").read_text())
    published = np.array(tables["orange_book"]["Uffizi Gallery"])
    picture = read_panorama(data_folder("hdr/uffizi_latlong_1200x600.hdr"))
    height, width = picture.shape[:2]
    t, p = np.pi * (np.arange(height) + 0.5)[:, None] / height, 2 * np.pi * (np.arange(width) + 0.5)[None] / width
    stated = np.stack([np.sin(t) * np.cos(p), np.cos(t) + 0 * p, -np.sin(t) * np.sin(p)], axis=-1)
    np.testing.assert_allclose(panorama_directions(height, width)[..., ::-1], stated, atol=1e-12)
    y, z, x, xy, yz, zz, xz, xxyy = panorama_sh(picture, 3)[1:]
    root = np.sqrt(3) / 2
    swapped = np.stack([y, x, z, yz, xy, root * xxyy - zz / 2, xz, root * zz + xxyy / 2])
    found = 0.1004 * np.concatenate([panorama_sh(picture, 1), swapped])
    # Relative to the whole row: single coefficients near zero have no relative error.
    assert np.abs(found - published).max() < 0.01 * np.abs(published).max()
