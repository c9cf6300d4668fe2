"""The rasteriser against its float64 twin, OpenCV's rasteriser, and planes whose every pixel is known."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.objects import raster_lists
from server.objects.rasterize import FINE_SUBPIXELS, NEAR_M, VirtualSurfaceBuffers, rasterize
from server.objects.virtual_object import VirtualObject
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.scene.mesh import Mesh, load_mesh
from tests.data import data_folder
from tests.reference import rasterize as twin
from tests.scenes.meshes import mesh_file, mesh_of, pose, public_mesh, shape_of, soup_of
from tests.scenes.soups import (
    CAMERA,
    EXACT,
    EYE,
    FLIPS,
    SOUPS,
    at_pixels,
    download,
    draw,
    random_soup,
    triangulated_grid,
)


def rays(camera: CameraModel) -> NDArray[np.float64]:
    """[h, w, 3] directions with z = 1."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)


PARTS = (1, FINE_SUBPIXELS)
"""Subpixels along either side of a pixel. Those of the twin are pixels; what is at their centres is the same."""

# ---- against the twin --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("parts", PARTS)
@pytest.mark.parametrize("name", SOUPS)
def test_matches_twin(engine: Engine, name: str, parts: int) -> None:
    soup = random_soup(len(name), *SOUPS[name])
    matrix = pose((0.1, -0.05, 0.0), (1, 2, 3), 0.4)
    picture = draw(engine, (soup, matrix), view=pose((0, 0, 0), (0, 1, 0), 0.1), parts=parts)
    camera_from_model = pose((0, 0, 0), (0, 1, 0), 0.1) @ matrix
    vertices, triangles = soup.vertices.astype(np.float64), soup.triangles.astype(np.int64)
    visible = twin.raster_tiles(CAMERA, twin.setup_triangles(CAMERA, camera_from_model, vertices, triangles))
    same = picture.triangle == visible
    assert (visible >= 0).mean() > 0.01
    assert (~same).mean() < FLIPS
    attributes = np.hstack([soup.normals, soup.vertex_colors]).astype(np.float64)
    position, mean = twin.shade_surface(CAMERA, camera_from_model, vertices, triangles, attributes, visible)
    # A ray along a triangle meets it nowhere in particular: positions are compared where they are well conditioned.
    corners = vertices[triangles[visible]] @ camera_from_model[:3, :3].T + camera_from_model[:3, 3]
    plane = np.cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :])
    plane /= np.linalg.norm(plane, axis=-1, keepdims=True)
    steep = np.abs((plane * rays(CAMERA)).sum(axis=-1)) > 0.05
    check = same & (visible >= 0) & steep
    error = np.linalg.norm(picture.position - (position @ matrix[:3, :3].T + matrix[:3, 3]), axis=-1)[check]
    assert error.max() < 1e-5 * max(1.0, np.abs(soup.vertices).max())
    np.testing.assert_allclose(picture.color[check], mean[check][:, 3:], atol=1e-5)


@pytest.mark.parametrize("parts", PARTS)
def test_normals_match_twin(engine: Engine, parts: int) -> None:
    ball = shape_of(trimesh.creation.torus(0.5, 0.2, 24, 12))
    matrix = pose((0.05, 0.0, 1.5), (1, 1, 0), 0.7, 0.6)
    picture = draw(engine, (ball, matrix), parts=parts)
    vertices, triangles = ball.vertices.astype(np.float64), ball.triangles.astype(np.int64)
    visible = twin.raster_tiles(CAMERA, twin.setup_triangles(CAMERA, matrix, vertices, triangles))
    check = picture.covered & (visible >= 0)
    _, mean = twin.shade_surface(CAMERA, matrix, vertices, triangles, ball.normals.astype(np.float64), visible)
    a, b, c = (vertices[triangles[visible]][..., k, :] for k in range(3))
    to_camera = -rays(CAMERA) @ np.linalg.inv(matrix[:3, :3]).T
    to_camera /= np.linalg.norm(to_camera, axis=-1, keepdims=True)
    normals = twin.facing_camera(mean[check], np.cross(b - a, c - a)[check], to_camera[check])
    error = np.abs(picture.normal[check] - normals @ matrix[:3, :3].T / 0.6).max(axis=1)
    assert (error > 1e-4).mean() < FLIPS  # the neighbour's triangle is seen where a centre is on an edge
    assert (picture.normal * rays(CAMERA)).sum(axis=-1).max() < 1e-6


