"""The up direction from normals: boxes, noise, and scenes that do not fix it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from server.maths.sh import spherical_fibonacci
from server.maths.up_direction import BINS, NormalHistogram, find_up

Floats = NDArray[np.float64]
FLOOR, LEFT, BACK = (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
UP = np.array(FLOOR)


def histogram(parts: dict[tuple[float, float, float], int], noise_deg: float = 0.0, seed: int = 0) -> NormalHistogram:
    """Of `parts`: how many normals face each direction, each turned by noise of that deviation an axis."""
    random = np.random.default_rng(seed)
    normals = np.concatenate([np.tile(direction, (count, 1)) for direction, count in parts.items()]).astype(np.float64)
    turns = Rotation.from_rotvec(np.radians(noise_deg) * random.normal(size=normals.shape))
    found = NormalHistogram()
    found.add(turns.apply(normals))
    return found


def angle_deg(a: Floats, b: Floats) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


def tilted(deg: float, about: Floats) -> Floats:
    return np.asarray(Rotation.from_rotvec(np.radians(deg) * about / np.linalg.norm(about)).apply(UP))


@pytest.mark.parametrize(
    "parts",
    [
        {FLOOR: 1000},
        {FLOOR: 200, BACK: 1800},
        {FLOOR: 200, LEFT: 900, BACK: 900},
        {LEFT: 700, BACK: 300},
        {(0.0, -1.0, 0.0): 500, BACK: 500},
        {FLOOR: 500, (0.6, 0.0, 0.8): 500},
    ],
    ids=["floor", "floor, wall", "room", "two walls", "ceiling, wall", "wall at any angle"],
)
@pytest.mark.parametrize("tilt_deg", [0.0, 30.0])
def test_it_is_found_from_a_camera_that_leans(parts: dict[tuple[float, float, float], int], tilt_deg: float) -> None:
    for azimuth in np.arange(0.1, 6.2, 0.7):
        camera_up = tilted(tilt_deg, np.array([np.cos(azimuth), 0.0, np.sin(azimuth)]))
        fit = find_up(histogram(parts), camera_up)
        assert fit is not None
        assert angle_deg(fit.up, UP) < 1e-5


def test_noise_averages_out() -> None:
    """500 normals of 3 degrees an axis have a mean that deviates by 0.13 degrees an axis; those farther off than 5
    degrees are not used."""
    for seed in range(5):
        fit = find_up(histogram({FLOOR: 500, LEFT: 900, BACK: 600}, 3.0, seed), tilted(20.0, np.array([1.0, 0, 0])))
        assert fit is not None
        assert angle_deg(fit.up, UP) < 0.6  # seen: 0.47


def test_shares_are_of_all_normals() -> None:
    fit = find_up(histogram({FLOOR: 300, BACK: 500, (0.6, 0.64, 0.48): 200}), UP)
    assert fit is not None
    assert (fit.horizontal, fit.vertical) == pytest.approx((0.3, 0.5))


@pytest.mark.parametrize(
    "parts", [{BACK: 1000}, {BACK: 960, LEFT: 40}, {(0.6, 0.64, 0.48): 1000, (-0.6, -0.64, 0.48): 0}]
)
def test_one_wall_or_slope_does_not_fix_it(parts: dict[tuple[float, float, float], int]) -> None:
    fit = find_up(histogram(parts), UP)
    assert fit is None or parts.get(BACK) is None  # a slope cannot be told from a floor


def test_round_things_do_not_fix_it() -> None:
    sphere = NormalHistogram()
    sphere.add(spherical_fibonacci(20000))
    assert find_up(sphere, UP) is None
    assert find_up(NormalHistogram(), UP) is None


def test_it_is_not_sought_far_from_the_camera() -> None:
    """A floor alone that is 70 degrees from the camera's up may as well be a wall."""
    assert find_up(histogram({FLOOR: 1000}), tilted(70.0, np.array([1.0, 0.0, 0.0]))) is None


def test_what_moves_the_scene_moves_the_result() -> None:
    turn = Rotation.from_rotvec([0.4, -1.1, 0.3])
    parts = {FLOOR: 400, LEFT: 300, BACK: 300}
    turned = {(float(x), float(y), float(z)): n for (x, y, z), n in ((turn.apply(d), n) for d, n in parts.items())}
    fit = find_up(histogram(turned), turn.apply(tilted(25.0, np.array([1.0, 0.0, 1.0]))))
    assert fit is not None
    assert angle_deg(fit.up, turn.apply(UP)) < 1e-5


def test_directions_are_means_of_bins() -> None:
    """Of each bin, which is about 180 / BINS degrees wide; their shares sum to 1."""
    normals = spherical_fibonacci(50000)
    found = NormalHistogram()
    found.add(normals[:20000])
    found.add(normals[20000:])
    directions, shares = found.directions()
    assert shares.sum() == pytest.approx(1.0, abs=0.02)  # rare bins are left out
    nearest = np.degrees(np.arccos((directions @ normals[::97].T).max(axis=0).clip(-1, 1)))
    assert nearest.max() < 2 * 180 / BINS
