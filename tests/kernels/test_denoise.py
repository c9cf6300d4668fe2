"""Lightness, TV-L1 and the bilateral filter against their float64 twins, against OpenCV, and at their limits."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
import pytest
from numpy.typing import NDArray

from server.input import denoise
from server.input.measure import Measurement
from server.opencl.engine import Engine
from tests.reference import denoise as twin
from tests.scenes.tolerance import relative_tolerance
from tests.scenes.tv_l1_depth import tv_l1_depth
from tests.scenes.volumes import vectors

SIZES = [(8, 8), (16, 9), (23, 41), (97, 71), (160, 130)]
METHODS = ["bilateral", "tv_l1"]
DEPTH_REACH = (8 * 0.0012, 8 * 0.0019, 0.4)


def picture(size: tuple[int, int], seed: int = 1) -> NDArray[np.float32]:
    """[h, w] in [0, 1]: areas with edges between them, noise, and salt and pepper."""
    rng = np.random.default_rng(seed)
    width, height = size
    areas = cv2.resize(rng.uniform(0.1, 0.9, (5, 5)), size, interpolation=cv2.INTER_NEAREST)
    image = areas + rng.normal(0, 0.03, (height, width))
    image[rng.random(image.shape) < 0.03] = 1
    return np.clip(image, 0, 1).astype(np.float32)


def upload(engine: Engine, values: NDArray[Any]) -> cl_array.Array:
    return engine.workspace.upload("image", values.astype(np.float32))


def radiance_of(engine: Engine, values: NDArray[Any]) -> cl_array.Array:
    """[h, w, 4] as an array of float4."""
    packed = np.ascontiguousarray(values, np.float32).view(cl_types.float4)[..., 0]  # type: ignore[attr-defined]
    return engine.workspace.upload("radiance", packed)


def random_radiance(size: tuple[int, int], seed: int = 3) -> NDArray[np.float32]:
    """[h, w, 4] of every mark, down to the darkest that is usable."""
    rng = np.random.default_rng(seed)
    radiance = rng.uniform(0, 1, (size[1], size[0], 4)) ** 3
    radiance[..., 3] = rng.choice([-1, 0, 1, 1, 1], size[::-1])
    radiance[0, :4] = [[1, 1, 1, 1], [0, 0, 0.0016, 1], [0.0088565, 0.0088565, 0.0088565, 1], [0, 0, 0, 0]]
    return radiance.astype(np.float32)


@pytest.mark.parametrize("size", SIZES)
def test_lightness_and_back_match_twin(engine: Engine, size: tuple[int, int]) -> None:
    values = random_radiance(size)
    radiance = radiance_of(engine, values)
    lightness = denoise.measure_lightness(engine, radiance)
    expected = twin.measure_lightness(values.astype(np.float64))
    rounding = relative_tolerance(engine.device)
    np.testing.assert_allclose(engine.download(lightness), expected, rtol=rounding, atol=0.2 * rounding)
    wanted = np.clip(expected + 0.1, 0, 1).astype(np.float32)
    relit = vectors(engine.download(denoise.relight(engine, radiance, upload(engine, wanted))))
    # The lightness of a dark colour is a small part of root - 0.16, which rounds as the root does.
    np.testing.assert_allclose(relit, twin.relight(values.astype(np.float64), wanted), rtol=10 * rounding)
    same = vectors(engine.download(denoise.relight(engine, radiance, lightness)))
    np.testing.assert_allclose(same, values, rtol=1e-3 if engine.device.is_gpu else 3e-4)


@pytest.mark.parametrize("count", [8, 9, 15, 16, 20])
def test_nothing_is_written_after_the_last_pixel(engine: Engine, count: int) -> None:
    radiance = radiance_of(engine, np.ones((4, 10, 4)))
    for name, dtype in (("measure_lightness", np.float32), ("relight", cl_types.float4)):
        out = engine.workspace.upload(name, np.full(160, 7, np.float32).view(dtype))
        inputs = (radiance,) if name == "measure_lightness" else (radiance, upload(engine, np.ones((4, 10))))
        engine.launch(engine.kernel("denoise.cl", name), (-(-count // 8),), count, *inputs, out)
        written = engine.download(out).view(np.float32) != 7
        assert written.sum() == written.argmin() == count * np.dtype(dtype).itemsize // 4


def test_lightness_is_opencvs(engine: Engine) -> None:
    values = random_radiance((64, 64))
    lab = cv2.cvtColor(values[..., :3], cv2.COLOR_LRGB2Lab)[..., 0] / 100
    usable = values[..., 3] > 0
    found = engine.download(denoise.measure_lightness(engine, radiance_of(engine, values)))
    assert np.abs(found - lab)[usable].max() < 3e-4  # OpenCV's is from tables; seen: 8e-5
    assert (found[~usable] == -1).all()


@pytest.mark.parametrize("strips", [True, False])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("iterations", [0, 1, 5, 6, 7, 20])
def test_tv_l1_matches_twin(engine: Engine, size: tuple[int, int], iterations: int, strips: bool) -> None:
    image = picture(size)
    image[np.random.default_rng(2).random(image.shape) < 0.1] = -1
    for edge in (np.inf, 0.1):
        found = denoise.tv_l1(engine, upload(engine, image), iterations, 1.0, -1.0, edge=edge, strips=strips)
        expected = twin.tv_l1(image.astype(np.float64), iterations, 1.0, -1.0, denoise.PRIMAL_STEP, edge)
        # A step adds the rounding of numbers up to 12.5, the dual step, scaled by 0.01: 1e-6 in the first 20.
        np.testing.assert_allclose(engine.download(found), expected, rtol=0, atol=relative_tolerance(engine.device))


def test_tv_l1_in_strips_of_any_height_is_the_same(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also with fewer rows than iterations in a pass, where a strip reads rows beyond its neighbours; and with so many
    strips that several threads work on them, none of which may read values that another one writes."""
    image = upload(engine, picture((41, 667)))
    expected = engine.download(denoise.tv_l1(engine, image, 13, 0.8, strips=False))
    monkeypatch.setattr(denoise, "_STRIPS_PER_CORE", 1000)
    for rows in (1, 3, 16, 333, 666, 667, 1000):
        monkeypatch.setattr(denoise, "_LEAST_STRIP_ROWS", rows)
        found = engine.download(denoise.tv_l1(engine, image, 13, 0.8, strips=True))
        np.testing.assert_allclose(found, expected, rtol=0, atol=relative_tolerance(engine.device))


