"""One bounce between virtual and real: white furnaces, in which nothing may change, and colours that must bleed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import trimesh
from numpy.typing import ArrayLike

from protocol.frames import CameraModel
from server.maths.rigid import inverse_rigid
from server.maths.sh import lambert_transfer, spherical_fibonacci
from server.objects.rasterize import Placed, VirtualSurface
from server.objects.surface_points import CELLS, POINTS, deal_points
from server.objects.virtual_object import VirtualObject
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.scene.mesh import Mesh
from server.shading import adaptive, differential_rendering
from server.shading.adaptive import refine_real
from server.shading.differential_rendering import (
    RealShadow,
    bounce_real,
    light_points,
    shadow_real,
    shadow_virtual,
)
from server.shading.traced_scene import Changed, trace_scene, upload_light
from server.shading.virtual_point_lights import place_points
from server.transfer.indirect import Indirect, MeanSent, gather_hits, no_hits, observe_indirect, room_for_met
from server.transfer.radiance_transfer import direction_sets, transfer_radiance
from server.transfer.sample_grid import SampleGrid
from tests.scenes import lights
from tests.scenes.analytic import Floats, look_at
from tests.scenes.lanes import KINDS
from tests.scenes.meshes import pose, shape_of
from tests.scenes.painted_walls import paint, voxels_of
from tests.scenes.shaded_floor import buffer, camera_of, floor_points
from tests.scenes.solids import (
    SCENES,
    SIDE_M,
    Box,
    Scene,
    box,
    download4,
    fill_volume,
    float4,
    floor,
    hit,
    upload_surface,
)
from tests.scenes.tolerance import relative_tolerance
from tests.scenes.volumes import seen_surface

VOXEL_M, ROOM_M = 0.01, 1000.0
FLOOR: Scene = (floor(),)
UP = np.array([0.0, 1.0, 0.0])
PLATE = box((0.4, 0.2, 0.4), (0.56, 0.24, 0.56))
WALL = box((0.62, 0.1, 0.05), (0.68, 0.7, 0.91))
WHITE = (1.0, 1.0, 1.0)
CODED = 3e-3
"""Of a colour of 1 in 9, 9 and 8 bits of its root, and of a surface's shading by 81 directions under an even sky."""


def placed(engine: Engine, solid: Box, color: ArrayLike = WHITE) -> Placed:
    mesh: Mesh = shape_of(trimesh.creation.box(solid.high - solid.low))
    mesh = replace(mesh, vertex_colors=np.tile(np.asarray(color, np.float32), (len(mesh.vertices), 1)))
    return VirtualObject.upload(engine, mesh), pose((solid.low + solid.high) / 2)


@dataclass(frozen=True)
class Lit:
    """A floor with objects above it, under indirect light."""

    ratio: Floats
    shaded: Floats
    refined: Floats
    points: Floats


