"""Transfer to cells and its normal equations against the float64 twin, and what both must be on simple surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from server.light.cell_transfer import MOST_POOLS, POOL_PX, PoolWindow, cells_of, pool_grid
from server.light.continuation import LEAST_M, NO_PLANES, SPOKES, spokes
from server.maths.lobes import CELLS, cell_directions
from server.maths.planes import CELL_M
from server.opencl.engine import Engine
from server.transfer.radiance_transfer import Transfer, direction_sets, own_sets
from tests.reference import cell_transfer as twin
from tests.scenes.analytic import Floats
from tests.scenes.pool_samples import SLOTS, UNSEEN, Samples

NO_SETS = Transfer(1, 1, 1, 2, *[None] * 4)  # type: ignore[arg-type]


def assert_twins(engine: Engine, samples: Samples, step: int, *, own: bool = False) -> None:
    """All that a pool says, to the rounding of float32 sums over up to 256 samples of 81 directions."""
    pools, window = samples.pool(engine, step, own=own)
    expected = samples.twin(step)
    count = expected.weights.size
    assert 0 < (expected.weights > 0).sum() < count  # one middle is not usable
    values = engine.download(window.raw)
    np.testing.assert_allclose(values[1, :count], expected.transfer.reshape(count, -1), atol=2e-5)
    assert (values[[0, 2]] == -1).all()  # other slots are left alone
    for name in ("seen", "sent", "unseen", "weights"):
        wanted = getattr(expected, name)
        np.testing.assert_allclose(
            getattr(pools, name), wanted.reshape(count, *wanted.shape[2:]), atol=5e-5, err_msg=name
        )
    np.testing.assert_allclose(pools.normals, expected.facing.reshape(count, 3), atol=1e-5)
    np.testing.assert_allclose(pools.positions, expected.positions.reshape(count, 3), atol=1e-6)


@pytest.mark.parametrize(
    ("rows", "cols", "rays", "step"), [(24, 40, 33, 8), (17, 9, 81, 8), (8, 9, 32, 2), (9, 7, 81, 3)]
)
@pytest.mark.parametrize("stride", [1, 4])
def test_pools_match_twin(engine: Engine, rows: int, cols: int, rays: int, step: int, stride: int) -> None:
    samples = Samples.random(rows, cols, direction_sets(rays, 2), step)
    assert_twins(engine, replace(samples, stride=stride), step)


@pytest.mark.parametrize("interleave", [2, 4])
def test_pools_of_sets_that_are_put_together_match_twin(engine: Engine, interleave: int) -> None:
    """Each subset of the directions from a set of its own, as frames before traced them."""
    assert_twins(engine, Samples.random(16, 24, direction_sets(84, 2, interleave)), 8)


def test_samples_without_sets_have_their_own(engine: Engine) -> None:
    samples = Samples.random(16, 24, direction_sets(33, 2))
    samples.sets = engine.download(own_sets(engine, 16, 24)).astype(int)
    assert_twins(engine, samples, 8, own=True)


def test_open_surface_has_no_sampling_error(engine: Engine) -> None:
    """The cells of an open sky add up to 1, and to the clamped cosine about the normal; nothing is sent."""
    samples = Samples.random(16, 16, direction_sets(32, 2), hidden=-1.0)
    samples.hits[:] = 0
    pools, window = samples.pool(engine, 8)
    used = pools.weights > 0
    transfer = engine.download(window.raw)[1, : len(used)][used].astype(float)
    np.testing.assert_allclose(transfer.sum(axis=1), 1, atol=1e-5)
    center = transfer @ cell_directions()
    assert np.linalg.norm(center, axis=1) == pytest.approx(2 / 3, abs=0.01)  # of the cosine lobe
    assert (center * pools.normals[used]).sum(axis=1) == pytest.approx(2 / 3, abs=0.01)
    assert np.abs(pools.sent).max() < 1e-5
    assert np.abs(pools.unseen).max() < 1e-5


@pytest.mark.parametrize("known", [0.0, 0.25, 1.0, 1.5])
def test_hidden_sky_sends_what_was_seen_there(engine: Engine, known: float) -> None:
    """Of an even radiance for the part of the hidden cosine that met coloured surface, and what is put for the rest.

    More than all of it, as sampling every few directions may find, counts as all.
    """
    samples = Samples.random(16, 16, direction_sets(81, 2))
    sent = np.array([0.5, 0.25, 0.125])
    cosine = np.einsum("rcjk,rck->rcj", samples.directions, samples.normal)
    hidden = np.where(samples.free, 0, np.where(cosine < 0.05, 0, cosine)).sum(axis=-1)
    samples.hits = known * hidden[..., None] * np.append(sent, 1.0)
    pools, window = samples.pool(engine, 8)
    used = pools.weights > 0
    dark = 1 - engine.download(window.raw)[1, : len(used)][used].sum(axis=1, dtype=float)
    assert dark == pytest.approx(0.5, abs=0.1)
    share = min(known, 1.0)
    np.testing.assert_allclose(
        pools.sent[used], dark[:, None] * (share * sent + (1 - share) * UNSEEN), rtol=0.02, atol=1e-5
    )
    np.testing.assert_allclose(pools.unseen[used], dark * (1 - share), atol=0.02 * dark.max())


@pytest.mark.parametrize(("apart", "mixed"), [(0.08, True), (0.2, False)])
def test_pools_are_of_one_colour(engine: Engine, apart: float, mixed: bool) -> None:
    """On a chequered wall a pool holds its middle's colour alone, unless the colours differ by as little as shading."""
    samples = Samples.random(16, 16, direction_sets(32, 2))
    dark = (np.indices((16, 16)).sum(axis=0) % 2 == 1)[..., None]
    paint = np.where(dark, np.array([0.5, 0.5, 0.5 * (1 - apart)]), 0.5)  # they differ in one channel
    samples.observed = np.concatenate([paint, np.ones((16, 16, 1))], -1)
    pools, _ = samples.pool(engine, 8)
    assert pools.seen[:, 2] == pytest.approx(0.5 * (1 - apart / 2) if mixed else 0.5, abs=1e-3)
    everything, _ = replace(samples, observed=np.full((16, 16, 4), (0.5, 0.5, 0.5, 1.0))).pool(engine, 8)
    np.testing.assert_allclose(pools.weights, everything.weights * (1.0 if mixed else 0.5), rtol=0.02)


