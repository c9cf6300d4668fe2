"""The scene's mesh against surfaces known in closed form, and against exact depth of a rendered room."""

from __future__ import annotations

import io
import sys

import numpy as np
import pytest
import trimesh

from client.options.source import open_source
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.geometry.geometry import Geometry
from server.meshing.chunks import CHUNK_BRICKS
from server.meshing.files import mesh_files
from server.meshing.scene_mesh import (
    UNKNOWN_COLOR,
    SceneMesh,
    scene_mesh,
    srgb8_from_linear,
    with_all_colors,
    without_specks,
)
from server.meshing.surface import GREATEST_STEP, MeshingError, VoxelMesh, extract_surface
from server.opencl.engine import Engine
from server.scene.colors import linear_from_srgb
from server.scene.mesh import load_mesh
from server.volume.volume import BRICK, TRUNCATION_VOXELS, Bricks
from tests.data import data_folder
from tests.scenes.bricks import Field, ball, bricks_of, reordered
from tests.service.fakes import CAMERA

CENTER, RADIUS = (40.3, 38.7, 41.1), 30.0
GRID = (10, 10, 10)
UPRIGHT = np.eye(3)


def solid(mesh: VoxelMesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)


def edge_uses(mesh: VoxelMesh) -> np.ndarray:
    """How many triangles each edge belongs to."""
    edges = np.sort(mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return np.unique(edges, axis=0, return_counts=True)[1]


def rough(points: np.ndarray) -> np.ndarray:
    """A blob with noise of a third of a voxel: hundreds of ambiguous cells; no two voxels differ by a torn step."""
    noise = np.random.default_rng(5).uniform(-0.6, 0.6, points.shape[:-1])
    return 0.6 * np.clip(ball(CENTER, RADIUS)(points), -1, 1) + noise


def test_a_ball_is_closed_and_in_its_place() -> None:
    mesh = extract_surface(bricks_of(ball(CENTER, RADIUS), GRID))
    outward = (mesh.vertices - CENTER) / np.linalg.norm(mesh.vertices - CENTER, axis=1)[:, None]
    assert solid(mesh).is_watertight
    assert solid(mesh).euler_number == 2
    assert solid(mesh).volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=1e-3)  # positive: seen from outside
    # Linear interpolation of a distance bends by 1 / (8 radius); values near zero are moved by 4e-3 voxels.
    assert np.abs(ball(CENTER, RADIUS)(mesh.vertices)).max() < 5e-3
    off_deg = np.degrees(np.arccos((outward * mesh.normals).sum(axis=1).clip(-1, 1)))
    assert np.median(off_deg) < 0.3
    assert off_deg.max() < np.degrees(1 / RADIUS)  # what a voxel's step along it turns the normal by


def test_a_room_seen_from_inside_faces_inwards() -> None:
    low, high = np.array([6.2, 9.7, 5.5]), np.array([70.1, 60.4, 66.6])

    def inside(points: np.ndarray) -> np.ndarray:
        return np.minimum(points - low, high - points).min(axis=-1)

    mesh = extract_surface(bricks_of(inside, GRID))
    assert solid(mesh).is_watertight
    assert solid(mesh).euler_number == 2
    assert solid(mesh).volume == pytest.approx(-np.prod(high - low), rel=2e-3)  # corners are cut by half a voxel
    # Only a cell that a corner or an edge goes through is off, by less than half its diagonal.
    off = np.abs(inside(mesh.vertices))
    assert np.percentile(off, 95) < 5e-3
    assert off.max() < 0.3  # seen: 0.20


def test_chunk_borders_leave_no_crack_and_no_double_vertex() -> None:
    bricks = bricks_of(rough, GRID)
    mesh = extract_surface(bricks)
    assert max(GRID) > 2 * CHUNK_BRICKS
    assert (edge_uses(mesh) == 2).all()
    assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)
    assert solid(mesh).is_winding_consistent


def test_the_same_bricks_in_any_order_give_the_same_mesh() -> None:
    bricks = bricks_of(rough, (6, 6, 6))
    shuffled = reordered(bricks, np.random.default_rng(1).permutation(len(bricks.indices)))
    ours, theirs = extract_surface(bricks), extract_surface(shuffled)
    for name in ("vertices", "triangles", "normals", "colors"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))