def light_floor(
    engine: Engine,
    objects: list[Placed],
    *,
    scene: Scene = FLOOR,
    color: ArrayLike = WHITE,
    light: Floats | None = None,
    unseen: ArrayLike = WHITE,
    exposure: float = 1.0,
    stride: int = 3,
    step: int = 1,
) -> Lit:
    """Ratios on a floor whose surroundings send `color`, and beyond pictures `unseen`."""
    light = lights.uniform() if light is None else light
    positions, normals = buffer(floor_points(), UP, (24, 24), stride)
    camera, rays = camera_of(positions), direction_sets(81, 4)
    surface = upload_surface(engine, positions[..., :3], normals[..., :3], positions[..., 3] > 0)
    volume = fill_volume(engine, scene, VOXEL_M)
    paint(engine, volume, np.broadcast_to(np.asarray(color, float), (*voxels_of(volume), 3)))
    transfer = transfer_radiance(engine, camera, volume, surface, stride, rays, ROOM_M)
    hits = gather_hits(engine, camera, volume, surface, transfer, rays, ROOM_M, every=1)
    indirect = Indirect(hits, np.asarray(unseen, float))
    device_light = upload_light(engine, light, rays, indirect=indirect, exposure=exposure)
    traced = trace_scene(engine, volume, device_light, rays, ROOM_M, objects)
    traced = replace(traced, point_lights=light_points(engine, traced))
    shadow: RealShadow = shadow_real(engine, camera, surface, transfer, traced, indirect, step=step)
    refined = refine_real(engine, camera, surface, traced, shadow)
    return Lit(
        download4(engine, shadow.values).astype(float),
        download4(engine, shadow.shaded).astype(float),
        download4(engine, refined).astype(float),
        positions[stride // 2 :: stride, stride // 2 :: stride, :3],
    )


@KINDS
@pytest.mark.parametrize("scene", [(floor(),), (floor(), WALL)], ids=["floor", "wall"])
def test_white_things_in_a_white_furnace_are_not_seen(device: Device, kind: type[Engine], scene: Scene) -> None:
    """All that is sends 1: an object of albedo 1 sends what it hides, be it sky or wall."""
    engine = kind(device)
    ratio = light_floor(engine, [placed(engine, PLATE)], scene=scene).ratio
    valid = ratio[..., 3] > 0
    np.testing.assert_allclose(ratio[valid][:, :3], 1.0, atol=CODED)
    assert np.abs(ratio[valid][:, :3] - 1).max() > 0  # it was not spared


def test_a_black_thing_there_takes_its_share_of_all_light(engine: Engine) -> None:
    """R' / R = 1 - share of the sky, whatever of it was wall: R is 1 everywhere in a furnace."""
    ratios = [
        light_floor(engine, [placed(engine, PLATE, (0.0, 0.0, 0.0))], scene=scene).ratio[..., 0]
        for scene in ((floor(),), (floor(), WALL))
    ]
    inside = np.s_[4:20, 4:12]  # in front of the wall
    np.testing.assert_allclose(ratios[1][inside], ratios[0][inside], atol=0.01)
    assert ratios[0].min() < 0.7


def test_without_indirect_light_nothing_is_sent(engine: Engine) -> None:
    """A white thing takes what a black one takes, and R is what the sky alone brings."""
    positions, normals = buffer(floor_points(), UP, (24, 24), 3)
    camera, rays = camera_of(positions), direction_sets(81, 4)
    surface = upload_surface(engine, positions[..., :3], normals[..., :3], positions[..., 3] > 0)
    volume = fill_volume(engine, (floor(), WALL), VOXEL_M)
    transfer = transfer_radiance(engine, camera, volume, surface, 3, rays, ROOM_M)
    light = upload_light(engine, lights.uniform(), rays)
    ratios = []
    for color in (WHITE, (0.0, 0.0, 0.0)):
        objects = [placed(engine, PLATE, color)]
        traced = trace_scene(engine, volume, light, rays, ROOM_M, objects)
        shadow = shadow_real(engine, camera, surface, transfer, traced)
        ratios.append(download4(engine, shadow.values).copy())
    np.testing.assert_array_equal(*ratios)
    shaded = download4(engine, shadow.shaded)[..., 0]
    np.testing.assert_allclose(shaded, engine.download(transfer.openness), atol=0.02)


def test_a_red_thing_reddens_the_floor(engine: Engine) -> None:
    lit = light_floor(engine, [placed(engine, PLATE, (0.9, 0.1, 0.1))])
    redder = lit.ratio[..., 0] - lit.ratio[..., 1]
    assert redder.min() > -CODED
    near = np.abs(lit.points - [0.48, 0.1, 0.48]).max(axis=-1) < 0.1
    assert redder[near].min() > 0.03
    assert redder[near].mean() > 5 * redder[~near].mean()
    assert (lit.ratio[..., 0] < 1.0 + CODED).all()  # it sends no more than the sky it hides


def test_rims_say_what_samples_say(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    """Refined pixels trace what samples know from the transfer: the same ratio, with indirect light too."""
    monkeypatch.setattr(adaptive, "LEAST_CHANGE", 1 / 32)  # wide rims, so that means say something
    lit = light_floor(engine, [placed(engine, PLATE, (0.1, 0.1, 0.1))], scene=(floor(), WALL), color=(0.5, 0.6, 0.7))
    middle = lit.refined[1::3, 1::3]
    both = (middle[..., 3] > 0) & (lit.ratio[..., 3] > 0)
    assert both.sum() > 50
    apart = middle[both][:, :3] - lit.ratio[both][:, :3]
    assert np.abs(apart.mean(axis=0)).max() < 0.01  # single pixels differ by the directions they trace
    assert np.sqrt((apart**2).mean()) < 0.06


@pytest.mark.parametrize("step", [2, 3, 5])
def test_blocks_are_shaded_as_their_first_sample(engine: Engine, step: int) -> None:
    """Where they have surface."""
    each, blocks = (light_floor(engine, [placed(engine, PLATE, np.zeros(3))], step=n) for n in (1, step))
    rows, cols = np.indices(each.ratio.shape[:2]) // step * step
    for one, other in ((each.ratio, blocks.ratio), (each.shaded, blocks.shaded)):
        assert one[..., 3].all()
        np.testing.assert_array_equal(other, one[rows, cols])
    assert np.ptp(each.ratio[..., 0]) > 0.1


def test_exposure_scales_both_sides(engine: Engine) -> None:
    """The volume's colours are in the first picture's units, the light on the device in this one's."""
    objects = [placed(engine, PLATE, (0.5, 0.3, 0.1))]
    lit, brighter = (
        light_floor(engine, objects, scene=(floor(), WALL), color=(0.5, 0.6, 0.7), exposure=e) for e in (1.0, 3.0)
    )
    np.testing.assert_allclose(brighter.ratio, lit.ratio, atol=1e-5)
    np.testing.assert_allclose(brighter.shaded[..., :3], 3 * lit.shaded[..., :3], rtol=1e-4)


# ---- what surfaces send to virtual things ------------------------------------------------------------------------


def taken_from_top(
    engine: Engine, scene: Scene, objects: list[Placed], color: ArrayLike, light: Floats, unseen: ArrayLike = WHITE
) -> Floats:
    """[20, 20, 4] what the surroundings take from the top of PLATE, less what they send."""
    x, z = np.meshgrid(np.linspace(0.42, 0.54, 20), np.linspace(0.42, 0.54, 20))
    points = np.stack([x, np.full_like(x, PLATE.high[1]), z], -1)
    positions, normals = buffer(points.reshape(-1, 3), UP, (20, 20), 2)
    covered = np.ones(positions.shape[:2])
    space = engine.workspace
    surface = VirtualSurface(
        **{
            **dict.fromkeys(VirtualSurface.__dataclass_fields__),
            "position": space.upload("virtual_positions", float4(positions[..., :3], covered)),
            "normal": space.upload("virtual_normals", float4(normals[..., :3], covered)),
            "object_index": space.upload("virtual_index", np.zeros(covered.shape, np.int32)),
            "boxes": ((0, 0, *covered.shape[::-1]),),
        }
    )
    rays, camera = direction_sets(81, 4), camera_of(positions)
    volume = fill_volume(engine, scene, VOXEL_M)
    paint(engine, volume, np.broadcast_to(np.asarray(color, float), (*voxels_of(volume), 3)))
    empty = Indirect(space.constant("test_no_hits", np.zeros((1, 1, 4), np.float32)), np.asarray(unseen, float))
    device_light = upload_light(engine, light, rays, indirect=empty)
    traced = trace_scene(engine, volume, device_light, rays, ROOM_M, objects)
    found = shadow_virtual(engine, camera, surface, replace(traced, point_lights=light_points(engine, traced)))
    return download4(engine, found.values).astype(float)


@KINDS
def test_a_wall_as_bright_as_the_sky_takes_nothing(device: Device, kind: type[Engine]) -> None:
    engine = kind(device)
    taken = taken_from_top(engine, (floor(), WALL), [placed(engine, PLATE)], WHITE, lights.uniform())
    np.testing.assert_allclose(taken[..., :3], 0.0, atol=CODED)
    dark = taken_from_top(engine, (floor(), WALL), [placed(engine, PLATE)], (0.0, 0.0, 0.0), lights.uniform())
    assert dark[..., 0].min() > 0.1  # the wall is there


def test_a_wall_sends_its_colour_to_virtual_things(engine: Engine) -> None:
    """Half as bright as the sky in red it takes half of what a black one takes, in green all."""
    objects = [placed(engine, PLATE)]
    black, red = (
        taken_from_top(engine, (floor(), WALL), objects, color, lights.uniform())
        for color in ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0))
    )
    np.testing.assert_allclose(red[..., 0], 0.5 * black[..., 0], atol=CODED)
    np.testing.assert_allclose(red[..., 1], black[..., 1], atol=CODED)


