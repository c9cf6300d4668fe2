"""What image-space rendering looks up, against float64 twins and against solids that are hit exactly."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.rigid import inverse_rigid
from server.objects.rasterize import Placed
from server.objects.virtual_object import VirtualObject
from server.opencl.engine import Engine
from server.opencl.program import with_headers
from server.opencl.structs import struct_text
from server.shading import depth_views as stage
from server.shading.depth_views import DepthViews, ViewShape, draw_depth_views, view_axes
from server.shading.traced_scene import TracedScene, trace_scene, upload_light
from server.transfer.auxiliary_views import ViewsAround
from server.transfer.image_space import nearest_views
from server.transfer.radiance_transfer import Directions, direction_sets
from server.transfer.real_depth_views import RealDepthViews
from server.transfer.sample_grid import NO_GRID
from server.volume.raycast import Surface
from server.volume.volume import Volume
from tests.reference import depth_views as twin
from tests.scenes import lights
from tests.scenes.analytic import look_at, pixel_rays
from tests.scenes.depth_view_scene import host_views
from tests.scenes.lights import random_directions
from tests.scenes.meshes import pose, shape_of
from tests.scenes.own_kernel import own_kernel
from tests.scenes.solids import (
    SCENES,
    Box,
    Scene,
    ball,
    box,
    fill_volume,
    float4,
    floor,
    hit,
    normal_at,
    upload_surface,
)
from tests.scenes.volumes import vectors

VOXEL_M = 0.02
ROOM_M = 1000.0
SHAPE = ViewShape(9, 13)
RAYS = direction_sets(16, 2)
CAMERA = CameraModel(width=61, height=49, fx=52.0, fy=53.0, cx=31.3, cy=23.8)
VIEW = look_at((0.48, 0.75, 0.85), (0.5, 0.3, 0.4), up=(0.0, 1.0, 0.0))
RATIO, THRESHOLD = 1.5, 0.05

Floats = NDArray[np.float64]

SOURCE = """
#include "view_visibility.clh"
kernel void probe(const int items, global const float4 *points, global const float4 *normals, SCENE_PARAMETERS,
                  const float offset_m, global int *blocked, global float *object_m, global float *met,
                  global float4 *places) {
    const int item = get_global_id(0);
    if (item >= items) return;
    const Volume volume = VOLUME_OF_SCENE;
    const Objects things = OBJECTS_OF_SCENE(offset_m);
    const Arriving light = ARRIVING_OF_SCENE(0);
    int chosen[LANES];
    float at_m[LANES];
    float3 at[LANES];
    for (int lane = 0; lane < LANES; lane++) chosen[lane] = item;
    blocked[item] = objects_between(things, light, points[item].xyz, normals[item].xyz, 0.0f, chosen, 1, at_m, at);
    object_m[item] = at_m[0];
    for (int lane = 0; lane < LANES; lane++) at[lane] = (float3)(0.0f);
    meet_surface(volume, light, points[item].xyz, normals[item].xyz, chosen, at_m, at);
    met[item] = at_m[0];
    places[item] = (float4)(at[0], 1.0f);
}
"""


@dataclass(frozen=True)
class Probed:
    """Of items [n], each along direction n of all sets."""

    blocked: NDArray[np.bool_]
    object_m: Floats
    met: Floats
    """Voxels, -1: nothing."""
    places: Floats
    """[n, 3] voxels."""


def no_surface(engine: Engine) -> Surface:
    """What a camera sees that sees nothing."""
    nothing = np.zeros((CAMERA.height, CAMERA.width, 3))
    return upload_surface(engine, nothing, nothing, np.zeros(nothing.shape[:2], bool))


def looks_of(
    engine: Engine, volume: Volume, objects: list[Placed], rays: Directions = RAYS, views: int = 32, near_m: float = 0.0
) -> tuple[DepthViews, Surface]:
    """What a camera would look into that sees nothing."""
    around = ViewsAround(engine, views)
    surface = no_surface(engine)
    depths = engine.workspace.upload("test_depths", np.zeros((CAMERA.height, CAMERA.width), np.float32))
    nearest = nearest_views(rays, around.lattice)[1]
    camera_from_volume = inverse_rigid(VIEW)
    real = RealDepthViews(
        around.update(volume), nearest, CAMERA, camera_from_volume, surface, depths, near_m, RATIO, THRESHOLD
    )
    return draw_depth_views(engine, real, objects), surface


def far_away(engine: Engine) -> list[Placed]:
    """An object that nothing here has to do with."""
    return [(VirtualObject.upload(engine, shape_of(trimesh.creation.box((1, 1, 1))), 8), pose((500, 0, 0)))]


def scene_of(
    engine: Engine, volume: Volume, objects: list[Placed], depth_views: DepthViews, indirect: bool = False
) -> TracedScene:
    light = upload_light(engine, lights.uniform(bands=2), RAYS)
    if indirect:
        light = replace(light, surface_gain=1.0)
    return replace(trace_scene(engine, volume, light, RAYS, ROOM_M, objects), depth_views=depth_views)


def probe(engine: Engine, scene: TracedScene, points: Floats, normals: Floats, offset_m: float = 0.0) -> Probed:
    """points, normals [n, 3] with n the directions of all sets. offset_m: > 0 asks for points of virtual surface."""
    defines = [f"-D{name}={value}" for name, value in scene.defines(engine).items()]
    kernel = own_kernel(engine.device, struct_text() + with_headers(SOURCE, "probe.cl"), "probe", defines)
    space, count = engine.workspace, len(points)
    found: list[Any] = [space.array(f"test_found_{k}", (count,), t) for k, t in enumerate((np.int32, "f4", "f4"))]
    places = space.upload("test_places", float4(np.zeros((count, 3)), np.ones(count)))
    given = (space.upload(f"test_{k}", float4(v, np.ones(count))) for k, v in enumerate((points, normals)))
    whole = (scene.parameters(engine, NO_GRID), *scene.arguments(engine))
    engine.launch(kernel, (count,), count, *given, *whole, offset_m, *found, places)
    blocked, object_m, met = (engine.download(a) for a in found)
    at = vectors(engine.download(places))[:, :3].astype(float)
    return Probed(blocked > 0, object_m.astype(float), met.astype(float), at)


def directions() -> Floats:
    """[n, 3] of all sets, as items are numbered."""
    return RAYS.directions[..., :3].reshape(-1, 3).astype(np.float64)


@pytest.fixture(autouse=True)
def small_views(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage, "FINE", SHAPE)


# ---- views of objects --------------------------------------------------------------------------------------------


def test_axes_are_the_twins() -> None:
    """Octahedral map and shortest turn, twice; every view's own direction falls into its own cell."""
    for cells in (8, 9):
        row, col = np.mgrid[:cells, :cells].reshape(2, -1)
        found = view_axes(cells)
        np.testing.assert_allclose(found, twin.axes_of(np.stack([col, row], -1), cells), atol=1e-12)
        np.testing.assert_array_equal(twin.octahedral_cells(found[:, 2], cells), np.stack([col, row], -1))
        np.testing.assert_allclose(found @ found.transpose(0, 2, 1), np.tile(np.eye(3), (cells**2, 1, 1)), atol=1e-12)
        assert (found[:, 2, 2] >= 0).all()