@pytest.mark.parametrize("rubbish", [-1.0, 1.0, 0.0, np.nan])
def test_only_cells_whose_eight_voxels_were_seen_have_surface(rubbish: float) -> None:
    border = 37

    def seen(points: np.ndarray) -> np.ndarray:
        return points[..., 0] < border

    whole = bricks_of(ball(CENTER, RADIUS), GRID, seen=seen)
    whole.tsdf[whole.weight == 0] = rubbish
    mesh = extract_surface(whole)
    assert mesh.vertices[:, 0].max() <= border - 0.5
    assert np.abs(ball(CENTER, RADIUS)(mesh.vertices)).max() < 5e-3
    assert np.isfinite(mesh.normals).all()
    ends = edge_uses(mesh)
    assert set(ends) == {1, 2}
    rim = 2 * np.pi * np.sqrt(RADIUS**2 - (border - 0.5 - CENTER[0]) ** 2)
    assert (ends == 1).sum() < 3 * rim  # the cut itself, nothing else


def test_a_surface_through_grid_points_is_whole() -> None:
    mesh = extract_surface(bricks_of(lambda points: points[..., 2] - 12.5, (3, 3, 3)))
    np.testing.assert_allclose(mesh.vertices[:, 2], 12.5, atol=TRUNCATION_VOXELS * 1.01e-3)
    assert solid(mesh).area == pytest.approx(23**2)
    np.testing.assert_allclose(mesh.normals, [[0, 0, 1]] * len(mesh.normals), atol=1e-12)


@pytest.mark.parametrize(("step", "is_surface"), [(0.96 * GREATEST_STEP, True), (1.05 * GREATEST_STEP, False)])
def test_what_jumps_further_than_a_surface_can_is_none(step: float, is_surface: bool) -> None:
    def field(points: np.ndarray) -> np.ndarray:
        return TRUNCATION_VOXELS * np.where(points[..., 0] > 12, 0.9, 0.9 - step)

    bricks = bricks_of(field, (3, 3, 3))
    if is_surface:
        assert solid(extract_surface(bricks)).area == pytest.approx(23**2)
    else:
        with pytest.raises(MeshingError, match="no surface"):
            extract_surface(bricks)


def colored_plane(colored: Field) -> VoxelMesh:
    """A slanting plane whose voxels' red is their x / 24, blue their y / 24."""
    return extract_surface(
        bricks_of(
            lambda p: 0.8 * (p[..., 2] - 12.2) + 0.6 * (p[..., 0] - 12),
            (3, 3, 3),
            color=lambda p: np.stack([p[..., 0] / 24, np.full(p.shape[:-1], 0.5), p[..., 1] / 24], axis=-1),
            colored=colored,
        )
    )


def test_colours_are_those_between_the_voxels() -> None:
    mesh = colored_plane(lambda p: np.ones(p.shape[:-1]))
    np.testing.assert_allclose(mesh.colors[:, 0], mesh.vertices[:, 0] / 24, atol=1e-6)
    np.testing.assert_allclose(mesh.colors[:, 2], mesh.vertices[:, 1] / 24, atol=1e-6)
    assert mesh.colored.all()


def test_voxels_without_colour_give_none() -> None:
    mesh = colored_plane(lambda p: p[..., 0] < 12)
    x = mesh.vertices[:, 0]
    assert not mesh.colored[x > 12.5].any()
    assert mesh.colored[x < 12.49].all()
    np.testing.assert_allclose(mesh.colors[x < 11.5, 0], x[x < 11.5] / 24, atol=1e-6)
    crossing = (x > 11.51) & (x < 12.49)
    assert crossing.sum() > 20
    np.testing.assert_allclose(mesh.colors[crossing, 0], 11.5 / 24, atol=1e-6)  # of the one voxel that has any