# ---- against OpenCV ----------------------------------------------------------------------------------------------


def opencv_depth(camera: CameraModel, points: NDArray[np.float64], triangles: NDArray[np.int32]) -> NDArray[np.float32]:
    """[h, w] metres, 100 where there is nothing, by OpenCV's rasteriser: y up, z backward, centres at half pixels."""
    points = (points * (1, -1, -1)).astype(np.float32).reshape(-1, 1, 3)
    depth = np.full((camera.height, camera.width), 100.0, np.float32)
    settings = cv2.TriangleRasterizeSettings().setCullingMode(cv2.RASTERIZE_CULLING_NONE)
    field_rad = 2 * np.arctan(camera.height / 2 / camera.fy)
    view = np.eye(4, dtype=np.float32)[:3].copy()
    indices = triangles.reshape(-1, 1, 3)
    return cv2.triangleRasterizeDepth(points, indices, depth, view, field_rad, NEAR_M, 100.0, settings)


def compare_with_opencv(engine: Engine, mesh: Mesh, parts: int) -> None:
    camera = CameraModel(width=318, height=239, fx=280.0, fy=280.0, cx=158.5, cy=119.0)
    low, high = mesh.bounds
    scale = 1 / float((high - low).max())
    matrix = pose((0, 0, 0), (0.2, 1.0, 0.1), 2.5, scale)
    matrix[:3, 3] = (0.02, 0.01, 1.2) - matrix[:3, :3] @ (low + high) / 2
    picture = draw(engine, (mesh, matrix), camera=camera, parts=parts)
    depth = opencv_depth(camera, mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3], mesh.triangles)
    both, either = picture.covered & (depth < 99), picture.covered | (depth < 99)
    assert both.sum() > 3000
    assert both.sum() / either.sum() > 0.999
    error = np.abs(picture.position[..., 2] - depth)[both]
    assert (error > 1e-5).mean() < FLIPS
    x0, y0, x1, y1 = picture.boxes[0]
    assert picture.covered[y0:y1, x0:x1].sum() == picture.covered.sum()


@pytest.mark.parametrize("parts", PARTS)
@pytest.mark.parametrize("name", ["sphere", "torus", "box", "capsule"])
def test_matches_opencv(engine: Engine, name: str, parts: int) -> None:
    shapes = {
        "sphere": trimesh.creation.icosphere(subdivisions=4),
        "torus": trimesh.creation.torus(0.5, 0.2),
        "box": trimesh.creation.box((1.0, 0.7, 0.4)),
        "capsule": trimesh.creation.capsule(1.0, 0.3),
    }
    compare_with_opencv(engine, shape_of(shapes[name]), parts)


@pytest.mark.data
@pytest.mark.parametrize(
    "name",
    [
        "suzanne.obj",
        "Duck.glb",
        "dragon_10k.obj",
        "kenney_furniture/loungeSofa.glb",
        "kenney_furniture/pottedPlant.glb",
    ],
)
def test_public_meshes_match_opencv(engine: Engine, name: str) -> None:
    compare_with_opencv(engine, public_mesh(name), FINE_SUBPIXELS)


# ---- against a path tracer ---------------------------------------------------------------------------------------


