"""Non-negative lobes: they recover what shines, stay positive, and are no narrower than the samples call for."""

from __future__ import annotations

import numpy as np
import pytest

from server.maths.lobes import (
    CELL_SR,
    CELLS,
    LEAST_GAIN,
    WIDTHS_DEG,
    CellEquations,
    cell_directions,
    cells_to_sh,
    fit_lobes,
    fit_width,
    lobe_family,
    spread_of,
)
from server.maths.sh import sh_basis, spherical_fibonacci
from tests.scenes.analytic import Floats


def balls(count: int, seed: int = 0) -> Floats:
    """[count, CELLS] transfer of open white surface facing everywhere; half of it has half of its sky hidden."""
    rng = np.random.default_rng(seed)
    normals = spherical_fibonacci(count)
    transfer = np.maximum(normals @ cell_directions().T, 0) * CELL_SR / np.pi
    hidden = cell_directions() @ spherical_fibonacci(count)[rng.permutation(count)].T > 0
    return np.where(hidden.T & (np.arange(count) % 2 == 0)[:, None], 0, transfer)


def equations(transfer: Floats, light: Floats, noise: float = 0.0) -> CellEquations:
    seen = transfer @ light
    seen = seen + np.random.default_rng(1).normal(size=len(seen)) * noise * seen.std()
    return CellEquations(transfer.T @ transfer, transfer.T @ seen, float(seen @ seen))


def sun(width_deg: float, towards: tuple[float, float, float] = (0.3, -0.8, 0.5)) -> Floats:
    """[CELLS] of a dim sky and one soft light."""
    to = np.array(towards) / np.linalg.norm(towards)
    apart = np.arccos(np.clip(cell_directions() @ to, -1, 1))
    return 0.2 + 3 * np.exp(-0.5 * (apart / np.deg2rad(width_deg)) ** 2)


@pytest.mark.parametrize("width", WIDTHS_DEG)
def test_families_cover_the_sphere_evenly(width: float) -> None:
    lobes = lobe_family(width)
    np.testing.assert_allclose(lobes.sum(axis=0), 1)
    flat = lobes.sum(axis=1)
    assert flat.std() < 0.12 * flat.mean()


def test_cells_become_coefficients() -> None:
    """Of a function that the bands hold."""
    coefficients = np.random.default_rng(2).normal(size=16)
    np.testing.assert_allclose(
        cells_to_sh(4) @ (sh_basis(cell_directions(), 4) @ coefficients),
        coefficients,
        atol=0.02 * np.abs(coefficients).max(),
    )


@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize("width_deg", [35.0, 12.0])
def test_a_known_light_is_found(width_deg: float, noise: float) -> None:
    light = sun(width_deg)
    fit = fit_lobes(equations(balls(1500), light, noise))
    assert (fit.cells >= 0).all()
    found, true = cells_to_sh(2) @ fit.cells, cells_to_sh(2) @ light
    cosine = found[1:] @ true[1:] / np.linalg.norm(found[1:]) / np.linalg.norm(true[1:])
    assert np.degrees(np.arccos(min(cosine, 1.0))) < 2.0
    assert found[0] == pytest.approx(true[0], rel=0.02)


def test_the_widest_family_that_explains_is_taken() -> None:
    transfer = balls(1500)
    assert fit_lobes(equations(transfer, sun(40.0), noise=0.02)).width_deg == WIDTHS_DEG[0]
    narrow = equations(transfer, sun(10.0) + sun(10.0, (-0.9, 0.1, 0.2)))
    fit = fit_lobes(narrow)
    assert fit.width_deg < 20
    steps = WIDTHS_DEG.index(fit.width_deg)
    assert fit.misfit < LEAST_GAIN**steps * fit_width(narrow, WIDTHS_DEG[0]).misfit


@pytest.mark.parametrize("width_deg", [35.0, 10.0])
def test_guesses_of_what_is_lit_change_nothing(width_deg: float) -> None:
    """None, wrong ones, and those of the same light."""
    sums = equations(balls(1500), sun(width_deg) + sun(width_deg, (-0.9, 0.1, 0.2)), noise=0.02)
    plain = fit_lobes(sums)
    lit = {width: np.arange(lobe_family(width).shape[1]) % 2 == 0 for width in WIDTHS_DEG[1:]}
    for _ in range(2):
        guessed = fit_lobes(sums, lit)
        assert guessed.width_deg == plain.width_deg
        np.testing.assert_allclose(guessed.amounts, plain.amounts, rtol=1e-6, atol=1e-9 * plain.amounts.max())
    assert set(lit) == set(WIDTHS_DEG)
    np.testing.assert_array_equal(lit[plain.width_deg], plain.amounts > 0)


def test_what_no_sample_sees_stays_finite_and_uncertain() -> None:
    """Only surface facing up: the light from below is open, and its spread says so."""
    normals = np.tile([0.0, 0.0, 1.0], (200, 1)) + 0.1 * np.random.default_rng(3).normal(size=(200, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    transfer = np.maximum(normals @ cell_directions().T, 0) * CELL_SR / np.pi
    fit = fit_width(equations(transfer, sun(35.0), noise=0.01), 35.0)
    assert np.isfinite(fit.cells).all()
    assert fit.cells.max() < 100 * sun(35.0).max()
    deviation = np.sqrt((spread_of(equations(transfer, sun(35.0), noise=0.01), fit, noise=1e-4) ** 2).sum(axis=1))
    up = cell_directions()[:, 2]
    assert deviation[up < -0.7].min() > 0.3 * fit.cells.mean()
    assert np.isfinite(deviation).all()


def test_drawn_to_a_light_it_follows_where_the_samples_are_silent() -> None:
    nothing = CellEquations(np.eye(CELLS) * 1e-12, np.zeros(CELLS), 1e-12)
    near = lobe_family(35.0) @ np.full(lobe_family(35.0).shape[1], 2.0)
    drawn = fit_width(nothing, 35.0, near=near, pull=1e6)
    np.testing.assert_allclose(drawn.cells, near, rtol=0.05)


def test_a_spread_of_sums_that_rounding_made_indefinite_is_finite() -> None:
    """A still view without noise: of what samples do not tell, float32 sums may say a little less than nothing."""
    whole = equations(balls(12), sun(35.0))
    fit = fit_width(whole, 35.0)
    cut = whole.matrix - 1e-9 * np.trace(whole.matrix) * np.eye(CELLS)
    lobes = lobe_family(35.0)
    assert np.linalg.eigvalsh(lobes.T @ cut @ lobes).min() < 0
    spread = spread_of(CellEquations(cut, whole.vector, whole.energy), fit, noise=1e-16)
    assert np.isfinite(spread).all()
