"""B9's bases against quadrature, closed forms and direct sums, and lights that lie in them found again."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from client.sources.volume import default_volume, default_voxel
from client.synthetic.source import open_synthetic
from protocol.messages import Wishes
from server.light.light_estimation import TileSums, prior_precision
from server.maths.sh import LUMINANCE, spherical_fibonacci
from server.opencl.device import Device
from server.transfer.radiance_transfer import direction_sets
from tests.bench.bases.bases import (
    FINE_BANDS,
    SIZES,
    Basis,
    bases_of,
    cells,
    from_octahedral,
    gaussian_integral,
    gaussian_overlap,
    gaussians,
    haar,
    harmonics,
    largest_haar,
    octahedral,
)
from tests.bench.bases.estimation import estimate_light, nearest_nonnegative
from tests.bench.bases.lights import LATTICE, HardLight, disc, lattice, of_panorama, sun, two_lamps
from tests.bench.bases.scene import STRIDE, Ball, LitScene, rays_in
from tests.bench.bases.scores import Transfers, Truth, score_light
from tests.bench.light.environment import CUBE_SIDE, cube_directions
from tests.reference.sh import lambert_bands, open_transfer, sh_basis, sphere_rule
from tests.scenes.lights import degrees_between, random_directions, unit

Floats = NDArray[np.float64]

NAMES = {size: [f"SH {size}", f"SG {size}", f"{'Haar' if size in (4, 16) else 'cells'} {size}"] for size in SIZES}
FINE, WEIGHTS = sphere_rule(90, 180)
"""Exact for smooth functions."""
EVEN = spherical_fibonacci(40_000)
"""For functions that jump at the edges of cells: points of equal solid angle, a degree apart."""
AREA = 4 * np.pi / len(EVEN)
BALL = Ball((0.06, 0.0, -0.07), 0.06)
NORMALS = random_directions(30, 9)


ALL = [name for names in NAMES.values() for name in names]
every_basis = pytest.mark.parametrize("basis", ALL, indirect=True)


@pytest.fixture
def basis(request: pytest.FixtureRequest) -> Basis:
    """By its name; computed when a test needs it, not when tests are collected."""
    name, size = request.param.split()
    return next(found for found in bases_of(int(size)) if found.name == name)


def test_all_bases_are_named() -> None:
    assert [f"{basis.name} {basis.size}" for size in SIZES for basis in bases_of(size)] == ALL


def error_of(basis: Basis) -> float:
    """Relative, of sums over EVEN: 1e-5 of smooth functions, half a percent of cells; twice that is allowed."""
    return 0.012 if basis.name in ("Haar", "cells") else 1e-4


@every_basis
def test_gram_and_harmonics_are_integrals(basis: Basis) -> None:
    values = basis.values(EVEN)
    np.testing.assert_allclose(AREA * values.T @ values, basis.gram, atol=error_of(basis) * np.abs(basis.gram).max())
    np.testing.assert_allclose(basis.sh[:, :64], AREA * values.T @ sh_basis(EVEN, 8), atol=error_of(basis))


@every_basis
def test_open_transfer_is_the_cosine_integral(basis: Basis) -> None:
    normals = random_directions(12, 1)
    direct = AREA / np.pi * np.maximum(normals @ EVEN.T, 0) @ basis.values(EVEN)
    np.testing.assert_allclose(basis.open_transfer(normals), direct, atol=error_of(basis) * np.abs(direct).max())


def test_harmonics_are_those_of_the_product() -> None:
    basis, normals = harmonics(16), random_directions(9, 2)
    np.testing.assert_allclose(basis.values(normals), sh_basis(normals, 4), atol=1e-12)
    np.testing.assert_allclose(basis.open_transfer(normals), open_transfer(normals, 4), atol=1e-12)
    np.testing.assert_allclose(basis.precision(), np.diag(prior_precision(4)), atol=1e-12)
    np.testing.assert_allclose(lambert_bands(FINE_BANDS)[[0, 1, 2, 3]], [1, 2 / 3, 1 / 4, 0])


def test_the_octahedral_map_keeps_areas_and_comes_back() -> None:
    directions = np.concatenate([random_directions(5000, 3), np.eye(3), -np.eye(3)])
    places = octahedral(directions)
    assert np.abs(places).max() <= 1
    np.testing.assert_allclose(from_octahedral(places), directions, atol=1e-7)
    inside = np.abs(places).sum(1) < 1
    np.testing.assert_array_equal(inside[:5000], directions[:5000, 2] > 0)
    many = random_directions(200_000, 4)
    column, row = ((octahedral(many) + 1) / 2 * 5).astype(int).T
    counts = np.bincount(5 * row + column, minlength=25) / len(many)
    np.testing.assert_allclose(counts, 1 / 25, atol=4 * np.sqrt(0.04 / len(many)))  # four standard deviations


@pytest.mark.parametrize("size", [4, 16, 64, 256])
def test_wavelets_are_orthonormal_and_have_no_mean(size: int) -> None:
    basis = haar(size)
    steps = (np.arange(64) + 0.5) / 32 - 1
    directions = from_octahedral(np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2))
    values = basis.values(directions)  # an equal-area rule with whole numbers of points in every cell
    np.testing.assert_allclose(values.T @ values * (4 * np.pi / 4096), np.eye(size), atol=1e-12)
    np.testing.assert_allclose(values.mean(0), np.eye(size)[0] / np.sqrt(4 * np.pi), atol=1e-12)
    assert (np.count_nonzero(values[:, -1]) / 4096) == pytest.approx(4 / size)  # the finest touch four cells


def test_wavelets_span_what_cells_do() -> None:
    light = cells(16).values(lattice()) @ np.random.default_rng(5).normal(size=(16, 2))
    wavelets = haar(16)
    held = wavelets.nearest(lattice(), light * (4 * np.pi / LATTICE))
    even = np.linalg.lstsq(wavelets.values(lattice()), light, rcond=None)[0]
    np.testing.assert_allclose(wavelets.values(lattice()) @ even, light, atol=1e-12)
    np.testing.assert_allclose(held, even, atol=0.15)  # the lattice is no equal-area rule of the cells
    np.testing.assert_allclose(np.linalg.eigvalsh(wavelets.precision()), np.linalg.eigvalsh(cells(16).precision()))


def test_the_largest_wavelets_leave_least() -> None:
    light = sun(1.0)
    directions, flux = light.directions(), light.flux()
    whole = haar(256).values(directions).T @ flux
    chosen = largest_haar(9, directions, flux)
    kept = (chosen.values(directions).T @ flux) ** 2
    assert chosen.size == 9
    assert kept.sum() == pytest.approx(np.sort((whole**2).sum(1))[-9:].sum())
    fixed = haar(16).values(directions).T @ flux
    assert kept.sum() > (fixed**2).sum()  # a sun is in few wavelets, none of which is coarse
    with pytest.raises(ValueError, match="no amounts"):
        chosen.nearest(directions, flux, nonnegative=True)


@pytest.mark.parametrize("sharpness", [0.7, 6.0, 40.0])
def test_closed_forms_of_gaussians(sharpness: float) -> None:
    z, weights = np.polynomial.legendre.leggauss(300)
    assert gaussian_integral(sharpness) == pytest.approx(2 * np.pi * weights @ np.exp(sharpness * (z - 1)))
    axes = random_directions(5, 6)
    values = np.exp(sharpness * (FINE @ axes.T - 1))
    overlap = (WEIGHTS[:, None] * values).T @ values
    np.testing.assert_allclose(gaussian_overlap(sharpness, axes @ axes.T), overlap, rtol=1e-9)
    opposite = gaussian_overlap(sharpness, np.array([-1.0]))  # the product is even: exp(-2 s) everywhere
    assert opposite[0] == pytest.approx(4 * np.pi * np.exp(-2 * sharpness), rel=1e-6)


@pytest.mark.parametrize("size", [16, 36])
def test_gaussians_add_up_to_a_nearly_even_light(size: int) -> None:
    total = gaussians(size).values(FINE).sum(1)
    assert WEIGHTS @ total == pytest.approx(4 * np.pi)
    assert 0.7 < total.min() < total.max() < 1.2
    assert total.std() < 0.1
    apart = np.sort(gaussians(size).values(FINE) / gaussians(size).values(FINE).max(), axis=1)
    assert apart[:, -2].min() < 0.5 < apart[:, -2].max()


def test_flat_gaussians_are_harmonics() -> None:
    """In the flat limit sums of Gaussians span the harmonics, if their amounts may be negative."""
    light = sh_basis(FINE, 4) @ np.random.default_rng(7).normal(size=16)
    left = []
    for sharpness in (2.0, 0.5, 0.25):
        basis = gaussians(16, sharpness)
        found = basis.values(FINE) @ basis.nearest(FINE, (WEIGHTS * light)[:, None])[:, 0]
        left.append(np.sqrt(WEIGHTS @ (found - light) ** 2 / (WEIGHTS @ light**2)))
    assert left[0] > 2 * left[1] > 3 * left[2]
    assert left[2] < 0.1


@every_basis
def test_the_prior_is_of_functions(basis: Basis) -> None:
    """Lights of the prior, harmonics of variance 1 / (1 + l (l + 1)): the nearest ones' covariance is the inverse."""
    points = EVEN[::2]
    band = np.sqrt(np.arange(FINE_BANDS**2)).astype(int)
    lights = sh_basis(points, FINE_BANDS) / np.sqrt(1.0 + band * (band + 1))
    found = basis.nearest(points, 2 * AREA * lights)
    white = np.linalg.cholesky(basis.precision()).T @ found
    np.testing.assert_allclose(white @ white.T, np.eye(basis.size), atol=5 * error_of(basis) + 0.005)


