"""Light estimation: the sums against their twins, the recovered light against the one that made the samples."""

from __future__ import annotations

import numpy as np
import pyopencl.cltypes as cl_types
import pytest

from server.light.light_estimation import (
    ASSUMED_ALBEDO,
    LEAST_FLAT_SHARE,
    LEAST_FLATNESS,
    LEAST_OPENNESS,
    LightEstimate,
    LightEstimator,
    TileSums,
    direction_spread_rad,
    flatness_gate,
    sum_tiles,
    unpack_tiles,
)
from server.opencl.device import Device
from server.opencl.engine import Engine
from tests.reference import light_estimation as twin
from tests.reference.sh import open_transfer
from tests.scenes import lights
from tests.scenes.light_samples import Floats, random_frame
from tests.scenes.lights import degrees_between, random_directions
from tests.scenes.solids import download4
from tests.scenes.tolerance import relative_tolerance

VOXEL_M = 0.01
TOWARD = (0.4, 0.7, -0.5)
LIGHT = lights.lobe_and_sky(TOWARD)


# ---- the kernels against their twins -----------------------------------------------------------------------------


@pytest.mark.parametrize(("height", "width", "stride", "bands"), [(60, 83, 1, 4), (120, 161, 4, 2), (190, 270, 8, 6)])
def test_sums_are_the_twins(device: Device, engine: Engine, height: int, width: int, stride: int, bands: int) -> None:
    frame = random_frame(height, width, stride, bands)
    found = sum_tiles(engine, *frame.upload(engine), VOXEL_M)
    rows, cols, n = frame.transfer.shape
    space = engine.workspace
    observed = twin.gather_samples(
        stride, frame.radiance, frame.labels, frame.openness, frame.flatness, LEAST_OPENNESS, LEAST_FLATNESS
    )
    assert 0.2 < observed[..., 3].mean() < 0.98
    tolerance = relative_tolerance(device)
    np.testing.assert_allclose(
        download4(engine, space.array("observed", (rows, cols), cl_types.float4)), observed, rtol=tolerance
    )

    # From here on the device's own intermediate results: each kernel is compared for the same input.
    observed = download4(engine, space.array("observed", (rows, cols), cl_types.float4)).astype(np.float64)
    sampled = frame.sampled
    transfer, pooled = twin.pool_samples(
        frame.positions[sampled], frame.normals[sampled], frame.transfer, observed, VOXEL_M
    )
    assert len(np.unique(pooled[..., 3])) > 5
    np.testing.assert_allclose(
        download4(engine, space.array("pooled", pooled.shape[:2], cl_types.float4)), pooled, rtol=tolerance
    )
    device_transfer = engine.download(space.array("pooled_transfer", transfer.shape, np.float32))
    np.testing.assert_allclose(device_transfer, transfer, atol=tolerance)

    pooled = download4(engine, space.array("pooled", pooled.shape[:2], cl_types.float4)).astype(np.float64)
    sums = twin.accumulate_tiles(device_transfer.astype(np.float64), pooled)
    sizes = twin.accumulate_tiles(np.abs(device_transfer).astype(np.float64), pooled)  # of what is added up
    partial = engine.download(space.array("tile_sums", sums.shape, np.float32))
    # A sum of 64 products of three float32 in a row: (64 + 2) roundings of at most 2^-24 of the summed sizes.
    assert (np.abs(partial - sums) <= 66 * 2.0**-24 * sizes).all()
    expected = unpack_tiles(sums, n).total()
    np.testing.assert_allclose(found.total().matrix, expected.matrix, rtol=1e-5, atol=1e-5 * expected.matrix.max())
    assert found.total().count == expected.count


def test_same_bits_twice(engine: Engine) -> None:
    frame = random_frame(97, 131, 2)
    estimates = []
    for _ in range(2):
        estimator = LightEstimator(4)
        estimates.append([estimator.update(sum_tiles(engine, *frame.upload(engine), VOXEL_M)) for _ in range(3)][-1])
    np.testing.assert_array_equal(estimates[0].sh, estimates[1].sh)
    np.testing.assert_array_equal(estimates[0].std, estimates[1].std)
    assert estimates[0].condition == estimates[1].condition