def test_every_direction_has_a_view_near_it() -> None:
    """Within 7 degrees of FINE views, up or down."""
    random = random_directions(4000, 1)
    random *= np.where(random[:, 2:] < 0, -1, 1)
    at = twin.octahedral_cells(random, 24)
    cosines = (random * twin.axes_of(at, 24)[:, 2]).sum(-1)
    assert np.degrees(np.arccos(cosines.min())) < 7


def host_object(engine: Engine, depth_views: DepthViews, thing: VirtualObject, slot: int = 0) -> twin.ObjectViews:
    texels = engine.download(depth_views.texels)[slot]
    return twin.ObjectViews.unpack(texels, thing.grid.dims, depth_views.shape.cells, depth_views.shape.px)


@pytest.mark.parametrize("name", ["ball", "box"])
def test_views_hold_both_ends_of_every_line(engine: Engine, name: str) -> None:
    """Between the solid and the solid grown by a cell: what blocks is nearer to the mesh than 0.72 of it."""
    mesh = trimesh.creation.icosphere(5) if name == "ball" else trimesh.creation.box((1.0, 2.0, 0.6))
    thing = VirtualObject.upload(engine, shape_of(mesh), 48)
    volume = fill_volume(engine, (floor(),), 0.04)
    views = host_object(engine, looks_of(engine, volume, [(thing, np.eye(4))])[0], thing)
    middle = thing.grid.grid_from_model[:3, 3]
    cells = thing.grid.cells_per_m
    solid = (
        ball(middle, cells)
        if name == "ball"
        else Box(*(middle + s * cells * np.array((0.5, 1.0, 0.3)) for s in (-1, 1)))
    )
    met = passed = 0
    for row, col in [(0, 0), (4, 4), (2, 7), (8, 3), (5, 1)]:
        points, ahead = views.lines(row, col)
        far = 2 * np.linalg.norm(views.half_box)
        for found, sign in ((views.first, 1.0), (-views.last, -1.0)):
            starts, along = points.reshape(-1, 3) - sign * far * ahead, np.tile(sign * ahead, (SHAPE.px**2, 1))
            nearest, farthest = (s.hit(starts, along) - far for s in (solid.grown(1.0), solid))
            ends = found[row, col].ravel()
            hits = ~np.isnan(ends)
            assert hits[np.isfinite(farthest)].all()
            assert not hits[~np.isfinite(nearest)].any()
            assert (ends[hits] >= nearest[hits] - 0.02).all()
            assert (ends[hits] <= np.where(np.isfinite(farthest), farthest, np.inf)[hits] + 0.02).all()
            met, passed = met + hits.sum(), passed + (~hits).sum()
    assert met > 300
    assert passed > 300