@pytest.mark.parametrize("basis", [name for name in ALL if not name.startswith("SH")], indirect=True)
def test_nonnegative_lights_are_the_nearest_of_them(basis: Basis) -> None:
    light = sun(0.3)
    directions, flux = light.directions(), light.flux()
    found = basis.nearest(directions, flux, nonnegative=True)
    assert (basis.values(FINE) @ found).min() > -1e-9
    assert basis.from_amounts is not None
    amounts = np.linalg.solve(basis.from_amounts, found)
    slope = basis.from_amounts.T @ (basis.gram @ found - basis.values(directions).T @ flux)
    assert amounts.min() > -1e-9
    assert slope.min() > -1e-7  # no amount that is kept at zero would rather rise
    np.testing.assert_allclose(amounts * slope, 0, atol=1e-7)


@pytest.mark.parametrize("light", [sun(0.2), two_lamps(1.0), disc(2.0)], ids=lambda light: light.name)
def test_what_is_known_of_a_light_is_true(light: HardLight) -> None:
    """Figures from the light's points against sums over finer ones, and closed forms of discs above the horizon."""
    even, area = light.even[np.argmax(EVEN[::2] @ lattice().T, 1)], 2 * AREA
    total = area * even.sum(0) + sum(disc.radiance * disc.solid_angle for disc in light.discs)
    np.testing.assert_allclose(light.flux().sum(0), total, rtol=0.002)
    np.testing.assert_allclose(light.sh(2)[0], light.flux().sum(0) / np.sqrt(4 * np.pi))
    exact = area / np.pi * np.maximum(NORMALS @ EVEN[::2].T, 0) @ even
    whole = np.ones(len(NORMALS), bool)
    for one in light.discs:
        cosine, width = NORMALS @ one.direction, np.sin(one.radius_rad)
        exact += np.outer(np.maximum(cosine, 0) * width**2, one.radiance)
        whole &= np.abs(cosine) > width  # else part of it has set
    assert whole.sum() > 15
    np.testing.assert_allclose(light.irradiance(NORMALS)[whole], exact[whole], atol=0.008)
    assert light.irradiance(EVEN[::80]).max() == pytest.approx(1, abs=0.02)
    assert light.flux().min() >= 0
    cosines = EVEN @ np.stack([one.direction for one in light.discs]).T
    inside = cosines >= np.cos([one.radius_rad for one in light.discs])
    radiance = light.even[np.argmax(EVEN @ lattice().T, 1)] + inside @ np.stack([one.radiance for one in light.discs])
    pixel = np.concatenate([np.argmax(part @ cube_directions(CUBE_SIDE).T, 1) for part in np.array_split(EVEN, 20)])
    count = np.bincount(pixel, minlength=6 * CUBE_SIDE**2)
    sums = np.stack([np.bincount(pixel, radiance[:, c], len(count)) for c in range(3)], 1)
    apart = light.cube_map() - sums / count[:, None]
    assert np.abs(apart).mean() < 0.15 * light.cube_map().mean()  # 26 points a pixel tell how much of it a disc fills