def test_colours_spread_to_where_there_is_none() -> None:
    mesh = colored_plane(lambda p: p[..., 0] < 12)
    full = with_all_colors(mesh)
    np.testing.assert_array_equal(full.colors[mesh.colored], mesh.colors[mesh.colored])
    np.testing.assert_allclose(full.colors[~mesh.colored, 0], 11.5 / 24, atol=1e-6)
    np.testing.assert_allclose(full.colors[~mesh.colored, 1], 0.5, atol=1e-6)
    assert np.ptp(full.colors[~mesh.colored, 2]) > 0.6  # along the border each its own; seen: 0.93
    none = with_all_colors(colored_plane(lambda p: np.zeros(p.shape[:-1])))
    np.testing.assert_array_equal(none.colors, UNKNOWN_COLOR)


def test_specks_go_and_small_things_stay() -> None:
    def field(points: np.ndarray) -> np.ndarray:
        along = points[..., 0] - np.clip(points[..., 0], 12.2, 22.1)
        stick = np.linalg.norm(np.stack([along, points[..., 1] - 12.1, points[..., 2] - 40.3], axis=-1), axis=-1) - 2.2
        return np.minimum(ball(CENTER, 20)(points), np.minimum(stick, ball((66.0, 12.3, 41.1), 3.0)(points)))

    mesh = extract_surface(bricks_of(field, GRID))
    assert solid(mesh).body_count == 3
    kept = without_specks(mesh, BRICK)
    assert solid(kept).body_count == 2
    assert solid(kept).is_watertight
    np.testing.assert_allclose(np.abs(field(kept.vertices)), 0, atol=0.1)
    assert kept.vertices[:, 0].max() < 63
    only_speck = extract_surface(bricks_of(ball((12.0, 12.0, 12.0), 3.0), (3, 3, 3)))
    with pytest.raises(MeshingError, match="every piece is smaller"):
        without_specks(only_speck, BRICK)


def empty_bricks(count: int) -> Bricks:
    """Bricks that were allocated and never seen."""
    shape = (count, BRICK, BRICK, BRICK)
    zeros = np.zeros(shape, np.float32)
    indices = np.arange(3 * count, dtype=np.int32).reshape(count, 3)
    return Bricks(indices, zeros, zeros, np.zeros((*shape, 3), np.float32), np.zeros(shape, np.uint8))


@pytest.mark.parametrize("count", [0, 3])
def test_nothing_fused_is_one_clear_line(count: int) -> None:
    with pytest.raises(MeshingError, match="there is no surface to mesh") as caught:
        extract_surface(empty_bricks(count))
    assert "\n" not in str(caught.value)


def test_a_pipeline_without_frames_has_no_mesh(device) -> None:
    pipeline = ClientSession(device, CAMERA, Wishes())
    with pytest.raises(MeshingError, match="no frame has been fused"):
        pipeline.scene_mesh()
    pipeline.close()


def test_without_the_library_it_is_named(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "skimage.measure", None)
    with pytest.raises(MeshingError, match="scikit-image: run make install"):
        extract_surface(empty_bricks(0))


def test_progress_ends_with_all_parts() -> None:
    told: list[tuple[int, int]] = []
    extract_surface(bricks_of(ball(CENTER, RADIUS), GRID), lambda done, total: told.append((done, total)))
    count = told[0][1]
    assert count > 1
    assert told == [(i, count) for i in range(count + 1)]


@pytest.fixture(scope="module")
def scanned() -> SceneMesh:
    """A ball at 1 cm, 1 m below the world's origin, in a world whose up is -y."""
    bricks = bricks_of(ball(CENTER, RADIUS), GRID, color=lambda p: p / 80)
    return scene_mesh(bricks, 0.01, np.array([2.0, 1.0, -3.0]), np.diag([1.0, -1.0, -1.0]))


def test_world_coordinates(scanned: SceneMesh) -> None:
    center = np.array([2.0, 1.0, -3.0]) + 0.01 * np.array(CENTER)
    np.testing.assert_allclose(np.linalg.norm(scanned.vertices - center, axis=1), 0.3, atol=1e-4)
    expected = (scanned.vertices - [2.0, 1.0, -3.0]) / 0.8
    np.testing.assert_allclose(linear_from_srgb(scanned.colors / 255), expected, atol=0.006)