@pytest.mark.parametrize("lift", [-1e9, 1.3])
def test_look_is_the_twins(engine: Engine, lift: float) -> None:
    """Points beside, near and on the object, of any normal; brinks of pixels aside, the same answer."""
    mesh = trimesh.creation.torus(0.2, 0.08)
    thing = VirtualObject.upload(engine, shape_of(mesh), 32)
    volume = fill_volume(engine, (floor(-1.0),), 0.04)
    place = pose((0.4, 0.3, 0.5), (1, 2, 3), 0.8, 1.5)
    objects = [(thing, place)]
    depth_views, _ = looks_of(engine, volume, objects)
    scene = scene_of(engine, volume, objects, depth_views)
    w, random = directions(), np.random.default_rng(5)
    points = (
        np.array([0.4, 0.3, 0.5])
        + random.normal(size=w.shape) * np.array([0.05, 0.3, 1.0])[random.integers(0, 3, len(w)), None]
    )
    normals = random_directions(len(w), 2)
    offset_m = scene.table.cell_m[0] if lift > 0 else 0.0
    found = probe(engine, scene, points, normals, offset_m)
    grid = thing.grid.grid_from_model @ np.linalg.inv(place)
    cell_m = 1 / np.linalg.norm(grid[0, :3])
    in_grid = points @ grid[:3, :3].T + grid[:3, 3]
    turned = cell_m * grid[:3, :3]
    meets, met, brink = host_object(engine, depth_views, thing).look(in_grid, normals @ turned.T, w @ turned.T, lift)
    sure = brink > 2e-3
    assert sure.mean() > 0.9
    assert (found.blocked != meets)[sure].mean() < 2e-3  # directions on the brink between two views
    both = sure & found.blocked & meets
    assert np.median(np.abs(found.object_m[both] - met[both] * cell_m)) < 1e-6  # seen: 3e-8
    assert 0.1 < meets.mean() < 0.9


def test_nearest_of_many_objects_blocks(engine: Engine) -> None:
    """More objects than are looked at one by one, of one mesh, each with a place, a turn and a size of its own."""
    random = np.random.default_rng(7)
    thing = VirtualObject.upload(engine, shape_of(trimesh.creation.icosphere(4)), 32)
    balls, objects = [], []
    for _ in range(14):
        center, radius = random.uniform(-1, 1, 3), random.uniform(0.1, 0.25)
        balls.append(ball(center, radius))
        objects.append((thing, pose(center, random.normal(size=3), random.uniform(0, 3), radius)))
    volume = fill_volume(engine, (floor(-1.0),), 0.04)
    depth_views, _ = looks_of(engine, volume, objects)
    scene = scene_of(engine, volume, objects, depth_views)
    w = directions()
    points = random.uniform(-1, 1, w.shape)
    outside = np.min([b.distance(points) for b in balls], axis=0) > 0.05
    found = probe(engine, scene, points, w)
    exact = hit(balls, points, w)
    # A ball is 13 pixels wide and its nearest view 9 degrees off; half a pixel is 4 % of its outline's shadow.
    blocked = np.isfinite(exact)
    assert (found.blocked != blocked)[outside].mean() < 0.04
    assert found.blocked[outside].mean() == pytest.approx(blocked[outside].mean(), abs=0.015)
    both = outside & blocked & found.blocked
    assert np.median(np.abs(found.object_m - exact)[both]) < 0.03
    assert (np.abs(found.object_m - exact)[both] < 0.15).mean() > 0.98
    few = scene_of(engine, volume, objects[:5], looks_of(engine, volume, objects[:5])[0])
    least = np.isfinite(hit(balls[:5], points, w))
    assert (probe(engine, few, points, w).blocked != least)[outside].mean() < 0.02  # seen: 0.006