def test_unpacked_sums_are_the_normal_equations() -> None:
    random = np.random.default_rng(2)
    transfer, observed = random.normal(size=(11, 20, 9)), random.uniform(0, 1, (11, 20, 4))
    total = unpack_tiles(twin.accumulate_tiles(transfer, observed), 9).total()
    a, rgb, weight = transfer.reshape(-1, 9), observed.reshape(-1, 4)[:, :3], observed[..., 3].reshape(-1, 1)
    four = np.column_stack([rgb @ [0.2126, 0.7152, 0.0722], rgb])
    np.testing.assert_allclose(total.matrix, a.T @ (weight * a), rtol=1e-12)
    np.testing.assert_allclose(total.vector, a.T @ (weight * four), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(total.energy, (weight * four**2).sum(0), rtol=1e-12)
    assert total.count == 220


# ---- the light ---------------------------------------------------------------------------------------------------


def samples_of(
    light: Floats, normals: Floats, noise: float, seed: int = 0, shape: tuple[int, int] = (48, 64)
) -> TileSums:
    """A frame of open surfaces of the assumed albedo with given normals [rows * cols, 3] under a light [n, 3]."""
    transfer = open_transfer(normals, round(len(light) ** 0.5))
    rgb = ASSUMED_ALBEDO * transfer @ light
    rgb = rgb + noise * np.random.default_rng(seed).normal(size=rgb.shape)
    observed = np.insert(rgb, 3, 1, -1).reshape(*shape, 4)
    return unpack_tiles(twin.accumulate_tiles(transfer.reshape(*shape, -1), observed), len(light))


def assert_finite(estimate: LightEstimate) -> None:
    assert np.isfinite(estimate.sh).all()
    assert estimate.std is None or np.isfinite(estimate.std).all()
    assert not np.isnan(estimate.condition)


SEEN = [0, 1, 2, 3, 4, 5, 6, 7, 8]
"""An open surface does not show the third band (A_3 = 0)."""


@pytest.mark.parametrize("toward", random_directions(6, 3), ids=lambda d: ",".join(f"{x:.1f}" for x in d))
@pytest.mark.parametrize("noise", [0.001, 0.02])
def test_light_is_recovered(toward: Floats, noise: float) -> None:
    light = lights.lobe_and_sky(toward)
    estimate = LightEstimator(4).update(samples_of(light, random_directions(48 * 64, 4), noise))
    assert_finite(estimate)
    assert estimate.valid
    # 3072 samples of noise 0.02 against coefficients of l = 1 near 0.5: 0.1 degrees is one standard deviation.
    assert degrees_between(estimate.sh[[3, 1, 2]] @ [0.2126, 0.7152, 0.0722], toward) < 0.2 + 25 * noise
    np.testing.assert_allclose(estimate.sh[SEEN], light[SEEN], atol=0.01 + 2 * noise)
    assert estimate.std is not None
    assert (np.abs(estimate.sh - light)[SEEN] < 4 * estimate.std[SEEN] + 1e-3).all()


def test_what_is_not_seen_is_said_to_be_unknown() -> None:
    estimate = LightEstimator(4).update(samples_of(LIGHT, random_directions(48 * 64, 4), 0.02))
    assert estimate.std is not None
    assert estimate.std[9:].min() > 3 * estimate.std[SEEN].max()


def test_one_plane_is_not_valid() -> None:
    estimate = LightEstimator(4).update(samples_of(LIGHT, np.tile([0.0, 1.0, 0.0], (48 * 64, 1)), 0.01))
    assert_finite(estimate)
    assert not estimate.valid
    assert estimate.condition == float("inf") or estimate.condition > 1e12
    shaded = open_transfer(np.array([0.0, 1.0, 0.0]), 4) @ estimate.sh
    np.testing.assert_allclose(shaded, open_transfer(np.array([0.0, 1.0, 0.0]), 4) @ LIGHT, rtol=0.02)  # what was seen


def test_two_planes_are_not_valid() -> None:
    normals = np.tile([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], (48 * 32, 1))
    estimate = LightEstimator(4).update(samples_of(LIGHT, normals, 0.01))
    assert_finite(estimate)
    assert not estimate.valid


def test_nothing_seen_is_no_light() -> None:
    nothing = unpack_tiles(twin.accumulate_tiles(np.zeros((8, 8, 16)), np.zeros((8, 8, 4))), 16)
    for estimate in (LightEstimator(4).estimate(), LightEstimator(4).update(nothing)):
        assert_finite(estimate)
        assert not estimate.valid
        assert estimate.std is None
        assert estimate.condition == float("inf")
        np.testing.assert_array_equal(estimate.sh, 0)


@pytest.mark.parametrize("noise", [0.0, 1e-9])
def test_black_picture_is_finite_and_not_valid(noise: float) -> None:
    estimate = LightEstimator(4).update(samples_of(0 * LIGHT, random_directions(48 * 64, 5), noise))
    assert_finite(estimate)
    assert not estimate.valid
    assert np.abs(estimate.sh).max() < 1e-6


def test_a_frame_that_saw_nothing_changes_nothing() -> None:
    estimator = LightEstimator(4)
    before = estimator.update(samples_of(LIGHT, random_directions(48 * 64, 4), 0.01))
    nothing = unpack_tiles(twin.accumulate_tiles(np.zeros((8, 8, 16)), np.zeros((8, 8, 4))), 16)
    np.testing.assert_array_equal(estimator.update(nothing).sh, before.sh)


def test_light_that_jumps_is_followed() -> None:
    """After three frames of a new light it has 78 % of the weight or more, after ten hardly anything else is left."""
    before, after = lights.lobe_and_sky((1, 0.5, 0)), lights.lobe_and_sky((-1, 0.5, 0.3))
    estimator, normals = LightEstimator(4), random_directions(48 * 64, 6)
    for seed in range(20):
        estimator.update(samples_of(before, normals, 0.003, seed))
    shares = []
    for seed in range(10):
        found = estimator.update(samples_of(after, normals, 0.003, 100 + seed)).sh
        way = (after - before)[SEEN]
        shares.append(float(np.sum((found - before)[SEEN] * way) / np.sum(way * way)))
    assert 0.78 < shares[2] < 1.02
    assert shares[9] == pytest.approx(1, abs=0.02)


def test_steady_light_is_averaged() -> None:
    """Thirty frames of independent noise leave less than a third of one frame's error."""
    estimator, errors = LightEstimator(4), []
    for seed in range(30):
        found = estimator.update(samples_of(LIGHT, random_directions(48 * 64, 7), 0.05, seed)).sh
        errors.append(np.sqrt(np.mean((found - LIGHT)[SEEN] ** 2)))
    assert np.mean(errors[20:]) < errors[0] / 3


def test_what_the_camera_turned_away_from_is_not_forgotten() -> None:
    """P2: three frames of everything, then 300 of one wall: the direction stays, and stays valid."""
    light = lights.lobe_and_sky((1, 0.5, 0))
    estimator, thesis = LightEstimator(4), LightEstimator(4, as_thesis=True)
    wall = np.tile([0.0, 0.0, 1.0], (48 * 64, 1))
    for each in (estimator, thesis):
        for seed in range(3):
            each.update(samples_of(light, random_directions(48 * 64, seed), 0.01, seed))
        for seed in range(300):
            each.update(samples_of(light, wall, 0.01, 10 + seed))
    assert estimator.estimate().valid
    errors = [
        degrees_between(each.estimate().sh[[3, 1, 2]] @ [0.2126, 0.7152, 0.0722], (1, 0.5, 0))
        for each in (estimator, thesis)
    ]
    assert errors[0] < 6.0
    assert errors[1] > 30.0


def test_light_is_not_negative() -> None:
    """A plane and a half see only part of the sky: what fits them best is negative elsewhere."""
    normals = random_directions(48 * 64, 7)
    normals[:, 1] = np.abs(normals[:, 1])
    normals[:, 2] = -np.abs(normals[:, 2])
    light = lights.lobe((0.3, 0.4, -1))
    estimate = LightEstimator(4).update(samples_of(light, normals, 0.02))
    radiance = lights.sh_basis(random_directions(2000, 8), 4) @ estimate.sh
    assert radiance.min() > -0.02 * radiance.max()


def test_thesis_mode_is_plain_white_least_squares() -> None:
    normals = random_directions(48 * 64, 9)
    light = lights.lobe_and_sky(TOWARD)[:9]
    estimate = LightEstimator(3, as_thesis=True).update(samples_of(light, normals, 0.05))
    transfer = open_transfer(normals, 3)
    noise = 0.05 * np.random.default_rng(0).normal(size=(48 * 64, 3))
    luminance = (ASSUMED_ALBEDO * transfer @ light + noise) @ [0.2126, 0.7152, 0.0722]
    best = np.linalg.lstsq(transfer, luminance, rcond=None)[0] / ASSUMED_ALBEDO
    np.testing.assert_allclose(estimate.sh, np.tile(best[:, None], 3), rtol=1e-6, atol=1e-9)


def test_dependent_samples_do_not_count_as_many() -> None:
    """One error a tile instead of one a sample: 64 times fewer independent samples, 8 times the spread."""
    normals = random_directions(48 * 64, 10)
    light, shape = LIGHT[:9], (48, 64)
    transfer = open_transfer(normals, 3).reshape(*shape, 9)
    random = np.random.default_rng(11)
    independent, shared = random.normal(size=shape), np.kron(random.normal(size=(6, 8)), np.ones((8, 8)))
    stds = []
    for error in (independent, shared):
        observed = np.insert(ASSUMED_ALBEDO * transfer @ light + 0.05 * error[..., None], 3, 1, -1)
        sums = unpack_tiles(twin.accumulate_tiles(transfer, observed), 9)
        estimate = LightEstimator(3).update(sums)
        assert estimate.std is not None
        stds.append(estimate.std[0])
    # The mean of the sky sees all of the shared error; with 48 tiles the factor is known to a third.
    assert (stds[1] / stds[0]).mean() == pytest.approx(8, rel=0.7)


def test_spread_of_the_direction() -> None:
    estimator = LightEstimator(4)
    spreads = []
    for noise in (0.003, 0.3):
        luminance = estimator._solve_luminance  # of one frame
        sums = samples_of(LIGHT, random_directions(48 * 64, 12), noise)
        estimator.update(sums)
        spreads.append(direction_spread_rad(luminance(sums.total())))
    assert 0 < spreads[0] < np.deg2rad(1) < spreads[1] < np.pi


def test_without_memory_only_the_newest_frame_counts(engine: Engine) -> None:
    """P3: the thesis's moving average is a switch."""
    one, other = (sum_tiles(engine, *random_frame(97, 131, 2, seed=seed).upload(engine), VOXEL_M) for seed in (1, 2))
    forgetful, fresh, plain = LightEstimator(4, memory=False), LightEstimator(4), LightEstimator(4)
    forgetful.update(one)
    plain.update(one)
    found, expected = forgetful.update(other), fresh.update(other)
    np.testing.assert_allclose(found.sh, expected.sh, rtol=1e-9)
    assert not np.allclose(plain.update(other).sh, expected.sh, rtol=1e-3)


def test_dark_corners_count_if_they_are_asked_to(engine: Engine) -> None:
    frame = random_frame(97, 131, 2).upload(engine)
    counts = [sum_tiles(engine, *frame, VOXEL_M, least).total().count for least in (0.0, LEAST_OPENNESS, 0.5)]
    assert counts[0] > counts[1] > counts[2]


def test_where_nothing_is_flat_the_flattest_samples_are_used() -> None:
    """As on a single unfused depth map; holes do not count, and where enough is flat nothing else is used."""
    rough = np.zeros((40, 50), np.float32)
    rough[:20] = np.linspace(0.2, 0.8, 1000, dtype=np.float32).reshape(20, 50)
    assert flatness_gate(rough) == pytest.approx(0.74, abs=0.001)
    assert (rough >= flatness_gate(rough)).sum() == pytest.approx(LEAST_FLAT_SHARE * 1000, abs=2)
    rough[:3] = 1.0
    assert flatness_gate(rough) == LEAST_FLATNESS
    assert flatness_gate(np.zeros((4, 4), np.float32)) == LEAST_FLATNESS
