"""Distance grids against an exact float64 overlap test and SciPy's distance transform."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy import ndimage

from server.objects.virtual_object import VirtualObject
from server.objects.voxelize import (
    LEAST_CELLS,
    MARGIN_CELLS,
    MOST_CELLS,
    NEAR_CELLS,
    VoxelizeBuffers,
    place_grid,
    squared_distance,
)
from server.opencl.engine import Engine
from server.scene.mesh import Mesh
from tests.reference import voxelize as twin
from tests.scenes.meshes import mesh_of, public_mesh, shape_of, soup_of

MARGIN = 1e-4
"""The device's cells are larger by this on every side, so that rounding never loses one."""


@dataclass(frozen=True)
class Grid:
    """A mesh's grids on the host, [z, y, x], and its vertices in grid units."""

    distance: NDArray[np.float32]
    occupied: NDArray[np.bool_]
    vertices: NDArray[np.float64]
    triangles: NDArray[np.int64]

    @property
    def dims(self) -> tuple[int, ...]:
        """Cells in x, y, z."""
        return self.distance.shape[::-1]


def grid_of(engine: Engine, mesh: Mesh, cells: int) -> Grid:
    grid = VirtualObject.upload(engine, mesh, cells).grid
    matrix = grid.grid_from_model
    distance = engine.download(grid.distance)
    assert grid.dims == distance.shape[::-1]
    occupied = engine.download(engine.buffers(VoxelizeBuffers).occupied.array(distance.shape))
    vertices = mesh.vertices.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    return Grid(distance, occupied > 0, vertices, mesh.triangles.astype(np.int64))


def random_triangles(seed: int, count: int, size: float) -> Mesh:
    rng = np.random.default_rng(seed)
    return soup_of(rng.uniform(-1, 1, (count, 1, 3)) + size * rng.normal(size=(count, 3, 3)))


def slivers() -> Mesh:
    rng = np.random.default_rng(3)
    ends = rng.uniform(-1, 1, (60, 2, 3))
    middle = ends.mean(axis=1, keepdims=True) + rng.normal(size=(60, 1, 3)) * 1e-5
    return soup_of(np.concatenate([ends, middle], axis=1))


SHAPES: dict[str, Any] = {
    "triangles far larger than a cell": lambda: random_triangles(0, 12, 1.0),
    "triangles like cells": lambda: random_triangles(1, 400, 0.05),
    "triangles far smaller than a cell": lambda: random_triangles(2, 3000, 0.002),
    "slivers": slivers,
    "box": lambda: shape_of(trimesh.creation.box((1.0, 0.5, 0.25))),
    "flat": lambda: mesh_of([[0, 0, 0], [2, 0, 0], [2, 0, 1], [0, 0, 1]], [[0, 1, 2], [0, 2, 3]]),
    "needle": lambda: shape_of(trimesh.creation.cylinder(0.001, 2.0)),
    "one triangle": lambda: soup_of([[[5.0, 5.0, 5.0], [6.0, 5.2, 5.1], [5.1, 6.0, 5.4]]]),
    "torus": lambda: shape_of(trimesh.creation.torus(1.0, 0.3)),
}


def assert_touched_cells_are_marked(grid: Grid) -> None:
    """Every cell that a triangle touches, and none that is farther than the margin."""
    touched = twin.mark_cells(grid.vertices, grid.triangles, grid.dims, 0.5)
    reached = twin.mark_cells(grid.vertices, grid.triangles, grid.dims, 0.5 + 2 * MARGIN)
    assert not (touched & ~grid.occupied).any()
    assert not (grid.occupied & ~reached).any()


@pytest.mark.parametrize("cells", [LEAST_CELLS, 33])
@pytest.mark.parametrize("name", SHAPES)
def test_cells_are_those_that_triangles_touch(engine: Engine, name: str, cells: int) -> None:
    assert_touched_cells_are_marked(grid_of(engine, SHAPES[name](), cells))