def test_virtual_things_send_to_one_another(engine: Engine) -> None:
    """A slab over the plate's top, lit from below by a white floor, sends its albedo's share of that."""
    slab = box((0.38, 0.34, 0.38), (0.58, 0.38, 0.58))
    taken = {
        name: taken_from_top(
            engine,
            (floor(),),
            [placed(engine, PLATE, (0.0, 0.0, 0.0)), placed(engine, slab, color)],
            WHITE,
            lights.uniform(),
        )
        for name, color in (("black", (0.0, 0.0, 0.0)), ("red", (0.8, 0.0, 0.0)))
    }
    hidden = taken["black"][..., 0]
    assert hidden.min() > 0.3
    np.testing.assert_allclose(taken["red"][..., 1], taken["black"][..., 1], atol=CODED)
    sent = (hidden - taken["red"][..., 0]) / hidden
    # The slab's underside sees the floor, which sends 1, past the black plate, which it takes for black: in between.
    assert sent.min() > 0.2
    assert sent.max() < 0.8 + CODED


def test_surface_that_no_picture_shows_sends_the_mean(engine: Engine) -> None:
    objects = [placed(engine, PLATE)]
    volume_colors = lights.uniform()
    rays = direction_sets(81, 4)
    black = taken_from_top(engine, (floor(), WALL), objects, (0.0, 0.0, 0.0), volume_colors)
    positions, normals = buffer(floor_points(), UP, (24, 24), 3)
    volume = fill_volume(engine, (floor(), WALL), VOXEL_M)  # no voxel has a colour
    surface = upload_surface(engine, positions[..., :3], normals[..., :3], positions[..., 3] > 0)
    transfer = transfer_radiance(engine, camera_of(positions), volume, surface, 3, rays, ROOM_M)
    hits = gather_hits(engine, camera_of(positions), volume, surface, transfer, rays, ROOM_M)
    seen = observe_indirect(engine, transfer, rays, hits, MeanSent())
    assert not seen.mean.any()
    assert not download4(engine, no_hits(engine, transfer)).any()
    assert black[..., 0].min() > 0.1