def test_own_surface_does_not_block_a_ball(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    """From points of its surface no direction above it is blocked, all that point well into it are."""
    monkeypatch.setattr(stage, "FINE", ViewShape(24, 32))
    thing = VirtualObject.upload(engine, shape_of(trimesh.creation.icosphere(5)), 48)
    objects = [(thing, pose((0.4, 0.4, 0.4), (1, 0, 0), 0.3, 0.2))]
    volume = fill_volume(engine, (floor(-1.0),), 0.04)
    depth_views, _ = looks_of(engine, volume, objects)
    scene = scene_of(engine, volume, objects, depth_views)
    w, normals = directions(), random_directions(len(directions()), 3)
    points = 0.4 + 0.2 * normals
    rising = (w * normals).sum(-1) > 0
    assert not probe(engine, scene, points, normals, scene.table.cell_m[0]).blocked[rising].any()
    sinking = (w * normals).sum(-1) < -0.3
    assert probe(engine, scene, points, w).blocked[sinking].all()


# ---- slots -------------------------------------------------------------------------------------------------------


def test_objects_are_drawn_once_and_keep_their_views(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[int] = []
    draw = stage.draw_object

    def counted(*arguments: Any) -> None:
        drawn.append(arguments[-1])
        draw(*arguments)

    monkeypatch.setattr(stage, "draw_object", counted)
    monkeypatch.setattr(stage, "MOST_FINE", 3)
    monkeypatch.setattr(stage, "COARSE", ViewShape(4, 5))
    volume = fill_volume(engine, (floor(),), 0.04)
    sizes = [(1, 1, 1), (1, 2, 1), (1, 1, 3), (2, 1, 1)]
    things = [VirtualObject.upload(engine, shape_of(trimesh.creation.box(size)), 16) for size in sizes]

    def look(*which: int, at: float = 0.0) -> tuple[DepthViews, list[NDArray[np.uint32]]]:
        depth_views, _ = looks_of(engine, volume, [(things[i], pose((at, 0, 0))) for i in which])
        texels = engine.download(depth_views.texels)
        return depth_views, [texels[slot] for slot in engine.download(depth_views.slots)]

    (alone,) = look(0)[1]
    assert len(drawn) == 1
    assert alone.any()
    look(0, 0, at=0.5)
    assert len(drawn) == 1  # moved, and twice in the scene
    second = look(0, 1)[1][1]
    assert len(drawn) == 2
    np.testing.assert_array_equal(look(1, 0)[1][1], alone)
    third = look(2, 1)[1]
    assert len(drawn) == 3
    np.testing.assert_array_equal(third[1], second)
    assert (third[0] != alone).any()
    np.testing.assert_array_equal(look(2, 1, 0)[1][2], alone)  # gone and come back
    assert len(drawn) == 4
    many, coarse = look(0, 1, 2, 3)
    assert many.shape == ViewShape(4, 5)
    assert len(drawn) == 8
    assert all(texels.shape == (400,) and texels.any() for texels in coarse)
    np.testing.assert_array_equal(look(0)[1][0], alone)


# ---- real surface ------------------------------------------------------------------------------------------------


def test_surface_is_what_the_nearest_view_shows(engine: Engine) -> None:
    """Without a picture of the camera: hidden where the view's pixel is nearer to the light and above the plane."""
    scene = SCENES["ball above a floor"]
    volume = fill_volume(engine, scene, VOXEL_M)
    objects = far_away(engine)
    depth_views, _ = looks_of(engine, volume, objects)
    views, nearest = host_views(engine, depth_views.real.views), depth_views.real.view_of.ravel()
    w, normals = directions(), random_directions(len(directions()), 4)
    points = np.random.default_rng(4).uniform(0.2, 0.8, w.shape)
    found = probe(engine, scene_of(engine, volume, objects, depth_views), points, normals)
    side = views.depths.shape[1]
    wrong = hidden = asked = 0
    for i in range(0, len(w), 3):
        view = nearest[i]
        x, y, z = views.axes[view] @ (points[i] - views.eye(view))
        at = np.array([x, y]) / z / views.per_pixel + side / 2
        if np.abs(at - np.round(at)).min() < 1e-2:
            continue
        col, row = np.floor(at).astype(int)
        depth = views.depths[view, row, col]
        offset = views.eye(view) + depth * views.lines(view)[row, col] - points[i]
        expected = 0 < depth < z and offset @ normals[i] > 0
        asked, hidden, wrong = asked + 1, hidden + expected, wrong + (expected != (found.met[i] >= 0))
        if expected and found.met[i] >= 0:
            assert found.met[i] * VOXEL_M == pytest.approx(np.linalg.norm(offset), abs=1e-3)
    assert asked > 1000
    assert wrong <= 0.002 * asked
    assert 0.2 < hidden / asked < 0.8


def seen_by_camera(engine: Engine, scene: Scene) -> tuple[Surface, Floats, Floats]:
    """Geometry buffer, its positions [h, w, 3] and depths [h, w] of an exact camera at VIEW."""
    rays = lights.unit(pixel_rays(CAMERA) @ VIEW[:3, :3].T).reshape(-1, 3)
    t = hit(scene, np.tile(VIEW[:3, 3], (len(rays), 1)), rays)
    points = VIEW[:3, 3] + np.where(np.isfinite(t), t, 0)[:, None] * rays
    valid = np.isfinite(t) & ((points > 0) & (points < 0.96)).all(-1)
    normals = np.zeros_like(points)
    normals[valid] = normal_at(scene, points[valid])
    shape = (CAMERA.height, CAMERA.width)
    depths = np.where(valid, (points - VIEW[:3, 3]) @ VIEW[:3, 2], 0).reshape(shape)
    surface = upload_surface(engine, points.reshape(*shape, 3), normals.reshape(*shape, 3), valid.reshape(shape))
    return surface, points.reshape(*shape, 3), depths


def test_near_surface_is_what_the_camera_shows(engine: Engine) -> None:
    """Nothing is in the volume: what hides is in the picture alone, within the near part, as the twin marches."""
    scene = SCENES["ball above a floor"]
    volume = fill_volume(engine, (floor(-5.0),), VOXEL_M)
    near_m = 0.25
    objects = far_away(engine)
    depth_views, _ = looks_of(engine, volume, objects, near_m=near_m)
    surface, positions, depths = seen_by_camera(engine, scene)
    on_device = engine.workspace.upload("test_depths", depths.astype(np.float32))
    depth_views = replace(depth_views, real=replace(depth_views.real, surface=surface, depths=on_device))
    w, random = directions(), np.random.default_rng(6)
    rows, cols = random.integers(0, CAMERA.height, len(w)), random.integers(0, CAMERA.width, len(w))
    behind_m = random.uniform(-0.2, 0.15, (len(w), 1))  # things in front of the surface and behind it, which face it
    normals = lights.unit(random_directions(len(w), 5) - np.sign(behind_m) * VIEW[:3, 2])
    points = positions[rows, cols] + behind_m * VIEW[:3, 2]
    found = probe(engine, scene_of(engine, volume, objects, depth_views), points, normals)
    picture = twin.Picture(inverse_rigid(VIEW), (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy), depths)
    buffer = vectors(engine.download(surface.normals)).astype(float)
    wrong = met = asked = 0
    turned_away = []
    for i in np.flatnonzero(depths[rows, cols] > 0)[::2]:
        first_m = 2 * VOXEL_M * (1 + (i * 5 & 7) / 8 * (RATIO - 1))
        pixel = picture.march(points[i], normals[i], w[i], first_m, RATIO, near_m, VOXEL_M, THRESHOLD / 2)
        expected = pixel is not None and buffer[(*pixel, slice(3))] @ w[i] < 0  # eq. 7.5
        if pixel is not None and not expected:
            turned_away.append(found.met[i] < 0)
        agrees = expected == (found.met[i] >= 0)
        if expected and agrees:
            assert pixel is not None
            agrees = np.linalg.norm(found.places[i] * VOXEL_M - positions[pixel]) < 1e-4
        asked, met, wrong = asked + 1, met + expected, wrong + (not agrees)
    assert asked > 1000
    assert wrong <= 0.01 * asked
    assert 0.02 < met / asked < 0.8
    assert len(turned_away) > 30
    assert np.mean(turned_away) > 0.95


def test_a_walls_inner_side_is_found_from_outside(engine: Engine) -> None:
    """Views from outside show a wall's back; what it sends is asked for where it is met from inside."""
    wall = box((0.1, -1.0, -1.0), (0.26, 2.0, 2.0))
    volume = fill_volume(engine, (wall,), VOXEL_M)
    objects = far_away(engine)
    depth_views, _ = looks_of(engine, volume, objects, views=256)
    w = directions()
    chosen = w[:, 0] < -0.9
    points = np.tile([0.5, 0.5, 0.5], (len(w), 1))
    found = probe(engine, scene_of(engine, volume, objects, depth_views, indirect=True), points, w)
    assert (found.met[chosen] >= 0).all()
    x_m = found.places[chosen][:, 0] * VOXEL_M
    assert (np.abs(x_m - 0.25) < 1.5 * VOXEL_M).mean() > 0.95