@pytest.mark.data
def test_matches_path_traced_scene(engine: Engine) -> None:
    """Two objects in a room: where they are in front, how deep, and their base colour, by Mitsuba."""
    folder = data_folder("mitsuba_room")
    meta = json.loads((folder / "studio_white_direct" / "meta.json").read_text())
    camera = CameraModel(**meta["camera"])
    truth = np.load(folder / "truth" / "geometry.npz")
    meshes = [mesh_file(folder / "studio_white_direct" / name) for name in meta["objects"]]
    for frame, line in enumerate(np.loadtxt(folder / "poses.txt")):
        world_from_camera = trimesh.transformations.quaternion_matrix(line[[7, 4, 5, 6]])
        world_from_camera[:3, 3] = line[1:4]
        view = np.linalg.inv(world_from_camera)
        picture = draw(engine, *((mesh, EYE) for mesh in meshes), camera=camera, view=view)
        depth = (picture.position @ view[:3, :3].T + view[:3, 3])[..., 2]
        room = truth["depth_m"][frame]
        shown = picture.covered & ((depth < room) | (room == 0))
        mask = truth["virtual_mask"][frame]
        assert (shown & mask).sum() / (shown | mask).sum() > 0.99
        both = shown & mask
        error = np.abs(depth - truth["depth_with_virtual_m"][frame])[both]
        assert np.median(error) < 1e-6  # seen: 1e-7, the truth's float32
        assert np.percentile(error, 99) < 1e-5  # seen: 6e-7
        np.testing.assert_allclose(picture.color[both], truth["virtual_albedo"][frame][both], atol=0.01)


# ---- known pictures ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_shared_edges_cover_each_pixel_once(engine: Engine, seed: int) -> None:
    rng = np.random.default_rng(seed)
    pixels = np.stack(np.meshgrid(np.linspace(4, 36, 5), np.linspace(2, 34, 5)), axis=-1)
    pixels[1:-1, 1:-1] += rng.integers(-2, 3, (3, 3, 2))  # inner corners on pixel centres too
    corners = at_pixels(EXACT, pixels).reshape(-1, 3)[triangulated_grid(pixels)]
    if seed:  # either way round
        flip = rng.random(len(corners)) < 0.5
        corners[flip] = corners[flip][:, ::-1]
    count = np.zeros((EXACT.height, EXACT.width), int)
    for triangle in corners:
        count += draw(engine, (soup_of(triangle), EYE), camera=EXACT).covered
    expected = np.zeros_like(count)
    expected[2:34, 4:36] = 1  # top and left edges own their centres, bottom and right ones do not
    np.testing.assert_array_equal(count, expected)


def test_pixel_sized_triangles_leave_no_hole(engine: Engine) -> None:
    camera = CameraModel(width=203, height=149, fx=180.0, fy=180.0, cx=101.0, cy=74.0)
    rng = np.random.default_rng(5)
    pixels = np.stack(np.meshgrid(np.arange(-2, 206, 0.9), np.arange(-2, 152, 0.9)), axis=-1)
    pixels[1:-1, 1:-1] += rng.uniform(-0.3, 0.3, pixels[1:-1, 1:-1].shape)
    points = at_pixels(camera, pixels, 1.5)
    picture = draw(engine, (mesh_of(points, triangulated_grid(points)), EYE), camera=camera)
    assert picture.covered.all()
    np.testing.assert_allclose(picture.position, 1.5 * rays(camera), atol=2e-6)


@pytest.mark.parametrize("half_m", [30.0, 1000.0, 1e5])
@pytest.mark.parametrize("cells", [1, 40])
def test_floor_under_the_camera(engine: Engine, half_m: float, cells: int) -> None:
    """Most of a floor is behind the camera: what is in front is seen up to the horizon, at the right depth."""
    side = np.linspace(-half_m, half_m, cells + 1)
    points = np.stack(np.meshgrid(side, side), axis=-1)
    points = np.stack([points[..., 0], np.full_like(points[..., 0], 1.5), points[..., 1]], axis=-1)
    picture = draw(engine, (mesh_of(points, triangulated_grid(points)), EYE))
    with np.errstate(divide="ignore"):
        expected = rays(CAMERA) * (1.5 / rays(CAMERA)[..., 1:2])
    seen = (expected[..., 2] > NEAR_M) & (np.abs(expected[..., [0, 2]]).max(axis=-1) < half_m)
    assert (picture.covered != seen).mean() < 0.01  # the far edge is a row of pixels
    check = seen & picture.covered
    relative = np.linalg.norm(picture.position - expected, axis=-1)[check] / expected[check][:, 2]
    assert relative.max() < max(1e-5, 1e-7 * half_m)  # seen: 2e-6
    np.testing.assert_allclose(picture.normal[check], np.tile((0, -1, 0), (check.sum(), 1)), atol=1e-6)