# ---- points on objects -------------------------------------------------------------------------------------------


def test_points_are_dealt_by_area_on_both_sides(engine: Engine) -> None:
    sizes = np.array([0.4, 0.1, 0.2])
    thing, matrix = placed(engine, Box(-sizes / 2, sizes / 2), (0.3, 0.6, 0.9))
    dealt = thing.surface_points
    assert dealt.points.shape == (POINTS, 3)  # a box is closed
    areas = np.array([sizes[1] * sizes[2], sizes[0] * sizes[2], sizes[0] * sizes[1]])
    faces = np.bincount(np.abs(dealt.normals).argmax(axis=1), minlength=3)
    np.testing.assert_allclose(faces / POINTS, areas / areas.sum(), atol=2 / POINTS)
    assert np.allclose(dealt.albedos, [0.3, 0.6, 0.9])
    model = (dealt.points - thing.grid.grid_from_model[:3, 3]) / thing.grid.cells_per_m
    assert np.abs(np.abs(model) / (sizes / 2)).max(axis=1) == pytest.approx(1.0, abs=1e-5)
    shown = place_points(engine, [(thing, matrix)])
    assert shown.count == POINTS
    np.testing.assert_allclose(download4(engine, shown.points)[:, :3], model + matrix[:3, 3], atol=1e-5)


