"""A change of the light against a change of the view, of the surface, of noise: by surface that two frames share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from server.maths.light_change import CELL_M, LEAST_SHARED, Shot, Shown, change_between, shown_by, surface_cells
from tests.scenes.analytic import Floats, look_at

HERE = Shot(np.eye(4))
BACK_M = 3.0


def corner(count: int = 600, seed: int = 0) -> tuple[Floats, Floats, Floats]:
    """Positions, normals and albedos of points on three walls that meet, textured by a factor of 4."""
    rng = np.random.default_rng(seed)
    face = rng.integers(0, 3, count)
    at = rng.uniform(0, 2, (count, 3))
    at[np.arange(count), face] = 0.0
    return at + np.array([0, 0, BACK_M]), np.eye(3)[face], rng.uniform(0.2, 0.8, count)


def shown(towards: tuple[float, float, float], *, seed: int = 0, noise: float = 0.0, shot: Shot = HERE) -> Shown:
    """What a frame shows of the corner under a sky and a light from one direction."""
    positions, normals, albedo = corner(seed=seed)
    to = np.array(towards) / np.linalg.norm(towards)
    luminance = albedo * (0.3 + np.maximum(normals @ to, 0))
    luminance *= np.exp(noise * np.random.default_rng(seed + 100).normal(size=len(luminance)))
    return shown_by(luminance, np.ones(len(luminance)), positions, normals, shot)


NOON, LATER = (0.2, 1.0, 0.3), (0.6, 0.8, 0.3)
NOON_ON_WALLS, LATER_ON_WALLS = (0.3 + np.array(light) / np.linalg.norm(light) for light in (NOON, LATER))


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_a_light_that_moved_is_told(noise: float) -> None:
    change = change_between(shown(NOON, noise=noise), shown(LATER, noise=-noise))
    assert change.is_certain
    walls = np.log(LATER_ON_WALLS / NOON_ON_WALLS)
    assert change.size == pytest.approx(np.sqrt(np.mean(walls**2)), rel=0.1)
    assert change.kept_weight < 0.01


@pytest.mark.parametrize("noise", [0.0, 0.02, 0.1, 0.3])
def test_texture_and_noise_are_no_change(noise: float) -> None:
    """Of one light, of 20 pairs of frames each."""
    pairs = [change_between(shown(NOON, noise=noise), shown(NOON, noise=-noise * k / 20)) for k in range(20)]
    assert not any(change.is_certain for change in pairs)


def test_a_brighter_light_is_told() -> None:
    before = shown(NOON)
    change = change_between(before, replace(before, levels=before.levels + np.log(1.2)))
    assert change.is_certain
    assert change.size == pytest.approx(np.log(1.2), rel=0.01)


def test_a_change_of_view_or_exposure_excuses_a_little() -> None:
    """A light that has turned by few degrees could be gloss, seen from elsewhere; one that has turned far could not."""
    near, far = (0.23, 1.0, 0.3), (1.0, 0.1, 0.3)
    beside = Shot(look_at((1.0, 0.0, 0.0), (1.0, 0.0, 3.0)))
    for shot in (beside, Shot(np.eye(4), 1.3)):
        assert change_between(shown(NOON), shown(near)).is_certain
        assert not change_between(shown(NOON), shown(near, shot=shot)).is_certain
        assert change_between(shown(NOON), shown(far, shot=shot)).is_certain


def test_frames_that_share_nothing_tell_nothing() -> None:
    a, b = shown(NOON), shown(LATER)
    few = LEAST_SHARED - 1
    some = Shown(b.cells[:few], b.levels[:few], b.normals[:few], b.positions[:few], HERE)
    none = Shown(b.cells + 1, b.levels, b.normals, b.positions, HERE)
    for other in (some, none):
        change = change_between(a, other)
        assert not change.is_certain
        assert change.evidence == 0


def test_black_and_unused_surface_is_left_out() -> None:
    positions, normals, albedo = corner()
    weights = np.where(np.arange(len(albedo)) % 2, 1.0, 0.1)
    frame = shown_by(np.where(positions[:, 0] > 1, 0.0, albedo), weights, positions, normals, HERE)
    assert 0 < len(frame.cells) < 0.5 * len(albedo)
    assert (frame.positions[:, 0] <= 1).all()
    assert np.isfinite(frame.levels).all()


def test_cells_are_of_places_and_sides() -> None:
    x = np.array([[0.01, 0.01, 0.01], [CELL_M - 0.01, 0.02, 0.02], [CELL_M + 0.01, 0.02, 0.02], [-0.01, 0.02, 0.02]])
    up = np.tile([0.0, 1.0, 0.1], (4, 1))
    cells = surface_cells(x, up, CELL_M)
    assert cells[0] == cells[1]
    assert len({*cells}) == 3
    assert (surface_cells(x, -up, CELL_M) != cells).all()