@pytest.mark.parametrize("weight", [0.5, 1.0, 1.5])
def test_tv_l1_leaves_less_energy_than_opencv(engine: Engine, weight: float) -> None:
    """After the same number of iterations, since the energy of OpenCV's scheme rises in the first hundred."""
    image = np.rint(255 * picture((160, 130)))
    f = image / 255
    for iterations in (5, 10, 30, 100):
        theirs = np.empty(image.shape, np.uint8)
        cv2.denoise_TVL1([image.astype(np.uint8)], theirs, weight, iterations)
        ours = engine.download(denoise.tv_l1(engine, upload(engine, f), iterations, weight)).astype(np.float64)
        rounded = np.rint(ours * 255) / 255
        assert twin.energy(rounded, f, weight) < twin.energy(theirs / 255, f, weight)
        assert twin.energy(ours, f, weight) < twin.energy(f, f, weight)


def test_tv_l1_goes_to_the_least_energy(engine: Engine) -> None:
    """After 300 iterations within 0.1 % of what 6000 in float64 reach; and the step changes the way, not the end."""
    image = picture((40, 40))
    least = twin.energy(twin.tv_l1(image.astype(np.float64), 6000, 0.9, -1, 0.02), image, 0.9)
    for contrast in (0.5, 1.0, 2.0):
        found = engine.download(denoise.tv_l1(engine, upload(engine, image), 300, 0.9, contrast=contrast))
        assert twin.energy(found.astype(np.float64), image, 0.9) < 1.001 * least


def test_tv_l1_removes_specks_and_keeps_edges(engine: Engine) -> None:
    image = np.zeros((48, 48))
    image[:, 24:] = 0.8
    specks = np.random.default_rng(4).random(image.shape) < 0.05
    found = engine.download(denoise.tv_l1(engine, upload(engine, np.where(specks, 0.4, image)), 200, 1.0))
    assert np.abs(found - image).mean() < 5e-4  # seen: 1.3e-4
    assert np.percentile(np.abs(found - image), 99) < 1e-4  # seen: 1e-8


@pytest.mark.parametrize("strips", [True, False])
def test_tv_l1_does_not_spread_across_what_is_unknown(engine: Engine, strips: bool) -> None:
    """Two halves beside an unknown column: each is filtered as if alone, and the column is unchanged."""
    image = picture((33, 30))
    image[:, 16] = -1
    both = engine.download(denoise.tv_l1(engine, upload(engine, image), 30, 0.7, 0.0, strips=strips)).copy()
    assert (both[:, 16] == -1).all()
    for part in (slice(0, 16), slice(17, 33)):
        alone = denoise.tv_l1(engine, upload(engine, image[:, part].copy()), 30, 0.7, 0.0, strips=strips)
        np.testing.assert_allclose(engine.download(alone), both[:, part], atol=1e-6)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("none", [0.0, -1.0])
def test_bilateral_matches_twin(engine: Engine, size: tuple[int, int], none: float) -> None:
    image = picture(size) + 0.5
    image[np.random.default_rng(5).random(image.shape) < 0.1] = none
    for reach in ((0.08, 0.0, 0.0), DEPTH_REACH):
        found = engine.download(denoise.bilateral(engine, upload(engine, image), reach, none))
        expected = twin.bilateral(image.astype(np.float64), reach, none)
        np.testing.assert_allclose(found, expected, rtol=relative_tolerance(engine.device))