def test_nearest_points_are_nearest_of_those_that_face_each_way(engine: Engine) -> None:
    mesh: Mesh = shape_of(trimesh.creation.icosphere(3, 0.1))
    thing = VirtualObject.upload(engine, mesh)
    dealt = deal_points(engine, mesh, thing.grid)
    side = max(thing.grid.dims) / CELLS
    axis = np.abs(dealt.normals).argmax(axis=1)
    facing = axis + 3 * (dealt.normals[np.arange(POINTS), axis] < 0)
    for z, y, x in [(0, 0, 0), (3, 4, 5), (7, 1, 2)]:
        center = (np.array([x, y, z]) + 0.5) * side
        for which in range(6):
            own = np.flatnonzero(facing == which)
            best = own[np.linalg.norm(dealt.points[own] - center, axis=1).argmin()]
            assert dealt.nearest[z, y, x, which] == best


def test_points_are_lit_as_pixels_are(device: Device, engine: Engine) -> None:
    """In the open a point sends albedo times the shading of its normal, in closed form."""
    light = lights.lobe_and_sky((0.6, 0.7, 0.2))
    objects = [placed(engine, box((0.45, 0.45, 0.45), (0.5, 0.5, 0.5)), (0.2, 0.5, 0.8))]
    volume, rays = fill_volume(engine, (floor(-0.5),), VOXEL_M), direction_sets(81, 4)
    device_light = upload_light(engine, light, rays)
    point_lights = light_points(engine, trace_scene(engine, volume, device_light, rays, ROOM_M, objects))
    radiances = download4(engine, point_lights.radiances)[:, :3]
    normals = objects[0][0].surface_points.normals
    expected = np.array([0.2, 0.5, 0.8]) * np.maximum(lambert_transfer(normals, 4) @ light, 0.0)
    np.testing.assert_allclose(radiances, expected, atol=relative_tolerance(device) * expected.max())


def test_a_sheet_has_points_on_both_sides(engine: Engine) -> None:
    sheet = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]], [[0, 1, 2], [0, 2, 3]])
    dealt = VirtualObject.upload(engine, shape_of(sheet)).surface_points
    assert dealt.points.shape == (2 * POINTS, 3)
    np.testing.assert_allclose(dealt.normals[:POINTS], -dealt.normals[POINTS:])


# ---- what real surfaces send one another -------------------------------------------------------------------------

CAMERA = CameraModel(width=61, height=49, fx=45.0, fy=45.0, cx=31.5, cy=23.5)
CORNER = SCENES["floor under a wall"]  # y = 0.1 and z = 0.2
FLOOR_RATIO = np.array([0.5, 0.8, 1.4])
SHADED = 0.8


def bounced_wall(
    engine: Engine, stride: int, color: ArrayLike = WHITE, spare: float = 0.0
) -> tuple[Floats, Floats, Floats]:
    """Ratios [rows, cols, 4] of a corner where the floor's alone was FLOOR_RATIO, the samples' points and normals.

    R is SHADED everywhere, and every surface sends 1.
    """
    view = look_at((0.48, 0.5, 0.9), (0.48, 0.2, 0.2))
    volume, rays = fill_volume(engine, CORNER, VOXEL_M), direction_sets(81, 4)
    paint(engine, volume, np.broadcast_to(np.asarray(color, float), (*voxels_of(volume), 3)))
    surface = seen_surface(engine, volume, CAMERA, view)
    transfer = transfer_radiance(engine, CAMERA, volume, surface, stride, rays, ROOM_M)
    at = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    points, normals = (download4(engine, a)[at].astype(float) for a in (surface.positions, surface.normals))
    is_floor = np.abs(points[..., 1] - 0.1) < VOXEL_M
    ratio = np.where(is_floor[..., None], FLOOR_RATIO, 1.0)
    valid = (points[..., 3] > 0).astype(float)
    shaded = engine.workspace.upload("test_shaded", float4(np.full_like(ratio, SHADED), valid))
    hits = engine.workspace.upload("test_hits", float4(np.ones_like(ratio), valid))
    shadow = RealShadow(stride, engine.workspace.upload("test_ratio", float4(ratio, valid)), shaded)
    light = upload_light(engine, lights.uniform(), rays, indirect=Indirect(hits, np.ones(3)))
    gather_hits(engine, CAMERA, volume, surface, transfer, rays, ROOM_M)
    met = room_for_met(engine, transfer, rays)
    traced = trace_scene(engine, volume, light, rays, ROOM_M, [])
    returned = float(np.abs(FLOOR_RATIO - 1).max())
    bounced = bounce_real(engine, CAMERA, inverse_rigid(view), surface, transfer, traced, shadow, met, returned, spare)
    return download4(engine, bounced.values).astype(float), points, normals[..., :3]


