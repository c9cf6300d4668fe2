"""In which parts of the picture a ratio counts: against the float64 twin, and that it is left out nowhere else."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.engine import Engine
from server.shading.change_mask import mark_changes
from server.transfer.sample_grid import SampleGrid
from server.transfer.sampling import Upsampling
from tests.reference import change_mask as twin
from tests.reference import composite as pixels
from tests.reference.composite import Buffer, Floats, Samples, cells_of
from tests.scenes.solids import float4, upload_surface

HEIGHT, WIDTH = 44, 60
CAMERA = CameraModel(width=WIDTH, height=HEIGHT, fx=60.0, fy=60.0, cx=29.5, cy=21.5)
TOLERANCE_M, SPARE = 0.02, 0.004
SPACING_M = 0.004


def surface(kind: str) -> Buffer:
    """One plane; two at a step and an angle; one that no two pixels agree on, with holes."""
    random = np.random.default_rng(4)
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    points = np.stack([SPACING_M * u, SPACING_M * v, 0 * u], axis=-1)
    normals = np.zeros_like(points)
    normals[..., 2] = 1
    there = np.ones((HEIGHT, WIDTH))
    if kind == "broken":
        right, low = u > 31, v > 25
        points[right, 2] += 0.03
        normals[low] = [0, 0.8, 0.6]
    if kind == "rough":
        normals += random.normal(0, 0.04, normals.shape)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        points += random.normal(0, 0.002, points.shape)
        there = (random.random(there.shape) < 0.9).astype(float)
    positions, normals = (
        np.where(there[..., None] > 0, np.insert(a, 3, 1, -1), 0).astype(np.float32).astype(float)
        for a in (points, normals)
    )
    return Buffer(positions, normals, np.zeros_like(points))


def ratios(stride: int, real: Buffer) -> Samples:
    """Much on the left, next to nothing in the middle, now and then one that is far off on the right."""
    random = np.random.default_rng(5)
    rows, cols = HEIGHT // stride, WIDTH // stride
    values = np.ones((rows, cols, 4))
    along = np.linspace(0, 1, cols)
    values[..., 1] -= np.where(along < 0.3, 0.1, np.where(along < 0.6, 0.8 * SPARE, 0.0)) * random.random((rows, cols))
    values[..., 2] += np.where(along > 0.6, random.choice([0.0, 0.02, -0.03], (rows, cols), p=[0.86, 0.07, 0.07]), 0)
    values[..., 3] = real.positions[stride // 2 :: stride, stride // 2 :: stride, 3][:rows, :cols]
    return Samples(stride, values.astype(np.float32).astype(float))


def found(
    engine: Engine,
    ratio: Samples,
    real: Buffer,
    spare: float = SPARE,
    refined: NDArray[np.bool_] | None = None,
    upsampling: Upsampling = "bilateral",
) -> NDArray[np.bool_]:
    space = engine.workspace
    own = None if refined is None else space.upload("test_refined", float4(np.ones((*refined.shape, 3)), refined))
    values = space.upload("test_ratio", float4(ratio.values[..., :3], ratio.values[..., 3]))
    device = upload_surface(engine, real.positions[..., :3], real.normals[..., :3], real.positions[..., 3] > 0)
    grid = SampleGrid(ratio.stride, values)
    cells = mark_changes(engine, CAMERA, device, grid, own, TOLERANCE_M, spare, upsampling)
    return np.asarray(engine.download(cells) > 0)


@pytest.mark.parametrize("stride", [1, 4, 8])
@pytest.mark.parametrize("kind", ["plane", "broken", "rough"])
def test_reached_cells_are_the_twins(engine: Engine, kind: str, stride: int) -> None:
    real = surface(kind)
    ratio = ratios(stride, real)
    expected = twin.mark_changes(ratio, real, TOLERANCE_M, SPARE)
    assert 0.1 < expected.mean() < (0.9 if kind == "plane" else 1.1)
    # Rounding decides where a bound is met just so: hardly anywhere.
    assert (found(engine, ratio, real) != expected).mean() < 0.005


@pytest.mark.parametrize("upsampling", ["bilateral", "bicubic"])
@pytest.mark.parametrize("kind", ["plane", "broken", "rough"])
def test_nowhere_else_does_a_pixel_change_by_more_than_is_spared(
    engine: Engine, kind: str, upsampling: Upsampling
) -> None:
    real = surface(kind)
    ratio = ratios(4, real)
    cells = found(engine, ratio, real, upsampling=upsampling)
    rows, cols = cells_of(HEIGHT, 4), cells_of(WIDTH, 4)
    changes = np.zeros((HEIGHT, WIDTH))
    for y, x in np.ndindex(HEIGHT, WIDTH):
        if real.positions[y, x, 3] > 0:
            is_bicubic = upsampling == "bicubic"
            mean = (
                pixels.upsample_bicubic(ratio, x, y) if is_bicubic else pixels.upsample(ratio, real, x, y, TOLERANCE_M)
            )
            changes[y, x] = np.abs(mean[:3] - 1).max() if mean[3] > 0 else 0.0
    counts = cells[rows + 1][:, cols + 1]
    assert changes[~counts].max() <= SPARE * (1 + 1e-4)
    assert (changes[~counts] > 0).any()  # something is left out
    if kind == "plane" and upsampling == "bilateral":  # and nearly all of what may be
        assert (changes[counts] > SPARE).mean() > 0.4


@pytest.mark.parametrize("shape", [(11, 15), (1, 1), (5, 40)])
def test_where_nothing_is_spared_all_that_is_not_one_counts(engine: Engine, shape: tuple[int, int]) -> None:
    """The 6 x 6 samples around a cell, which begins at sample (row - 1, col - 1), hold one that is valid and not 1."""
    random = np.random.default_rng(3)
    values = np.ones((*shape, 4))
    values[..., 1] = random.choice([1.0, 0.9], shape, p=[0.97, 0.03])
    values[..., 3] = random.random(shape) < 0.9
    changed = (values[..., 3] > 0) & (values[..., 1] != 1)
    expected = [
        [changed[max(r - 3, 0) : r + 3, max(c - 3, 0) : c + 3].any() for c in range(shape[1] + 1)]
        for r in range(shape[0] + 1)
    ]
    cells = found(engine, Samples(1, values), surface("plane"), spare=0.0)
    np.testing.assert_array_equal(cells, expected)


def test_refined_pixels_count_where_anything_changes(engine: Engine) -> None:
    real = surface("plane")
    ratio = ratios(4, real)
    refined = np.zeros((HEIGHT, WIDTH), bool)
    refined[20, ::6] = True
    expected = twin.mark_changes(ratio, real, TOLERANCE_M, SPARE, refined)
    cells = found(engine, ratio, real, refined=refined)
    np.testing.assert_array_equal(cells, expected)
    assert cells.sum() > found(engine, ratio, real).sum()
    ones = Samples(4, np.ones_like(ratio.values))
    assert not found(engine, ones, real, refined=refined).any()


def test_a_step_in_the_surface_is_no_plane(engine: Engine) -> None:
    """One sample far off is thinned out by its neighbours on a plane; alone on its surface it is all there is."""
    values = np.ones((HEIGHT // 4, WIDTH // 4, 4))
    values[5, 7, :3] = 1 - 10 * SPARE
    flat, stepped = surface("plane"), surface("plane")
    x, y = 4 * 7 + 2, 4 * 5 + 2
    stepped.positions[y - 1 : y + 2, x - 1 : x + 2, 2] += 1.0
    assert not found(engine, Samples(4, values), flat).any()
    cells: Floats = found(engine, Samples(4, values), stepped)
    assert cells[6, 8]
    assert not cells[0].any()