@pytest.mark.parametrize(
    ("height", "width", "stride"), [(480, 640, 1), (480, 640, 4), (240, 320, 8), (120, 160, 4), (9, 7, 1)]
)
def test_pools_lie_apart_and_are_not_too_many(height: int, width: int, stride: int) -> None:
    transfer = replace(NO_SETS, stride=stride, rows=height // stride, cols=width // stride)
    grid = pool_grid(transfer)
    assert grid.step >= 2
    assert grid.step * stride >= POOL_PX
    assert grid.count <= 1.1 * MOST_POOLS  # and those that are cut by an edge
    assert (grid.rows - 1) * grid.step < transfer.rows <= grid.rows * grid.step
    assert (grid.cols - 1) * grid.step < transfer.cols <= grid.cols * grid.step


def filled_window(engine: Engine, rows: int, cols: int) -> tuple[PoolWindow, Floats]:
    """A window of random transfer, and that transfer [slots, n, CELLS]."""
    window = PoolWindow(engine, rows * cols, SLOTS)
    values = np.random.default_rng(0).random((SLOTS, rows * cols, CELLS)).astype(np.float32)
    window.values.set(values)
    return window, values.astype(np.float64)


@pytest.mark.parametrize("shape", [(5, 7), (40, 33)])
@pytest.mark.parametrize("columns", [1, 4, 8])
def test_sums_match_numpy(engine: Engine, shape: tuple[int, int], columns: int) -> None:
    window, values = filled_window(engine, *shape)
    rng = np.random.default_rng(1)
    count = values.shape[0] * values.shape[1]
    weights = np.where(rng.random(count) < 0.3, 0, rng.random(count))
    targets = rng.normal(size=(count, columns))
    found = window.equations(targets, weights)
    m = values.reshape(count, CELLS)
    assert len(found) == columns
    for k, equations in enumerate(found):
        y = targets[:, k]
        np.testing.assert_allclose(equations.matrix, m.T @ (weights[:, None] * m), rtol=1e-4)
        np.testing.assert_allclose(equations.vector, m.T @ (weights * y), rtol=1e-4, atol=1e-4 * weights.sum())
        assert equations.energy == pytest.approx(weights @ y**2, rel=1e-6)
    again = window.equations(targets, weights)
    for one, other in zip(found, again, strict=True):
        np.testing.assert_array_equal(one.matrix, other.matrix)  # summed in the same order
        np.testing.assert_array_equal(one.vector, other.vector)


def test_pools_that_weigh_nothing_say_nothing(engine: Engine) -> None:
    """Even if there is rubbish in their place, as in slots that no frame has filled yet."""
    window, values = filled_window(engine, 5, 7)
    rubbish = values.astype(np.float32)
    rubbish[2] = np.nan
    window.values.set(rubbish)
    weights, targets = np.ones(3 * 35), np.ones((3 * 35, 2))
    weights[70:] = 0
    found = window.equations(targets, weights)[1]
    m = values[:2].reshape(70, CELLS)
    np.testing.assert_allclose(found.matrix, m.T @ m, rtol=1e-4)
    np.testing.assert_allclose(found.vector, m.sum(axis=0), rtol=1e-4)


@pytest.mark.parametrize("lobes", [1, 8, 24, 51])
@pytest.mark.parametrize("slot", [0, 2])
def test_shading_under_lobes_matches_numpy(engine: Engine, lobes: int, slot: int) -> None:
    window, values = filled_window(engine, 7, 11)
    light = np.random.default_rng(2).random((CELLS, lobes))
    shading = window.shading(slot, light)
    assert shading.shape == (77, lobes)
    np.testing.assert_allclose(shading, values[slot] @ light, rtol=1e-4)


def test_pools_are_taken_from_any_slot(engine: Engine) -> None:
    window = PoolWindow(engine, 77, 3)
    raw = np.random.default_rng(4).random((3, 77, CELLS)).astype(np.float32)
    window.raw.set(raw)
    slots, places = np.array([2, 0, 1, 2, 2]), np.array([76, 0, 5, 0, 76])
    np.testing.assert_array_equal(window.raw_of(slots, places), raw[slots, places])


def test_cells_are_the_nearest() -> None:
    rays = direction_sets(81, 2)
    cells = cells_of(rays.directions.tobytes(), rays.count)
    assert cells.shape == rays.directions.shape[:2]
    chosen = (rays.directions[..., :3] * cell_directions()[cells]).sum(axis=-1)
    assert np.degrees(np.arccos(chosen.min())) < 11  # of which the next cell is nearer than twice that
    assert len(np.unique(cells)) == CELLS


def test_continued_planes_hide_what_the_twin_says(engine: Engine) -> None:
    """Two planes across, with holes where a camera looked through; other slots are left alone."""
    samples = Samples.random(24, 40, direction_sets(33, 2))
    pools, window = samples.pool(engine, 8)
    rng = np.random.default_rng(4)
    turned = [np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2)]
    planes = np.array(
        [
            [[*turn[0], 0.4], [*turn[1], -1.0], [*turn[2], -1.5], [0.1, 1.8, 0.3, 2.9]]
            for turn in (turned[0], turned[1])
        ]
    ).astype(np.float32)  # fmt: skip
    maps = [rng.random(size) < 0.8 for size in ((60, 40), (66, 44))]
    shapes = np.array([[40, 60, 0, 0], [44, 66, 2400, 0]], np.int32)
    window.values.fill(-1.0)
    window.hide([1], (planes, shapes, np.concatenate([m.ravel() for m in maps]).astype(np.uint8)))
    met = twin.met_planes(pools.positions, spokes().reshape(-1, 3), planes.astype(float), maps, CELL_M, LEAST_M)
    raw, values = engine.download(window.raw)[1], engine.download(window.values)
    used = pools.weights > 0
    shares = met.reshape(-1, CELLS, SPOKES).mean(axis=2)
    assert 0.05 < shares[used].mean() < 0.95
    off = np.abs(values[1, : len(used)] - raw[: len(used)] * (1 - shares))[used]
    assert (off > 1e-6).mean() < 0.005  # rays along the edge of a cell or of a plane
    assert (values[[0, 2]] == -1).all()


def test_without_planes_nothing_more_is_hidden(engine: Engine) -> None:
    _, window = Samples.random(24, 40, direction_sets(33, 2)).pool(engine, 8)
    window.hide([1], NO_PLANES)
    np.testing.assert_array_equal(engine.download(window.values)[1], engine.download(window.raw)[1])
