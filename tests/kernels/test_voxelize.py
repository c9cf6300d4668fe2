"""Distance grids against an exact float64 overlap test and SciPy's distance transform."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy import ndimage

from server.opencl.engine import Engine
from server.scene.mesh import Mesh
from server.scene.virtual_object import VirtualObject
from server.stages.voxelize import LEAST_CELLS, MARGIN_CELLS, MOST_CELLS, place_grid
from tests.meshes import mesh_of, pose, public_mesh, shape_of, soup_of
from tests.reference import voxelize as twin

MARGIN = 1e-4
"""The device's cells are larger by this on every side, so that rounding never loses one."""


def grid_of(engine: Engine, mesh: Mesh, cells: int) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Distances [z, y, x] and the mesh's vertices in grid units."""
    grid = VirtualObject.upload(engine, mesh, cells).grid
    matrix = grid.grid_from_model
    distance = engine.download(grid.distance)
    assert grid.dims == distance.shape[::-1]
    return distance, mesh.vertices.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


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


@pytest.mark.parametrize("cells", [LEAST_CELLS, 33])
@pytest.mark.parametrize("name", SHAPES)
def test_cells_are_those_that_triangles_touch(engine: Engine, name: str, cells: int) -> None:
    mesh = SHAPES[name]()
    distance, vertices = grid_of(engine, mesh, cells)
    dims = distance.shape[::-1]
    triangles = mesh.triangles.astype(np.int64)
    touched = twin.mark_cells(vertices, triangles, dims, 0.5)
    reached = twin.mark_cells(vertices, triangles, dims, 0.5 + 2 * MARGIN)
    marked = distance == 0
    assert not (touched & ~marked).any()
    assert not (marked & ~reached).any()


@pytest.mark.parametrize("name", SHAPES)
def test_every_point_of_the_mesh_is_in_a_marked_cell(engine: Engine, name: str) -> None:
    mesh = SHAPES[name]()
    distance, vertices = grid_of(engine, mesh, 40)
    shares = np.random.default_rng(0).dirichlet((1, 1, 1), (len(mesh.triangles), max(20000 // len(mesh.triangles), 8)))
    points = np.einsum("tsk,tkx->tsx", shares, vertices[mesh.triangles]).reshape(-1, 3)
    x, y, z = np.floor(points).astype(int).T
    assert (distance[z, y, x] == 0).all()


@pytest.mark.parametrize("cells", [LEAST_CELLS, 31, 64])
@pytest.mark.parametrize("name", SHAPES)
def test_distances_are_exact(engine: Engine, name: str, cells: int) -> None:
    distance, _ = grid_of(engine, SHAPES[name](), cells)
    np.testing.assert_array_equal(distance, ndimage.distance_transform_edt(distance > 0).astype(np.float32))


def test_distance_twin_agrees_with_scipy() -> None:
    occupied = np.random.default_rng(0).random((7, 9, 11)) < 0.02
    expected = ndimage.distance_transform_edt(~occupied)
    np.testing.assert_allclose(twin.distance_transform(occupied), expected, rtol=1e-12)


def test_nothing_occupied_is_far_everywhere(engine: Engine) -> None:
    space, shape = engine.workspace, (5, 6, 7)
    empty = space.upload("empty", np.zeros(shape, np.int32))
    squared = space.array("squared", shape, np.int32)
    other = space.array("other", shape, np.int32)
    seed, spread = (engine.kernel("voxelize.cl", n, SLAB=4) for n in ("seed_distance", "spread_distance"))
    dims = np.array((7, 6, 5, 0), np.int32)
    engine.launch(seed, (30,), dims.view([("x", "<i4"), ("y", "<i4"), ("z", "<i4"), ("w", "<i4")])[0], empty, squared)
    engine.launch(spread, (210,), 210, 6, 7, squared, other)
    assert (engine.download(other) > 10**6).all()


@pytest.mark.parametrize("name", SHAPES)
def test_grid_is_around_the_mesh(engine: Engine, name: str) -> None:
    mesh = SHAPES[name]()
    distance, vertices = grid_of(engine, mesh, 48)
    assert max(distance.shape) == 48
    inner = distance[(slice(MARGIN_CELLS, -MARGIN_CELLS),) * 3]
    assert (distance == 0).sum() == (inner == 0).sum() > 0
    np.testing.assert_allclose(vertices.min(axis=0), MARGIN_CELLS + 0.5, atol=1e-4)
    z, y, x = np.nonzero(distance == 0)
    np.testing.assert_array_equal([x.max() + 1 + MARGIN_CELLS, y.max() + 1 + MARGIN_CELLS], distance.shape[:0:-1])
    assert z.max() + 1 + MARGIN_CELLS == distance.shape[0]


def test_walls_along_the_axes_are_one_cell_thick(engine: Engine) -> None:
    distance, _ = grid_of(engine, shape_of(trimesh.creation.box((1.0, 1.0, 1.0))), 64)
    z, y, x = (n // 2 for n in distance.shape)
    for line in (distance[:, y, x], distance[z, :, x], distance[z, y, :]):
        np.testing.assert_array_equal(np.nonzero(line == 0)[0], [MARGIN_CELLS, 63 - MARGIN_CELLS])


def test_distance_is_that_to_the_surface(engine: Engine) -> None:
    """Within the half diagonal by which a touched cell's centre may be off the surface."""
    distance, _ = grid_of(engine, shape_of(trimesh.creation.icosphere(subdivisions=5)), 64)
    centers = np.argwhere(np.ones_like(distance)) + 0.5
    radius = (64 - 2 * MARGIN_CELLS - 1) / 2
    true = np.abs(np.linalg.norm(centers - np.array(distance.shape) / 2, axis=1) - radius)
    error = distance.reshape(-1) - true
    assert np.abs(error).max() < np.sqrt(3) / 2 + 0.1
    assert np.abs(error).mean() < 0.5


@pytest.mark.data
def test_public_mesh(engine: Engine) -> None:
    mesh = public_mesh("suzanne.obj")
    distance, vertices = grid_of(engine, mesh, 64)
    triangles = mesh.triangles.astype(np.int64)
    marked = distance == 0
    assert not (twin.mark_cells(vertices, triangles, distance.shape[::-1], 0.5) & ~marked).any()
    assert not (marked & ~twin.mark_cells(vertices, triangles, distance.shape[::-1], 0.5 + 2 * MARGIN)).any()
    np.testing.assert_array_equal(distance, ndimage.distance_transform_edt(~marked).astype(np.float32))


@pytest.mark.parametrize("cells", [LEAST_CELLS - 1, 0, -5, MOST_CELLS + 1])
def test_impossible_number_of_cells(cells: int) -> None:
    with pytest.raises(ValueError, match=f"grid of {cells} cells"):
        place_grid(np.zeros(3), np.ones(3), cells)


def test_placed_objects_share_the_grid(engine: Engine) -> None:
    """A mesh is voxelised in its own space: moving it does not change the grid."""
    ball = shape_of(trimesh.creation.icosphere(subdivisions=2))
    moved = ball.vertices @ pose((3.0, 2.0, 1.0))[:3, :3].T + np.float32([3, 2, 1])
    here, _ = grid_of(engine, ball, 32)
    there, _ = grid_of(engine, mesh_of(moved, ball.triangles), 32)
    assert (here != there).mean() < 0.02