def test_a_disc_is_round_and_where_it_was_put() -> None:
    one = two_lamps(0.7).discs[0]
    points = one.points()
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1)
    angles = np.arccos(points @ one.direction)
    assert angles.max() <= one.radius_rad
    assert degrees_between(points.mean(0), one.direction) < 0.3
    assert np.cos(angles).mean() == pytest.approx((1 + np.cos(one.radius_rad)) / 2, abs=1e-6)
    np.testing.assert_allclose(one.direction, unit([np.sin(0.7), np.tan(np.radians(55)), np.cos(0.7)]), atol=1e-12)


@pytest.mark.parametrize("turn", [0.0, 0.6, 4.0])
def test_a_panorama_turns_about_up(turn: float) -> None:
    picture = np.full((64, 128, 3), 0.1)
    picture[20:24, 78:82] = [40.0, 30.0, 20.0]  # an eighth of a turn to the right of -z, 28 degrees up
    towards = of_panorama("one lamp", picture, turn).sh(2)[[3, 1, 2]] @ LUMINANCE
    height, side = np.radians(90 - 22 * 180 / 64), np.pi / 4 - turn
    true = [np.sin(side) * np.cos(height), np.sin(height), -np.cos(side) * np.cos(height)]
    assert degrees_between(towards, true) < 3
    even = of_panorama("even", np.full((64, 128, 3), 7.0), 0.3)
    np.testing.assert_allclose(even.even, 1.0, rtol=1e-3)


