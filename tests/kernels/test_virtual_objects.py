"""Rays through the table of virtual objects, against balls, walls and meshes hit exactly."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyopencl.cltypes as cl_types
import pytest
import trimesh
from numpy.typing import NDArray

from server.objects.object_table import ObjectTable, object_table
from server.objects.object_tree import FEW_OBJECTS, tree_rows
from server.objects.virtual_object import VirtualObject
from server.opencl.engine import Engine
from server.opencl.program import with_headers
from server.opencl.structs import struct_text
from server.scene.mesh import Mesh
from tests.reference import voxelize as twin
from tests.scenes.meshes import mesh_of, pose, public_mesh, shape_of
from tests.scenes.own_kernel import own_kernel

SOURCE = """
#include "virtual_objects.clh"
kernel void trace(const int rays, const int count, const global float16 *grid_from_volume, const global int4 *dims,
                  const global float *distances, const global float *origins, const global float *directions,
                  const float ray_length_m, global float *visibility, global float *cell_m) {
    const int ray = get_global_id(0);
    if (ray >= rays) return;
    visibility[ray] = trace_objects(count, grid_from_volume, dims, distances, vload3(ray, origins),
                                    vload3(ray, directions), ray_length_m);
    if (ray < count) cell_m[ray] = cell_size_m(grid_from_volume[ray]);
}
"""
FAR_M = 100.0

Points = NDArray[np.float64]


@pytest.fixture
def trace(engine: Engine) -> Any:
    """Visibility of rays (origins [n, 3], directions [n, 3], reach) through a table."""
    kernel = own_kernel(engine.device, struct_text() + with_headers(SOURCE, "trace.cl"), "trace")

    def run(
        table: ObjectTable, origins: Points, directions: Points, ray_length_m: float = FAR_M
    ) -> NDArray[np.float32]:
        space, rays = engine.workspace, len(origins)
        ends = [
            space.upload(f"test_{k}", np.ascontiguousarray(v, np.float32)) for k, v in enumerate((origins, directions))
        ]
        visibility = space.array("test_visibility", (rays,), np.float32)
        cell_m = space.array("test_cells", (max(table.count, 1),), np.float32)
        rows = (table.count, table.grid_from_volume, table.dims, table.distances)
        engine.launch(kernel, (rays,), rays, *rows, *ends, ray_length_m, visibility, cell_m)
        np.testing.assert_allclose(engine.download(cell_m)[: table.count], table.cell_m, rtol=1e-5)
        result = engine.download(visibility)
        assert set(np.unique(result)) <= {0.0, 1.0}
        return result

    return run


def table_of(engine: Engine, *placed: tuple[Mesh, NDArray[np.float64]], cells: int = 64) -> ObjectTable:
    return object_table(engine, [(VirtualObject.upload(engine, mesh, cells), matrix) for mesh, matrix in placed])


def unit(vectors: Points) -> Points:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def random_directions(rng: np.random.Generator, count: int) -> Points:
    return unit(rng.normal(size=(count, 3)))


def rays_beside(rng: np.random.Generator, count: int, farthest: float) -> tuple[Points, Points, Points]:
    """Rays that pass the origin at 0 to `farthest`: start (3 before), direction, how far they pass."""
    directions = random_directions(rng, count)
    beside = unit(np.cross(directions, rng.normal(size=(count, 3))))
    passing = rng.uniform(0, farthest, count)
    return beside * passing[:, None] - 3 * directions, directions, passing


BALL = trimesh.creation.icosphere(subdivisions=5)
PLACES = [pose((0, 0, 0)), pose((0.3, -0.2, 0.5), (1, 2, 3), 0.9, 0.37), pose((-5, 1, 2), (0, 1, 0), 2.0, 12.0)]


@pytest.mark.parametrize("cells", [32, 64])
@pytest.mark.parametrize("place", PLACES)
def test_ball(engine: Engine, trace: Any, place: Points, cells: int) -> None:
    """Blocked where the ball is and half a cell beside it, free from one cell, whatever its place and scale."""
    table = table_of(engine, (shape_of(BALL), place), cells=cells)
    origins, directions, passing = rays_beside(np.random.default_rng(0), 20000, 1.5)
    scale = np.cbrt(np.linalg.det(place[:3, :3]))
    at, along = origins @ place[:3, :3].T + place[:3, 3], directions @ place[:3, :3].T / scale
    visibility = trace(table, at, along)
    cell = table.cell_m[0] / scale
    assert not visibility[passing < 1 + 0.5 * cell].any()
    assert visibility[passing > 1 + 1.0 * cell].all()
    outline = (passing > 1 + 0.5 * cell) & (passing < 1 + cell)
    assert 0.3 < visibility[outline].mean() < 0.8


def test_ray_off_its_own_surface_is_free(engine: Engine, trace: Any) -> None:
    table = table_of(engine, (shape_of(BALL), np.eye(4)))
    rng = np.random.default_rng(1)
    normals = random_directions(rng, 50000)
    directions = unit(normals + 0.999 * random_directions(rng, len(normals)))
    assert trace(table, normals * (1 + table.cell_m[0]), directions).all()


@pytest.mark.parametrize("seed", range(6))
def test_wall_of_any_direction_neither_leaks_nor_blocks_itself(engine: Engine, trace: Any, seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) @ turn.T
    table = table_of(engine, (mesh_of(corners, [[0, 1, 2], [0, 2, 3]]), np.eye(4)))
    at = np.concatenate([rng.uniform(-0.9, 0.9, (30000, 2)), np.full((30000, 1), table.cell_m[0])], axis=1)
    directions = unit(np.array([0, 0, 1]) + 0.999 * random_directions(rng, len(at)))
    assert trace(table, at @ turn.T, directions @ turn.T).all()
    through = directions * (1, 1, -1)
    lands = at[:, :2] + through[:, :2] * (at[:, 2:] / -through[:, 2:])
    inside = (np.abs(lands) < 0.97).all(axis=1)
    assert not trace(table, (at @ turn.T)[inside], (through @ turn.T)[inside]).any()


def test_thin_leg_blocks(engine: Engine, trace: Any) -> None:
    """A leg a third of a cell thick still blocks what meets its axis."""
    leg = shape_of(trimesh.creation.cylinder(0.005, 2.0))
    table = table_of(engine, (leg, np.eye(4)))
    rng = np.random.default_rng(2)
    points = np.stack([np.zeros(5000), np.zeros(5000), rng.uniform(-0.9, 0.9, 5000)], axis=1)
    directions = unit(random_directions(rng, 5000) * (1, 1, 0.3))
    assert table.cell_m[0] > 0.03
    assert not trace(table, points - 2 * directions, directions).any()


def test_reach(engine: Engine, trace: Any) -> None:
    """A ray ends where its reach does, and does not look behind itself."""
    table = table_of(engine, (shape_of(BALL), pose((0, 0, 5.0))))
    rng = np.random.default_rng(3)
    origins = np.concatenate([rng.uniform(-0.3, 0.3, (2000, 2)), np.zeros((2000, 1))], axis=1)
    ahead = np.tile((0.0, 0.0, 1.0), (2000, 1))
    entry = 5 - np.sqrt(1 - (origins[:, :2] ** 2).sum(axis=1))
    assert trace(table, origins, ahead, float(entry.min()) - 2 * table.cell_m[0]).all()
    assert not trace(table, origins, ahead, float(entry.max()) + 0.1 * table.cell_m[0]).any()
    assert trace(table, origins, -ahead).all()
    assert trace(table, origins, ahead, 0.0).all()


def test_rays_along_the_axes(engine: Engine, trace: Any) -> None:
    """Directions with exact zeros, inside and outside the grid."""
    table = table_of(engine, (shape_of(trimesh.creation.box((1.0, 1.0, 1.0))), np.eye(4)))
    directions = np.concatenate([np.eye(3), -np.eye(3)])
    assert not trace(table, -3 * directions, directions).any()
    assert trace(table, -3 * directions, -directions).all()
    assert trace(table, -3 * directions + 2 * np.roll(directions, 1, axis=1), directions).all()
    assert not trace(table, np.zeros((6, 3)), directions).any()


def test_empty_table(engine: Engine, trace: Any) -> None:
    table = object_table(engine, [])
    assert table.count == 0
    assert trace(table, np.zeros((5, 3)), np.tile((0.0, 0.0, 1.0), (5, 1))).all()


def test_several_objects(engine: Engine, trace: Any) -> None:
    """Each is found in its own part of the pool; grids of different sizes."""
    ball, box = shape_of(BALL), shape_of(trimesh.creation.box((2.0, 0.5, 1.0)))
    at = [np.array(p) for p in ((0.0, 0.0, 4.0), (4.0, 0.0, 0.0), (0.0, -4.0, 0.0))]
    placed = [(ball, pose(at[0], scale=0.5)), (box, pose(at[1], (0, 0, 1), 1.0)), (ball, pose(at[2], (1, 0, 0), 1.0))]
    table = table_of(engine, *placed)
    directions = unit(np.array([*at, *(-p for p in at), at[0] + at[1], at[1] - at[2]]))
    visibility = trace(table, np.zeros((len(directions), 3)), directions)
    np.testing.assert_array_equal(visibility, [0, 0, 0, 1, 1, 1, 1, 1])
    both = table_of(engine, *placed[1:])
    np.testing.assert_array_equal(trace(both, np.zeros((3, 3)), directions[:3]), [1, 0, 0])


@pytest.mark.parametrize("count", [FEW_OBJECTS, FEW_OBJECTS + 1, 64, 300])
def test_many_objects_block_as_each_does(engine: Engine, trace: Any, count: int) -> None:
    """The tree finds every object that a ray meets, whatever their number, sizes and turns."""
    rng = np.random.default_rng(count)
    things = [
        VirtualObject.upload(engine, shape_of(s), 12) for s in (trimesh.creation.icosphere(), trimesh.creation.box())
    ]
    places = [
        pose(rng.uniform(-4, 4, 3), rng.normal(size=3), rng.uniform(0, 3), 10 ** rng.uniform(-1.5, -0.2))
        for _ in range(count)
    ]
    objects = [(things[k % 2], place) for k, place in enumerate(places)]
    origins = rng.uniform(-5, 5, (4000, 3))
    aims = np.array([place[:3, 3] for place in places])[rng.integers(0, count, 4000)] + rng.normal(size=(4000, 3)) / 4
    directions = unit(aims - origins)
    directions[:60] = np.tile(np.concatenate([np.eye(3), -np.eye(3)]), (10, 1))
    for ray_length_m in (3.0, FAR_M):
        together = trace(object_table(engine, objects), origins, directions, ray_length_m)
        apart = np.ones(len(origins), np.float32)
        for begin in range(0, count, FEW_OBJECTS):
            few = object_table(engine, objects[begin : begin + FEW_OBJECTS])
            apart = np.minimum(apart, trace(few, origins, directions, ray_length_m))
        assert 40 < (apart == 0).sum() < 3960
        np.testing.assert_array_equal(together, apart)


@pytest.mark.parametrize("count", [1, 2, 3, 8, 9, 31, 1000])
def test_tree_holds_every_box(count: int) -> None:
    """Depth first: the nodes under one follow it, up to where it points; each box holds those under it."""
    rng = np.random.default_rng(count)
    low = rng.normal(size=(count, 3))
    high = low + rng.random((count, 3))
    rows = tree_rows(low, high)
    leaves = rows[:, 7] >= 0
    np.testing.assert_array_equal(np.sort(rows[leaves, 7]), np.arange(count))
    numbers = rows[leaves, 7].astype(int)
    np.testing.assert_array_equal(rows[leaves, :3], low[numbers])
    np.testing.assert_array_equal(rows[leaves, 3:6], high[numbers])
    assert rows[0, 6] == len(rows)
    for at, row in enumerate(rows):
        under = rows[at + 1 : int(row[6])]
        assert at < row[6] <= len(rows)
        assert (under[:, 6] <= row[6]).all()
        filled = under[under[:, 0] <= under[:, 3]]
        assert (filled[:, :3] >= row[:3]).all()
        assert (filled[:, 3:6] <= row[3:6]).all()


def test_a_mesh_placed_twice_is_kept_once_and_copied_once(engine: Engine) -> None:
    things = [VirtualObject.upload(engine, shape_of(BALL), cells) for cells in (16, 8)]
    several = [(things[0], np.eye(4)), (things[1], pose((2, 0, 0))), (things[0], pose((3, 0, 0)))]
    table = object_table(engine, several)
    assert table.distances.size == 16**3 + 8**3
    np.testing.assert_array_equal(engine.download(table.dims).view(np.int32).reshape(3, 4)[:, 3], [0, 16**3, 0])
    table.distances.fill(7.0)
    assert (engine.download(object_table(engine, several).distances) == 7).all(), "the same set was copied again"
    pool = engine.download(object_table(engine, several[1:]).distances)
    np.testing.assert_array_equal(pool[: 8**3], engine.download(things[1].grid.distance).ravel())
    np.testing.assert_array_equal(pool[8**3 :], engine.download(things[0].grid.distance).ravel())


@pytest.mark.data
@pytest.mark.parametrize("name", ["suzanne.obj", "kenney_furniture/chairDesk.glb"])
def test_public_mesh_agrees_with_exact_rays(engine: Engine, trace: Any, name: str) -> None:
    """Where a ray meets the mesh it is blocked; where it passes, mostly free: outlines grow by under a cell."""
    mesh = public_mesh(name)
    low, high = mesh.bounds
    table = table_of(engine, (mesh, np.eye(4)))
    rng = np.random.default_rng(4)
    directions = random_directions(rng, 3000)
    targets = rng.uniform(low - 0.2 * (high - low), high + 0.2 * (high - low), (3000, 3))
    origins = targets - 3 * float(np.linalg.norm(high - low)) * directions
    exact = twin.trace_mesh(mesh.vertices.astype(np.float64), mesh.triangles.astype(np.int64), origins, directions)
    visibility = trace(table, origins, directions, 1000.0)
    hit = np.isfinite(exact)
    assert hit.mean() > 0.1
    assert not visibility[hit].any()
    assert (visibility[~hit] == 1).mean() > 0.85


def test_table_rows(engine: Engine) -> None:
    """The rows are what the docstring says: matrix from volume to cells, sizes, start in the pool."""
    ball, box = shape_of(BALL), shape_of(trimesh.creation.box((2.0, 0.5, 1.0)))
    matrix = pose((1.0, 2.0, 3.0), (1, 1, 0), 0.4, 2.0)
    things = [VirtualObject.upload(engine, ball, 16), VirtualObject.upload(engine, box, 32)]
    table = object_table(engine, [(things[0], np.eye(4)), (things[1], matrix)])
    rows = engine.download(table.grid_from_volume).view(np.float32).reshape(2, 4, 4)
    expected = things[1].grid.grid_from_model @ np.linalg.inv(matrix)
    np.testing.assert_allclose(rows[1], expected, rtol=1e-6, atol=1e-5)
    dims = engine.download(table.dims).view(np.int32).reshape(2, 4)
    np.testing.assert_array_equal(dims, [[16, 16, 16, 0], [*things[1].grid.dims, 16**3]])
    pool = engine.download(table.distances)
    np.testing.assert_array_equal(pool[16**3 :], engine.download(things[1].grid.distance).ravel())
    assert table.grid_from_volume.dtype == cl_types.float16
    assert table.cell_m[1] == pytest.approx(2.0 / things[1].grid.cells_per_m)