def test_ply_is_in_the_world_and_glb_upright(scanned: SceneMesh) -> None:
    files = mesh_files(scanned)
    ply = trimesh.load(io.BytesIO(files["ply"]), file_type="ply", process=False)
    np.testing.assert_array_equal(ply.vertices, scanned.vertices)
    np.testing.assert_array_equal(ply.faces, scanned.triangles)
    np.testing.assert_array_equal(ply.visual.vertex_colors[:, :3], scanned.colors)
    np.testing.assert_allclose(ply.vertex_normals, scanned.normals, atol=1e-6)
    glb = trimesh.load_scene(io.BytesIO(files["glb"]), file_type="glb").to_mesh()
    np.testing.assert_allclose(glb.bounds, _bounds(scanned), atol=1e-6)
    assert glb.volume > 0


def _bounds(mesh: SceneMesh) -> np.ndarray:
    moved = mesh.vertices @ mesh.gltf_from_world.T
    return np.stack([moved.min(axis=0), moved.max(axis=0)])


@pytest.mark.parametrize("format_", ["ply", "glb"])
def test_our_own_reader_takes_it_as_an_object(scanned: SceneMesh, format_: str) -> None:
    mesh = load_mesh(mesh_files(scanned)[format_], format_)
    turn = np.eye(3) if format_ == "ply" else scanned.gltf_from_world
    np.testing.assert_allclose(mesh.vertices, scanned.vertices @ turn.T, atol=1e-6)
    np.testing.assert_allclose(mesh.normals, scanned.normals @ turn.T, atol=1e-5)
    np.testing.assert_allclose(mesh.vertex_colors, linear_from_srgb(scanned.colors / 255), atol=1e-6)
    assert mesh.notes == ()


def test_equal_meshes_give_equal_bytes(scanned: SceneMesh) -> None:
    assert mesh_files(scanned) == mesh_files(scanned)


def test_srgb_is_the_inverse_of_the_readers() -> None:
    codes = np.arange(256)
    np.testing.assert_array_equal(srgb8_from_linear(linear_from_srgb(codes / 255).astype(np.float64)), codes)
    np.testing.assert_array_equal(srgb8_from_linear(np.array([-1.0, 2.0])), [0, 255])


@pytest.mark.data
def test_a_rendered_room(engine: Engine) -> None:
    """Mesh of 25 exact frames against the exact depth of others: on the pixel where no depth edge is near."""
    source = open_source(str(data_folder("mitsuba_track_clean")))
    camera = source.camera
    geometry = Geometry(engine, camera, Wishes(volume_m=(-0.05, 0.05, 0.7, 2.15, 1.6, 2.1), voxel_m=0.01))
    for i in range(0, 100, 4):
        geometry.scan(source[i])
    volume = geometry.volume
    mesh = scene_mesh(volume.download_bricks(), volume.voxel_m, volume.origin_world, UPRIGHT)
    errors = np.concatenate([depth_errors(mesh, source[i]) for i in (2, 34, 66, 98)])
    assert len(errors) > 60_000  # seen: 94 852
    assert np.median(np.abs(errors)) < 0.1 * volume.voxel_m
    assert np.percentile(np.abs(errors), 95) < 0.5 * volume.voxel_m


def depth_errors(mesh: SceneMesh, frame) -> np.ndarray:
    """Metres between the vertices that a frame shows and its depth, away from depth edges and grazing surfaces."""
    pose, fx = frame.world_from_camera, 525.0
    points = (mesh.vertices - pose[:3, 3]) @ pose[:3, :3]
    facing = -((mesh.normals @ pose[:3, :3]) * points).sum(axis=1) / np.linalg.norm(points, axis=1)
    u = np.rint(points[:, 0] / points[:, 2] * fx + 319.5).astype(int)
    v = np.rint(points[:, 1] / points[:, 2] * fx + 239.5).astype(int)
    good = (points[:, 2] > 0.1) & (u >= 2) & (u < 638) & (v >= 2) & (v < 478) & (facing > 0.5)
    u, v, z = u[good], v[good], points[good, 2]
    depth = frame.depth * 0.001
    around = np.stack([depth[v + dy, u + dx] for dy in (-2, 0, 2) for dx in (-2, 0, 2)])
    flat = (around.min(axis=0) > 0) & (np.ptp(around, axis=0) < 0.03)
    error = z - depth[v, u]
    return error[flat & (np.abs(error) < 0.05)]  # beyond, something else hides the vertex