def tiles_of(rows: Floats, seen: Floats, tiles: int = 40) -> TileSums:
    """Sums of samples: rows [n, size] of transfer times albedo, seen [n, 3]."""
    target = np.column_stack([seen @ LUMINANCE, seen])
    parts = list(zip(np.array_split(rows, tiles), np.array_split(target, tiles), strict=True))
    return TileSums(
        np.stack([a.T @ a for a, _ in parts]),
        np.stack([a.T @ y for a, y in parts]),
        np.stack([(y**2).sum(0) for _, y in parts]),
        np.array([float(len(a)) for a, _ in parts]),
    )


@every_basis
def test_a_light_of_the_basis_is_found_again(basis: Basis) -> None:
    """From shadowed points, with noise: each sees the part of the sky above a plane besides that of its surface."""
    generator = np.random.default_rng(11)
    normals, edges = random_directions(1500, 12), random_directions(1500, 13)
    directions, weights = sphere_rule(30, 60)
    visible = np.maximum(normals @ directions.T, 0) * (edges @ directions.T > -0.2) * weights / np.pi
    rows = visible @ basis.values(directions)
    if basis.from_amounts is None:
        light = np.zeros((basis.size, 3))
        light[:4] = np.array([[3.5, 0.4, 0.8, 0.6], [3.5, 0.3, 0.7, 0.2], [3.5, 0.1, 0.5, 0.1]]).T
    else:
        light = basis.from_amounts @ generator.uniform(0.2, 2.0, (basis.size, 3))
    seen = 0.5 * rows @ light
    sums = tiles_of(rows, seen + generator.normal(0, 0.002, seen.shape))
    for found in estimate_light(sums, basis):
        np.testing.assert_allclose(rows @ found, 2 * seen, atol=0.01 * seen.max())
        shown, true = basis.values(FINE[::7]) @ found, basis.values(FINE[::7]) @ light
        assert np.linalg.norm(shown - true) < 0.1 * np.linalg.norm(true)
    dark = estimate_light(sums, basis, strength=1e12)[0]  # the prior alone
    assert np.abs(dark).max() < 0.01 * np.abs(light).max()


@pytest.mark.parametrize("basis", NAMES[16], indirect=True)
def test_light_that_may_not_be_negative_is_not(basis: Basis) -> None:
    light = basis.nearest(*(getattr(sun(0.4), part)() for part in ("directions", "flux")))
    assert (basis.values(FINE) @ light).min() < (-0.1 if basis.name != "Haar" else 1)
    information = np.diag(np.arange(1.0, 17.0))
    found = nearest_nonnegative(basis, light - 0.3 * light.max(), information)
    brightest = (basis.values(FINE) @ found).max()
    assert (basis.values(FINE) @ found).min() > -0.02 * max(brightest, 1.0)  # harmonics: between probes


@pytest.fixture(scope="module")
def scene(device: Device) -> Iterator[LitScene]:
    source = open_synthetic("synthetic:table?size=160x120&frames=2&noise=1")
    volume_m = default_volume(source, range(2))
    wishes = Wishes(volume_m=volume_m, voxel_m=default_voxel(volume_m), up=source.up)
    inside = harmonics(16)
    soft = np.maximum(inside.values(lattice()) @ inside.nearest(lattice(), disc(0.4).flux()[:LATTICE]), 0)
    lights = [sun(0.4), HardLight("even", np.ones((LATTICE, 3)), ()), HardLight("soft", soft, ())]
    found = LitScene(device, source.camera, [source[0], source[1]], wishes, lights, BALL)
    yield found
    found.close()


@pytest.mark.parametrize("basis", [*NAMES[9], *NAMES[16]], indirect=True)
def test_the_kernel_gives_transfer_in_any_basis(scene: LitScene, basis: Basis) -> None:
    """Against sums on the host over the directions that the kernel says are blocked."""
    view = scene.views[1]
    found = scene.engine.download(scene.transfer(basis, view).coefficients)
    np.testing.assert_allclose(found[view.covered], view.samples.transfer(basis), atol=3e-6)
    assert (found[~view.covered] == 0).all()
    assert rays_in(basis).directions is direction_sets(81, 2).directions