def seen_floor(points: Floats, normals: Floats) -> tuple[Floats, Floats]:
    """[n] of the cosine-weighted sky of points, the share that is floor in the picture, and that is any surface."""
    rays = spherical_fibonacci(4000)
    shown, hidden = [], []
    camera_from_volume = inverse_rigid(look_at((0.48, 0.5, 0.9), (0.48, 0.2, 0.2)))
    for point, normal in zip(points, normals, strict=True):
        cosine = np.maximum(rays @ normal, 0)
        t = hit(CORNER, np.tile(point + VOXEL_M * normal, (len(rays), 1)), rays)
        met = point + np.where(np.isfinite(t), t, 0)[:, None] * rays
        met_in = np.isfinite(t) & (np.abs(met - SIDE_M / 2) < SIDE_M / 2).all(axis=1)
        seen = met @ camera_from_volume[:3, :3].T + camera_from_volume[:3, 3]
        pixel = seen[:, :2] / np.maximum(seen[:, 2:], 1e-6) * 45 + [31.5, 23.5]
        inside = (seen[:, 2] > 0.01) & (np.abs(pixel - [31.5, 23.5]) < [32, 24]).all(axis=1)
        is_floor = np.abs(met[:, 1] - 0.1) < 2 * VOXEL_M
        shown.append((cosine * (met_in & inside & is_floor)).sum() / cosine.sum())
        hidden.append((cosine * met_in).sum() / cosine.sum())
    return np.array(shown), np.array(hidden)