def test_many_triangles_through_the_near_plane(engine: Engine) -> None:
    """More clipped pieces than the lists first have room for."""
    angle = np.linspace(0, 2 * np.pi, 4001)
    rim = np.stack([3 * np.cos(angle), 3 * np.sin(angle), np.full_like(angle, 1.0)], axis=-1)
    corners = np.stack([np.broadcast_to((0.0, 0.0, -1.0), rim[1:].shape), rim[:-1], rim[1:]], axis=1)
    wide = CameraModel(width=160, height=120, fx=20.0, fy=20.0, cx=79.5, cy=59.5)
    picture = draw(engine, (mesh_of(corners, np.arange(3 * len(corners))), EYE), camera=wide)
    # A cone around the axis, its tip behind the camera: r = 1.5 (z + 1).
    r = np.hypot(rays(wide)[..., 0], rays(wide)[..., 1])
    depth = np.divide(1.5, r - 1.5, out=np.full_like(r, np.inf), where=r > 1.5)
    seen = (depth < 1) & (depth > NEAR_M)
    assert seen.mean() > 0.2
    assert (picture.covered != seen).mean() < 0.02  # two rims
    check = seen & picture.covered
    assert np.abs(picture.position[..., 2] - depth)[check].max() < 1e-3  # 4000 chords for a circle


def test_inside_a_box(engine: Engine) -> None:
    box = shape_of(trimesh.creation.box((4.0, 3.0, 5.0)))
    picture = draw(engine, (box, pose((0.3, 0.2, 0.1))))
    assert picture.covered.all()
    low, high = np.array([-1.7, -1.3, -2.4]), np.array([2.3, 1.7, 2.6])
    wall = np.where(rays(CAMERA) > 0, high, low)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (wall / rays(CAMERA)).min(axis=-1)
    np.testing.assert_allclose(picture.position, rays(CAMERA) * depth[..., None], atol=2e-5)
    assert (picture.normal * rays(CAMERA)).sum(axis=-1).max() < 0


def test_behind_the_camera(engine: Engine) -> None:
    box = shape_of(trimesh.creation.box())
    picture = draw(engine, (box, pose((0, 0, -3.0))), (box, pose((0, 0, NEAR_M - 0.51))), (box, pose((900.0, 0, 3.0))))
    assert not picture.covered.any()
    assert picture.boxes == (None, None, None)


def test_no_objects(engine: Engine) -> None:
    picture = draw(engine)
    assert not picture.covered.any()
    assert picture.boxes == ()


def test_degenerate_triangles_draw_nothing(engine: Engine) -> None:
    point = [[0.0, 0.0, 1.0]] * 3
    line = [[-1.0, 0.0, 1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 1.0]]
    edge_on = [[0.0, 0.0, 1.0], [0.0, 0.0, 2.0], [0.0, 0.0, 3.0]]
    real = [[-1.0, -1.0, 2.0], [1.0, -1.0, 2.0], [0.0, 1.0, 2.0]]
    picture = draw(engine, (soup_of([point, line, edge_on, real]), EYE))
    assert set(np.unique(picture.triangle)) == {-1, 3}


def test_equally_near_triangles_show_the_first(engine: Engine) -> None:
    triangle = np.array([[-1.0, -1.0, 2.0], [1.1, -0.9, 2.5], [0.0, 1.0, 1.5]])
    behind = triangle * 1.5
    picture = draw(engine, (soup_of([behind, triangle, triangle, triangle]), EYE))
    assert set(np.unique(picture.triangle)) == {-1, 1}
    twice = draw(engine, (soup_of(behind), EYE), (soup_of(triangle), EYE), (soup_of(triangle), EYE))
    assert set(np.unique(twice.index)) == {-1, 1}