@pytest.mark.parametrize("basis", NAMES[36], indirect=True)
def test_transfer_of_an_even_light_is_openness(scene: LitScene, basis: Basis) -> None:
    even = basis.nearest(FINE, WEIGHTS[:, None] * np.ones((len(FINE), 1)))
    for points in (scene.views[0].samples, scene.ball, scene.floor):
        apart = np.abs((points.transfer(basis) @ even)[:, 0] - scene.shading(points, 1)[:, 0])
        # 81 directions know openness to some percent; sums of Gaussians are even to a tenth
        assert apart.mean() < 0.05
        assert np.quantile(apart, 0.95) < 0.15


def test_the_ball_shades_the_floor(scene: LitScene) -> None:
    even, (places, _) = scene.shading(scene.floor, 1)[:, 0], BALL.floor()
    assert len(even) == len(scene.floor.normals) > 150
    assert even.min() < 0.3
    assert even.max() > 0.75
    away, below = np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 1.0, 0.0]])
    under, beside = np.array([BALL.foot_m]), np.array(BALL.foot_m) + np.array([[0.5, 0.06, 0]])
    assert BALL.hides(under, below).all()
    assert not BALL.hides(beside, away).any()
    assert BALL.hides(beside, np.array([[-1.0, 0.0, 0.0]])).all()
    assert not BALL.hides(beside, np.array([[1.0, 0.0, 0.0]])).any()  # it is behind
    assert np.linalg.norm(places - BALL.foot_m, axis=1).max() < 2.5 * BALL.radius_m + 1e-9


def test_pictures_show_the_truth_and_light_is_found_in_them(scene: LitScene) -> None:
    view = scene.views[0]
    shown = scene.engine.download(scene.show(1, view)).view(np.float32).reshape(120, 160, 4)
    sampled = shown[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE, :3][view.covered]
    np.testing.assert_allclose(sampled, 0.5 * scene.shading(view.samples, 1), atol=0.006)  # 8 bits
    basis = harmonics(16)
    sums = scene.sums(basis)
    assert len(sums) == 3
    assert sums[0].counts.sum() > 12
    truth = Truth.of(scene.lights[2], scene.shading(scene.ball, 2), scene.shading(scene.floor, 2))
    free, bounded = estimate_light(sums[2], basis)
    for light in (free, bounded):
        again = 0.5 * view.samples.transfer(basis) @ light
        exact = 0.5 * scene.shading(view.samples, 2)
        assert np.linalg.norm(again - exact) < 0.1 * np.linalg.norm(exact)
    transfers = Transfers(scene.ball.transfer(basis), scene.floor.transfer(basis))
    assert score_light(basis, bounded, transfers, truth).shading < 0.15


def test_scores_are_nothing_where_nothing_is_wrong() -> None:
    """A light even in the cells of a basis, which is its own truth."""
    basis = cells(9)
    light = HardLight("cells", basis.values(lattice()) @ np.random.default_rng(14).uniform(0.2, 1, (9, 3)), ())
    found = basis.nearest(lattice(), light.flux())
    normals = random_directions(50, 15)
    transfers = Transfers(basis.open_transfer(normals), basis.open_transfer(-normals))
    truth = Truth.of(light, light.irradiance(normals), light.irradiance(-normals))
    right = score_light(basis, 3 * found, transfers, truth)
    # the lattice's cells are not the map's: 3 % along their edges
    assert right.direction_deg < 3
    assert max(right.irradiance, right.shading, right.near) < 0.03
    assert right.msad < 0.1
    assert right.least_radiance == pytest.approx(
        3 * (light.even @ LUMINANCE).min() / (light.even @ LUMINANCE).mean(), 0.05
    )
    assert right.least_radiance < right.least_irradiance < 3
    wrong = score_light(basis, np.roll(found, 4, axis=0), transfers, truth)
    assert wrong.direction_deg > 10
    assert wrong.msad > 2 * right.msad
    assert wrong.shading > 3 * right.shading


def test_the_picture_is_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from tests.bench.bases.comparison import MEASURES, VARIANTS, draw_bases

    points = [
        {"basis": name, "coefficients": size, "scene": "table", "variant": variant, "ms_ratio": size / 16,
         **dict.fromkeys(MEASURES, 1 / size), **{f"{key}_error": 0.01 for key in MEASURES}}
        for name in ("SH", "SG", "Haar", "cells") for size in (4, 16) for variant in VARIANTS
    ]  # fmt: skip
    draw_bases(points, tmp_path / "bases.png")
    assert (tmp_path / "bases.png").read_bytes()[:4] == b"\x89PNG"