@KINDS
@pytest.mark.parametrize("stride", [1, 4])
def test_a_wall_loses_what_a_shadowed_floor_sends_less(device: Device, kind: type[Engine], stride: int) -> None:
    """R falls by the floor's share of the sky times the floor's own loss."""
    ratio, points, normals = bounced_wall(kind(device), stride)
    is_wall = (points[..., 3] > 0) & (normals[..., 2] > 0.9) & (np.abs(points[..., 0] - 0.48) < 0.2)
    is_wall &= points[..., 1] < 0.45
    chosen = np.argwhere(is_wall)[:: max(1, is_wall.sum() // 150)]
    shown, _ = seen_floor(*(a[chosen[:, 0], chosen[:, 1], :3] for a in (points, normals)))
    lost = SHADED * (1 - ratio[chosen[:, 0], chosen[:, 1], :3])
    assert shown.max() > 0.15
    for channel, change in enumerate(1 - FLOOR_RATIO):
        slope = (lost[:, channel] @ shown) / (shown @ shown)
        assert slope == pytest.approx(change, rel=0.1, abs=0.01)  # single samples follow some five directions
    floor_rows = (points[..., 3] > 0) & (normals[..., 1] > 0.9) & (points[..., 2] > 0.5)
    change = ratio[floor_rows][:, :3] - FLOOR_RATIO
    assert np.abs(change).mean() < 0.005  # the wall sends it what it did; only its foot passes for the floor's
    assert np.median(np.abs(change)) < 1e-6


def test_an_underside_loses_what_a_shadowed_floor_sends_less(engine: Engine) -> None:
    """A white plate, under a light and over surface that send 1: each point loses its share of the floor's loss."""
    view = look_at((0.48, 0.5, 0.9), (0.48, 0.2, 0.2))
    volume, rays = fill_volume(engine, CORNER, VOXEL_M), direction_sets(81, 4)
    paint(engine, volume, np.ones((*voxels_of(volume), 3)))
    surface = seen_surface(engine, volume, CAMERA, view)
    positions = download4(engine, surface.positions)
    is_floor = np.abs(positions[..., 1:2] - 0.1) < VOXEL_M
    ratio = engine.workspace.upload("test_ratio", float4(np.where(is_floor, FLOOR_RATIO, 1.0), positions[..., 3]))
    changed = Changed(CAMERA, inverse_rigid(view), surface.positions, SampleGrid(1, ratio))
    hits = engine.workspace.upload("test_hits", float4(np.ones((*positions.shape[:2], 3)), positions[..., 3]))
    light = upload_light(engine, lights.uniform(), rays, indirect=Indirect(hits, np.ones(3)))
    traced = trace_scene(engine, volume, light, rays, ROOM_M, [placed(engine, PLATE)])
    before, after = (
        download4(engine, light_points(engine, replace(traced, changed=change)).radiances)[:, :3].astype(float)
        for change in (None, changed)
    )
    placed_points = place_points(engine, traced.objects)
    points, normals = (
        download4(engine, a)[: placed_points.count, :3].astype(float)
        for a in (placed_points.points, placed_points.normals)
    )
    down = normals[:, 1] < -0.9
    shown, _ = seen_floor(points[down], normals[down])
    assert shown.max() > 0.5
    lost = before[down] - after[down]
    for channel, change in enumerate(1 - FLOOR_RATIO):
        slope = (lost[:, channel] @ shown) / (shown @ shown)
        assert slope == pytest.approx(change, rel=0.1)
    up = normals[:, 1] > 0.9
    np.testing.assert_allclose(before[up], after[up], atol=1e-3)  # but for the wall's foot


def test_a_dark_floor_has_nothing_to_lose(engine: Engine) -> None:
    ratio, points, normals = bounced_wall(engine, 4, (0.0, 0.0, 0.0))
    is_wall = (points[..., 3] > 0) & (normals[..., 2] > 0.9)
    np.testing.assert_array_equal(ratio[is_wall][:, :3], 1.0)


def test_what_may_be_spared_follows_nothing_and_changes_no_more(engine: Engine) -> None:
    """Far up the wall little of the floor is seen; below it is most of what there is."""
    spare = 0.1
    every, points, normals = (a.copy() for a in bounced_wall(engine, 4))
    some, _, _ = bounced_wall(engine, 4, spare=spare)
    is_wall = (points[..., 3] > 0) & (normals[..., 2] > 0.9)
    followed = (some[is_wall] == every[is_wall])[:, :3].all(axis=1)
    left = (some[is_wall] == 1)[:, :3].all(axis=1)
    assert (followed | left).all()
    assert followed.sum() > 10
    assert (left & ~followed).sum() > 10
    assert np.abs(some - every)[is_wall].max() <= spare
    np.testing.assert_array_equal(every[~is_wall][:, 3], some[~is_wall][:, 3])


def test_of_very_many_things_the_first_are_lit_one_by_one(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    """The others send what an even light of the same mean makes of them."""
    colors = [(0.2, 0.5, 0.8), (0.9, 0.1, 0.4)]
    cubes = [box((0.2 + 0.3 * k, 0.45, 0.45), (0.25 + 0.3 * k, 0.5, 0.5)) for k in range(2)]
    objects = [placed(engine, cube, color) for cube, color in zip(cubes, colors, strict=True)]
    volume, rays = fill_volume(engine, (floor(-0.5),), VOXEL_M), direction_sets(81, 4)
    light = lights.lobe_and_sky((0.6, 0.7, 0.2))
    traced = trace_scene(engine, volume, upload_light(engine, light, rays), rays, ROOM_M, objects)
    every = download4(engine, light_points(engine, traced).radiances)[:, :3].copy()
    monkeypatch.setattr(differential_rendering, "MOST_POINTS", POINTS)
    some = download4(engine, light_points(engine, traced).radiances)[:, :3]
    np.testing.assert_array_equal(some[:POINTS], every[:POINTS])
    np.testing.assert_allclose(some[POINTS:], np.tile(light[0] * 0.2820948 * colors[1], (POINTS, 1)), rtol=1e-4)