@pytest.mark.parametrize("name", SHAPES)
def test_every_point_of_the_mesh_is_in_a_marked_cell(engine: Engine, name: str) -> None:
    grid = grid_of(engine, SHAPES[name](), 40)
    count = len(grid.triangles)
    shares = np.random.default_rng(0).dirichlet((1, 1, 1), (count, max(20000 // count, 8)))
    points = np.einsum("tsk,tkx->tsx", shares, grid.vertices[grid.triangles]).reshape(-1, 3)
    x, y, z = np.floor(points).astype(int).T
    assert grid.occupied[z, y, x].all()


@pytest.mark.parametrize("cells", [LEAST_CELLS, 31, 64])
@pytest.mark.parametrize("name", SHAPES)
def test_far_distances_are_the_exact_transform(engine: Engine, name: str, cells: int) -> None:
    grid = grid_of(engine, SHAPES[name](), cells)
    expected = ndimage.distance_transform_edt(~grid.occupied).astype(np.float32)
    far = grid.distance >= np.float32(NEAR_CELLS)
    np.testing.assert_array_equal(grid.distance[far], np.maximum(expected, np.float32(NEAR_CELLS))[far])
    # Touched cells and their neighbours are all measured.
    assert not (far & (expected <= 0.75)).any()


def some_cells(grid: Grid, count: int) -> NDArray[np.int64]:
    """[n, 3] z, y, x of cells, half of them near the mesh."""
    rng = np.random.default_rng(0)
    near = np.argwhere(grid.distance < 2.5)
    return np.concatenate([rng.choice(near, count // 2), rng.choice(np.argwhere(grid.distance >= 0), count // 2)])


def true_distance(grid: Grid, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """[n] by trimesh, from each point to every triangle."""
    corners = grid.vertices[grid.triangles]
    nearest = np.empty(len(points))
    for index, point in enumerate(points):
        closest = trimesh.triangles.closest_point(corners, np.broadcast_to(point, (len(corners), 3)))
        nearest[index] = np.linalg.norm(closest - point, axis=1).min()
    return nearest


@pytest.mark.parametrize("name", SHAPES)
def test_near_distances_are_those_to_the_mesh(engine: Engine, name: str) -> None:
    """Near to 1e-4 cells; far never too large by more than half a cell's diagonal, nor small by more."""
    grid = grid_of(engine, SHAPES[name](), 32)
    cells = some_cells(grid, 600)
    found = grid.distance[tuple(cells.T)]
    true = true_distance(grid, cells[:, ::-1] + 0.5)
    near = true < NEAR_CELLS - 1e-3
    assert near.sum() > 100
    np.testing.assert_allclose(found[near], true[near], atol=1e-4)
    assert (found[~near] >= NEAR_CELLS - 2e-3).all()
    assert np.abs(found[~near] - true[~near]).max() < np.sqrt(3) / 2 + 1e-3


def test_distance_twin_agrees_with_trimesh(engine: Engine) -> None:
    grid = grid_of(engine, SHAPES["triangles like cells"](), 16)
    points = np.random.default_rng(1).uniform(0, 16, (200, 3))
    twins = twin.distance_to_mesh(points, grid.vertices, grid.triangles)
    np.testing.assert_allclose(twins, true_distance(grid, points), atol=1e-9)


def test_distance_twin_agrees_with_scipy() -> None:
    occupied = np.random.default_rng(0).random((7, 9, 11)) < 0.02
    expected = ndimage.distance_transform_edt(~occupied)
    np.testing.assert_allclose(twin.distance_transform(occupied), expected, rtol=1e-12)


@pytest.mark.parametrize("shape", [(1, 1, 1), (5, 1, 40), (1, 70, 1), (13, 17, 11), (64, 64, 64)])
@pytest.mark.parametrize("share", [0.001, 0.1, 0.7])
def test_transform_of_any_grid(engine: Engine, shape: tuple[int, int, int], share: float) -> None:
    """Also with occupied cells at the rims."""
    occupied = np.random.default_rng(shape[1]).random(shape) < share
    occupied[-1, -1, -1] = True
    uploaded = engine.workspace.upload("test_occupied", occupied.astype(np.int32))
    squared = engine.download(squared_distance(engine, uploaded))
    np.testing.assert_array_equal(squared, np.rint(ndimage.distance_transform_edt(~occupied) ** 2))


def test_nothing_occupied_is_far_everywhere(engine: Engine) -> None:
    uploaded = engine.workspace.upload("test_occupied", np.zeros((5, 6, 7), np.int32))
    np.testing.assert_array_equal(engine.download(squared_distance(engine, uploaded)), 1 << 28)


@pytest.mark.parametrize("name", SHAPES)
def test_grid_is_around_the_mesh(engine: Engine, name: str) -> None:
    grid = grid_of(engine, SHAPES[name](), 48)
    assert max(grid.dims) == 48
    np.testing.assert_allclose(grid.vertices.min(axis=0), MARGIN_CELLS + 0.5, atol=1e-4)
    places = np.argwhere(grid.occupied)[:, ::-1]
    np.testing.assert_array_equal(places.min(axis=0), [MARGIN_CELLS] * 3)
    np.testing.assert_array_equal(places.max(axis=0) + 1 + MARGIN_CELLS, grid.dims)


def test_walls_along_the_axes_are_one_cell_thick(engine: Engine) -> None:
    grid = grid_of(engine, shape_of(trimesh.creation.box((1.0, 1.0, 1.0))), 64)
    for line in (grid.occupied[:, 32, 32], grid.occupied[32, :, 32], grid.occupied[32, 32, :]):
        np.testing.assert_array_equal(np.nonzero(line)[0], [MARGIN_CELLS, 63 - MARGIN_CELLS])


@pytest.mark.data
def test_public_mesh(engine: Engine) -> None:
    grid = grid_of(engine, public_mesh("suzanne.obj"), 64)
    assert_touched_cells_are_marked(grid)
    cells = some_cells(grid, 400)
    twins = twin.distance_to_mesh(cells[:, ::-1] + 0.5, grid.vertices, grid.triangles)
    near = twins < NEAR_CELLS - 1e-3
    np.testing.assert_allclose(grid.distance[tuple(cells.T)][near], twins[near], atol=1e-4)


@pytest.mark.parametrize("cells", [LEAST_CELLS - 1, 0, -5, MOST_CELLS + 1])
def test_impossible_number_of_cells(cells: int) -> None:
    with pytest.raises(ValueError, match=f"grid of {cells} cells"):
        place_grid(np.zeros(3), np.ones(3), cells)