@pytest.mark.parametrize("size_px", [3, 7, 9, 40])
def test_equally_near_triangles_of_any_size_show_the_first(engine: Engine, size_px: float) -> None:
    """Small ones are drawn as fragments, large ones in tiles; each of them three times."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform((10, 10), (140, 90), (60, 1, 2)) + rng.uniform(-0.5, 0.5, (60, 3, 2)) * size_px
    corners = at_pixels(CAMERA, pixels) * rng.uniform(0.5, 2, (60, 1, 1))
    picture = draw(engine, (soup_of(np.concatenate([corners, corners, corners])), EYE))
    once = draw(engine, (soup_of(corners), EYE))
    assert once.covered.sum() > 30
    np.testing.assert_array_equal(picture.triangle, once.triangle)


@pytest.mark.parametrize("seed", range(3))
def test_triangles_of_all_sizes_match_twin(engine: Engine, seed: int) -> None:
    """Fragments and tiles meet at the same pixels, in either order of depth."""
    rng = np.random.default_rng(seed)
    size_px = 10 ** rng.uniform(-0.5, 2, (500, 1, 1))
    pixels = rng.uniform((0, 0), (CAMERA.width, CAMERA.height), (500, 1, 2)) + rng.normal(size=(500, 3, 2)) * size_px
    soup = soup_of(at_pixels(CAMERA, pixels) * rng.uniform(0.5, 4, (500, 3, 1)))
    picture = draw(engine, (soup, EYE))
    vertices, triangles = soup.vertices.astype(np.float64), soup.triangles.astype(np.int64)
    visible = twin.raster_tiles(CAMERA, twin.setup_triangles(CAMERA, EYE, vertices, triangles))
    assert (picture.triangle != visible).mean() < FLIPS
    shown = np.unique(visible[visible >= 0])
    assert (size_px.ravel()[shown] < 4).sum() > 3
    assert (size_px.ravel()[shown] > 10).sum() > 15


def test_more_triangles_in_a_tile_than_are_looked_at_at_once(engine: Engine) -> None:
    """What one batch found, the next must beat."""
    rng = np.random.default_rng(7)
    pixels = np.array([60.0, 40.0]) + rng.normal(size=(250, 3, 2)) * 30
    for order in (np.linspace(0.5, 4, 250), rng.uniform(0.5, 4, 250)):
        soup = soup_of(at_pixels(CAMERA, pixels) * order[:, None, None])
        vertices, triangles = soup.vertices.astype(np.float64), soup.triangles.astype(np.int64)
        visible = twin.raster_tiles(CAMERA, twin.setup_triangles(CAMERA, EYE, vertices, triangles))
        assert (draw(engine, (soup, EYE)).triangle != visible).mean() < FLIPS


@pytest.mark.parametrize("setting", ["_PIECES_PER_PIXEL", "_FRAGMENTS_PER_PIXEL", "_MORE_ENTRIES"])
def test_lists_without_room(engine: Engine, monkeypatch: pytest.MonkeyPatch, setting: str) -> None:
    """Pieces get more, of fragments the triangles are gone through again, of entries all pieces; the picture is the
    same."""
    soup = random_soup(3, 2000, 0.05, (0.0, 0.0, 1.0), 0.6)
    twice = soup_of(np.concatenate([soup.vertices, soup.vertices]).reshape(-1, 3, 3))
    expected = draw(engine, (twice, EYE))
    monkeypatch.setattr(raster_lists, setting, 0)
    monkeypatch.setattr(raster_lists, "_LEAST_ROOM", 1)
    monkeypatch.setattr(raster_lists, "_LEAST_ENTRIES", 1)
    other = Engine(engine.device)
    found = draw(other, (twice, EYE))
    other.close()
    np.testing.assert_array_equal(found.triangle, expected.triangle)
    np.testing.assert_array_equal(found.position, expected.position)


def test_tiles_with_more_than_they_may_list(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some is not drawn, what is drawn is right, and nothing is written beyond the lists."""
    monkeypatch.setattr(raster_lists, "_MOST_ENTRIES", 5 * 20 * 13)
    monkeypatch.setattr(raster_lists, "_LEAST_ENTRIES", 1)
    pixels = np.array([60.0, 40.0]) + np.random.default_rng(7).normal(size=(200, 3, 2)) * 30
    soup = soup_of(at_pixels(CAMERA, pixels) * np.linspace(0.5, 4, 200)[:, None, None])
    picture = draw(engine, (soup, EYE))
    assert 0.2 < picture.covered.mean() < 0.95
    depths = np.linspace(0.5, 4, 200)[picture.triangle[picture.covered]]
    np.testing.assert_allclose(picture.position[picture.covered][:, 2], depths, rtol=1e-5)