def test_bilateral_keeps_an_edge_exactly_and_halves_noise(engine: Engine) -> None:
    rng = np.random.default_rng(6)
    for near_m, far_m in ((3.0, 3.15), (1.0, 1.1)):
        exact = np.where(np.arange(64) < 32, near_m, far_m) * np.ones((48, 1))
        found = engine.download(denoise.bilateral_depth(engine, upload(engine, exact)))
        np.testing.assert_allclose(found, exact, rtol=1e-6)
    noisy = exact + rng.normal(0, 0.002, exact.shape)
    found = engine.download(denoise.bilateral_depth(engine, upload(engine, noisy)))
    assert np.abs(found - exact).max() < 0.004  # seen: 0.0014, of noise of 0.002
    assert (found - exact).std() < 0.5 * (noisy - exact).std()


@pytest.mark.parametrize("smooth", [denoise.bilateral_depth, tv_l1_depth])
def test_no_depth_stays_none_and_gives_nothing(engine: Engine, smooth: Any) -> None:
    rng = np.random.default_rng(7)
    exact = rng.uniform(0.4, 9.9, (30, 50))
    exact[rng.random(exact.shape) < 0.5] = 0
    found = engine.download(smooth(engine, upload(engine, exact)))
    np.testing.assert_array_equal(found == 0, exact == 0)
    assert (found[exact > 0] > 0.3).all()
    near = np.where(exact > 0, 0.004, 0)  # nearer than the noise is wide
    np.testing.assert_allclose(engine.download(smooth(engine, upload(engine, near))), near, rtol=1e-5)
    lone = np.zeros((30, 50))
    lone[10, 20] = 2.0
    np.testing.assert_allclose(engine.download(smooth(engine, upload(engine, lone))), lone, rtol=1e-6)
    assert not engine.download(smooth(engine, upload(engine, np.zeros((30, 50))))).any()


@pytest.mark.parametrize("smooth", [denoise.bilateral_depth, tv_l1_depth])
@pytest.mark.parametrize("metres", [1e-6, 1e-3, 10.0, 1.7e7])
def test_extreme_depth_stays_finite(engine: Engine, smooth: Any, metres: float) -> None:
    depth = np.full((30, 50), metres)
    depth[::3, ::3] = 0
    depth[1::5, 1::5] = 1.0
    found = engine.download(smooth(engine, upload(engine, depth)))
    assert np.isfinite(found).all()
    assert found.max() <= max(metres, 1.0) * 1.001


@pytest.mark.parametrize("method", METHODS)
def test_denoised_radiance(engine: Engine, method: Any) -> None:
    """Noise of lightness is more than halved in flat areas; ratios of colours, marks and unusable pixels are kept."""
    rng = np.random.default_rng(8)
    exact = np.where(np.arange(80) < 40, 0.2, 0.6)[:, None] * np.array([1.0, 0.7, 0.4]) * np.ones((60, 1, 1))
    values = np.concatenate([exact * rng.normal(1, 0.05, (60, 80, 1)), np.ones((60, 80, 1))], -1).astype(np.float32)
    values[20:24, 10:14] = (1, 1, 1, 0)
    values[0, :5] = (0, 0, 0, -1)
    radiance = radiance_of(engine, values)
    measurement = Measurement(radiance, radiance)
    assert denoise.denoise_radiance(engine, measurement, "none") is radiance
    found = vectors(engine.download(denoise.denoise_radiance(engine, measurement, method, 20)))
    usable = values[..., 3] > 0
    np.testing.assert_array_equal(found[~usable], values[~usable])
    np.testing.assert_array_equal(found[..., 3], values[..., 3])
    np.testing.assert_allclose(found[usable, 1] / found[usable, 0], 0.7, rtol=1e-5)
    off, was_off = (np.abs(v[..., 0] - exact[..., 0])[usable] for v in (found, values))
    assert off.mean() < 0.5 * was_off.mean()
    inner = np.zeros_like(usable)
    inner[30:, 4:36] = True
    assert np.abs(found[..., 0].mean(where=inner) - 0.2) < 0.0015  # no bias; seen: 0.0004


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("rgb", "mark"), [(0.0, 0.0), (0.0, -1.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
def test_black_and_saturated_pictures_stay_as_they_are(engine: Engine, method: Any, rgb: float, mark: float) -> None:
    values = np.full((24, 40, 4), rgb, np.float32)
    values[..., 3] = mark
    radiance = radiance_of(engine, values)
    found = vectors(engine.download(denoise.denoise_radiance(engine, Measurement(radiance, radiance), method, 20)))
    np.testing.assert_allclose(found, values, rtol=1e-5, atol=1e-9)