def test_nearest_object_wins(engine: Engine) -> None:
    near = shape_of(trimesh.creation.icosphere(subdivisions=3, radius=0.3))
    far = shape_of(trimesh.creation.box((1.5, 1.0, 0.2)))
    at = pose((0.1, 0, 1.5))
    picture = draw(engine, (far, pose((0, 0, 3.0))), (near, at), (far, pose((0, 0, -9.0))))
    alone = draw(engine, (near, at))
    np.testing.assert_array_equal(picture.index == 1, alone.covered)
    assert (picture.index == 0).sum() > 500
    assert picture.boxes[2] is None
    for index, box in enumerate(picture.boxes[:2]):
        x0, y0, x1, y1 = box
        assert (picture.index[y0:y1, x0:x1] == index).sum() == (picture.index == index).sum()
        rows, columns = np.nonzero(alone.covered)
        if index == 1:  # a ball fills its box, up to perspective
            assert abs(x0 - columns.min()) < 12
            assert abs(y1 - rows.max()) < 12


def test_two_views_in_buffers_of_their_own(engine: Engine) -> None:
    thing = VirtualObject.upload(engine, shape_of(trimesh.creation.box()), cells=8)
    first = rasterize(engine, CAMERA, EYE, [(thing, pose((0, 0, 3.0)))])
    expected = download(engine, first)
    rasterize(engine, CAMERA, EYE, [(thing, pose((0.5, 0, 4.0)))], VirtualSurfaceBuffers(engine.workspace))
    np.testing.assert_array_equal(download(engine, first).position, expected.position)
    np.testing.assert_array_equal(download(engine, first).index, expected.index)


def test_nothing_is_left_where_an_object_was(device: Device, engine: Engine) -> None:
    """Only what objects cover, and did the last time, is gone over: as if drawn for the first time all the same."""
    thing = VirtualObject.upload(engine, shape_of(trimesh.creation.icosphere()), cells=8)
    places: list[list[tuple[float, float, float]]] = [
        [(0.0, 0.0, 6.0)],
        [(-2.0, 1.0, 5.0), (2.5, -1.0, 7.0)],
        [(0.0, 0.0, -3.0)],  # behind
        [(1.5, 1.2, 6.0)],
        [],
        [(0.0, 0.0, 1.2)],  # all of the picture
        [(0.5, 0.0, 9.0)],
    ]
    for points in places:
        objects = [(thing, pose(point)) for point in points]
        fresh = Engine(device)
        for parts in PARTS:
            surfaces = [(e, rasterize(e, CAMERA, EYE, objects, parts=parts)) for e in (engine, fresh)]
            found, first = (download(e, surface) for e, surface in surfaces)
            for field in ("index", "position", "normal", "color"):
                np.testing.assert_array_equal(getattr(found, field), getattr(first, field))
        np.testing.assert_array_equal(*(e.download(surface.nearest) for e, surface in surfaces))
        fresh.close()


def test_order_of_triangles_does_not_matter(engine: Engine) -> None:
    soup = random_soup(9, 400, 0.2, (0, 0, 1.5), 0.8)
    order = np.random.default_rng(0).permutation(len(soup.triangles))
    shuffled = Mesh(soup.vertices, soup.triangles[order], soup.vertex_colors, soup.normals, "y")
    pictures = [draw(engine, (mesh, EYE)) for mesh in (soup, shuffled, soup)]
    for other in pictures[1:]:
        np.testing.assert_array_equal(other.position, pictures[0].position)
        np.testing.assert_array_equal(other.normal, pictures[0].normal)
        np.testing.assert_array_equal(other.color, pictures[0].color)


def test_colors_are_perspective_correct(engine: Engine) -> None:
    corners = np.array([[-1.0, -0.6, 0.8], [1.5, -1.0, 4.0], [0.0, 2.0, 6.0]])
    picture = draw(engine, (mesh_of(corners, [0, 1, 2], np.eye(3)), EYE))
    assert picture.covered.sum() > 1000
    back = picture.color[picture.covered] @ corners  # the colours are the barycentric coordinates
    np.testing.assert_allclose(back, picture.position[picture.covered], atol=1e-5)
    np.testing.assert_allclose(np.cross(back, rays(CAMERA)[picture.covered]), 0, atol=2e-5)


def test_smooth_normals_of_a_ball(engine: Engine) -> None:
    ball = shape_of(trimesh.creation.icosphere(subdivisions=5))
    picture = draw(engine, (ball, pose((0.2, 0.1, 2.0), (1, 1, 1), 0.5, 0.5)), view=EYE)
    center = picture.position[picture.covered] - (0.2, 0.1, 2.0)
    np.testing.assert_allclose(np.linalg.norm(center, axis=1), 0.5, atol=5e-4)
    cosine = (picture.normal[picture.covered] * center / 0.5).sum(axis=1)
    assert np.degrees(np.arccos(np.clip(np.percentile(cosine, 1), -1, 1))) < 2


@pytest.mark.parametrize("tiles", [1, 7, 255, 256, 257, 4800])
def test_scan_tiles(engine: Engine, tiles: int) -> None:
    rng = np.random.default_rng(tiles)
    counts = rng.integers(0, 9, tiles + 2).astype(np.int32)
    starts = engine.workspace.array("starts", (tiles + 3,), np.int32)
    scan = engine.kernel("rasterize.cl", "scan_tiles")
    engine.launch(scan, (256,), tiles, 6, engine.workspace.upload("counts", counts), starts, local=(256,))
    expected = [0, *np.cumsum(np.minimum(counts[2:], 6)), *counts[:2]]
    np.testing.assert_array_equal(engine.download(starts), expected)


@pytest.mark.parametrize("shape", [trimesh.creation.icosphere(2, 0.2), trimesh.creation.box((0.3, 0.2, 0.25))])
def test_a_mesh_whose_triangles_share_no_vertices_looks_the_same(engine: Engine, shape: trimesh.Trimesh) -> None:
    """A PLY file, read, drawn, covered and made into distances: with shared vertices, with own ones for each triangle,
    and with each triangle there a second time, turned over, as furniture of thin boards is often made."""
    own = trimesh.Trimesh(shape.vertices[shape.faces].reshape(-1, 3), np.arange(3 * len(shape.faces)).reshape(-1, 3))
    own = trimesh.Trimesh(own.vertices, own.faces, process=False)
    doubled = trimesh.Trimesh(
        shape.vertices, np.hstack([shape.faces, shape.faces[:, ::-1]]).reshape(-1, 3), process=False
    )
    view = pose((0.02, 0.01, 0.9), (1, 2, 3), 0.4)
    pictures, covers, distances = [], [], []
    for file in (shape, own, doubled):
        file.visual.vertex_colors = np.tile(np.uint8([200, 150, 90, 255]), (len(file.vertices), 1))
        mesh = load_mesh(file.export(file_type="ply"), "ply")
        thing = VirtualObject.upload(engine, mesh)
        surface = rasterize(engine, CAMERA, EYE, [(thing, view)], parts=FINE_SUBPIXELS)
        assert surface.nearest is not None
        pictures.append(download(engine, surface))
        covers.append(engine.download(surface.nearest).copy())
        distances.append(engine.download(thing.grid.distance).copy())
    shared = pictures[0]
    assert (shared.index >= 0).sum() > 300
    for picture, cover, distance in zip(pictures[1:], covers[1:], distances[1:], strict=True):
        np.testing.assert_array_equal(picture.index, shared.index)
        np.testing.assert_array_equal(cover > 0, covers[0] > 0)
        np.testing.assert_allclose(cover.view(np.float32), covers[0].view(np.float32), rtol=4 * 2.0**-23)
        np.testing.assert_allclose(distance, distances[0], atol=1e-4)  # cells; the order of corners rounds differently
        for name in ("position", "normal", "color"):
            np.testing.assert_allclose(getattr(picture, name), getattr(shared, name), atol=1e-5)
