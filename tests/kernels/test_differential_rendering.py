"""Differential rendering against its float64 twin, between two closed-form occluders, and brute-force integrals.

A ray that only grazes an object may go either way, so the shading must lie between that of a box grown by a cell and of
the box itself: no share of rays is left unchecked.
"""

from __future__ import annotations

import numpy as np
import pyopencl.cltypes as cl_types
import pytest

from server.objects.rasterize import VirtualSurface
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.shading.differential_rendering import shadow_real, shadow_virtual
from server.shading.traced_scene import trace_scene, upload_light
from server.transfer.indirect import Indirect
from server.transfer.radiance_transfer import direction_sets, transfer_radiance
from server.transfer.sample_grid import SampleGrid
from tests.reference import differential_rendering as twin
from tests.reference.sh import open_transfer, sh_basis
from tests.scenes import lights
from tests.scenes.shaded_floor import (
    FAR_M,
    FLOOR,
    LIGHT,
    PLATE,
    STRIDE,
    UP,
    VOXEL_M,
    Floats,
    buffer,
    camera_of,
    floor_points,
    placed,
    shade_floor,
)
from tests.scenes.solids import Ball, Box, Scene, ball, box, download4, fill_volume, float4, floor, hit, upload_surface
from tests.scenes.tolerance import relative_tolerance

LIGHTS = {"uniform": lights.uniform((1.0, 0.5, 2.0)), "directional": LIGHT, "from below": lights.lobe((0.1, -1, 0.1))}


# ---- shadows on real surfaces ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LIGHTS)
@pytest.mark.parametrize(("rays", "bands"), [(81, 4), (169, 4), (32, 2)])
def test_ratio_is_the_twins(device: Device, engine: Engine, name: str, rays: int, bands: int) -> None:
    shaded = shade_floor(engine, PLATE, LIGHTS[name][: bands * bands], rays=rays)
    least, most = (shaded.expected(PLATE, grown) for grown in (1.05 * shaded.cell_m, 0.0))
    tolerance = relative_tolerance(device)
    np.testing.assert_array_equal(shaded.ratio[..., 3], 1)
    assert (shaded.ratio[..., :3] >= least[..., :3] - tolerance).all()
    assert (shaded.ratio[..., :3] <= most[..., :3] + tolerance).all()
    decided = (most - least)[..., :3].max(-1) == 0
    assert decided.mean() > 0.3
    if name == "directional":
        assert (shaded.ratio[decided][:, 0] < 0.9).sum() > 5


def test_real_shadow_is_not_cast_twice(engine: Engine) -> None:
    """Under a real ceiling larger than the plate the sky's middle is gone already: the plate takes less."""
    ceiling = box((0.3, 0.4, 0.3), (0.66, 0.44, 0.66))
    below = np.tile([0.48, 0.1, 0.48], (576, 1))
    light = lights.uniform()
    open_sky, covered = (
        shade_floor(engine, PLATE, light, scene=scene, rays=1024, points=below)
        for scene in ((floor(),), (floor(), ceiling))
    )
    taken = [(1 - s.ratio[..., 0]) * (s.transfer @ light)[..., 0] for s in (open_sky, covered)]
    assert taken[0].mean() == pytest.approx(sky_behind(PLATE.grown(0.5 * open_sky.cell_m), below[0]), rel=0.03)
    assert taken[1].mean() < 0.1 * taken[0].mean()


def sky_behind(solid: Box | Ball, point: Floats) -> float:
    """Share of an upward point's cosine-weighted sky behind a box: dense directions, closed-form rays."""
    random = np.random.default_rng(1)
    radius, azimuth = np.sqrt(random.random(400_000)), 2 * np.pi * random.random(400_000)  # density cos / pi
    rays = np.stack([radius * np.cos(azimuth), np.sqrt(1 - radius**2), radius * np.sin(azimuth)], -1)
    return float(np.isfinite(solid.hit(np.tile(point, (len(rays), 1)), rays)).mean())


def test_ratio_matches_a_brute_force_integral(engine: Engine) -> None:
    """R' / R = 1 - (integral of L cos / pi over the plate's solid angle) / R, L from the light's 16 coefficients."""
    shaded = shade_floor(engine, PLATE, rays=1024)
    plate = PLATE.grown(0.5 * shaded.cell_m)  # blocks up to half a cell beside it
    random = np.random.default_rng(2)
    radius, azimuth = np.sqrt(random.random(100_000)), 2 * np.pi * random.random(100_000)
    rays = np.stack([radius * np.cos(azimuth), np.sqrt(1 - radius**2), radius * np.sin(azimuth)], -1)
    arriving = sh_basis(rays, 4) @ LIGHT
    without = open_transfer(UP, 4) @ LIGHT
    errors = []
    for row, col in [(12, 12), (12, 8), (12, 10), (8, 12), (10, 9), (4, 4), (20, 20), (13, 6)]:
        origins = np.tile(shaded.points[row, col], (len(rays), 1))
        taken = (np.isfinite(plate.hit(origins, rays))[:, None] * arriving).mean(0)
        errors.append(shaded.ratio[row, col, :3] - (1 - taken / without))
    # 1024 directions over the sphere, one set a sample: each stands for 0.4 % of the sky at the zenith, and the plate's
    # outline crosses some twenty of them.
    assert np.abs(errors).max() < 0.02
    assert np.sqrt(np.mean(np.square(errors))) < 0.008


def test_beside_where_it_stands_a_ball_takes_only_what_is_above(engine: Engine) -> None:
    """A voxel off the floor these points would lie inside it; closed-form rays from the floor itself."""
    standing, away_m = ball((0.48, 0.2, 0.48), 0.1), 0.035
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.array([0.48, 0.1, 0.48]) + away_m * np.stack([np.cos(turn), 0 * turn, np.sin(turn)], -1)
    shaded = shade_floor(engine, standing, lights.uniform(), rays=1024, points=np.tile(ring, (24, 1)))
    assert np.linalg.norm(ring[0] + VOXEL_M * UP - standing.center) < standing.radius
    hidden = [sky_behind(standing.grown(grown), ring[0]) for grown in (0.0, 0.72 * shaded.cell_m)]
    taken = 1 - shaded.ratio[..., 0].mean()
    assert hidden[0] < 0.9
    assert hidden[0] - 0.03 < taken < hidden[1] + 0.03


def test_shadow_lies_away_from_the_light(engine: Engine) -> None:
    for toward in ((0.7, 0.7, 0.0), (0.0, 0.7, -0.7), (-0.5, 0.7, 0.5)):
        shaded = shade_floor(engine, PLATE, lights.lobe_and_sky(toward), points=floor_points(0.0, 0.96))
        dark = np.maximum(1 - shaded.ratio[..., 1], 0)
        middle = (dark[..., None] * shaded.points).sum((0, 1)) / dark.sum()
        # Of a far disc the shadow's middle would lie 0.2 m off; a lobe as wide as the sky draws it nearer.
        away = middle - [0.48, 0.1, 0.48]
        assert away @ lights.unit([-toward[0], 0, -toward[2]]) > 0.01
        assert abs(away @ np.cross(lights.unit([toward[0], 0, toward[2]]), UP)) < 0.01


def test_far_object_leaves_exactly_one(engine: Engine) -> None:
    for solid in (box((3, 5, 3), (3.2, 5.2, 3.2)), box((0.4, 0.3, -40), (0.5, 0.4, -39.9))):
        shaded = shade_floor(engine, solid, ray_length_m=2.0)
        np.testing.assert_array_equal(shaded.ratio, 1.0)


def test_object_below_the_surface_casts_nothing(engine: Engine) -> None:
    shaded = shade_floor(engine, box((0.3, 0.0, 0.3), (0.6, 0.08, 0.6)))
    np.testing.assert_array_equal(shaded.ratio, 1.0)


@pytest.mark.parametrize("light", [np.zeros((16, 3)), lights.lobe((0, -1, 0)), -LIGHT, lights.uniform((1, 0, 0))])
def test_ratio_is_bounded_whatever_the_light(engine: Engine, light: Floats) -> None:
    ratio = shade_floor(engine, PLATE, light).ratio
    assert np.isfinite(ratio).all()
    assert (ratio >= 0).all()
    if (light >= 0).all():
        assert (ratio[..., :3] <= 1).all()


def test_rough_normals_do_not_brighten(engine: Engine) -> None:
    """Free directions are those above the smoothed normal; some lie below a rough pixel's own."""
    low = box((0.7, 0.11, 0.1), (0.72, 0.15, 0.86))
    ratio = shade_floor(engine, low, lights.uniform(), rays=324, roughness=0.2).ratio
    assert (ratio[..., :3] <= 1).all()
    assert (ratio[..., :3] < 1).any()


def test_no_surface_has_no_ratio(engine: Engine) -> None:
    positions, normals = buffer(floor_points(side=8), UP, (8, 8), STRIDE)
    valid = np.zeros(positions.shape[:2], bool)
    valid[:12] = True
    camera, rays = camera_of(positions), direction_sets(81, 4)
    surface = upload_surface(engine, positions[..., :3], normals[..., :3], valid)
    volume = fill_volume(engine, (floor(),), VOXEL_M)
    transfer = transfer_radiance(engine, camera, volume, surface, STRIDE, rays, FAR_M)
    objects = [placed(engine, PLATE)]
    traced = trace_scene(engine, volume, upload_light(engine, LIGHT, rays), rays, FAR_M, objects)
    ratio = shadow_real(engine, camera, surface, transfer, traced)
    np.testing.assert_array_equal(download4(engine, ratio.values)[..., 3], np.repeat([1, 0], 4)[:, None] * np.ones(8))


@pytest.mark.parametrize("solid", [PLATE, box((3, 5, 3), (3.2, 5.2, 3.2))], ids=["plate", "far"])
def test_shading_is_the_twins_wherever_objects_are(device: Device, engine: Engine, solid: Box) -> None:
    """R has what hidden directions send at every sample, whether objects take something there or not."""
    wall = box((-1.0, -1.0, -1.0), (0.3, 2.0, 2.0))
    points = floor_points(0.32, 0.86, 16)
    positions, normals = buffer(points, UP, (16, 16), STRIDE)
    camera, rays, volume = camera_of(positions), direction_sets(81, 4), fill_volume(engine, (*FLOOR, wall), VOXEL_M)
    surface = upload_surface(engine, positions[..., :3], normals[..., :3], positions[..., 3] > 0)
    transfer = transfer_radiance(engine, camera, volume, surface, STRIDE, rays, FAR_M)
    random = np.random.default_rng(4)
    hits = random.uniform(0.0, 8.0, (16, 16, 4))
    hits[3] = 0.0  # nothing was met there
    unseen, gain = np.array([0.4, 0.1, 0.2]), 1.5
    on_device = engine.workspace.upload("test_hits", float4(hits[..., :3], hits[..., 3]))
    indirect = Indirect(on_device, unseen)
    light = upload_light(engine, LIGHT / gain, rays, indirect, gain)
    traced = trace_scene(engine, volume, light, rays, FAR_M, [placed(engine, solid)])
    found = download4(engine, shadow_real(engine, camera, surface, transfer, traced, indirect).shaded)
    coefficients, openness = (engine.download(a).astype(float) for a in (transfer.coefficients, transfer.openness))
    expected = np.zeros((16, 16, 3))
    for row, col in np.ndindex(16, 16):
        expected[row, col] = twin.shading_without(
            81, coefficients[row, col], LIGHT, openness[row, col], hits[row, col], gain * unseen, gain
        )
    assert 0.02 < (1 - openness).min() < 0.2 < (1 - openness).max()
    np.testing.assert_allclose(found[..., :3], expected, atol=20 * relative_tolerance(device) * expected.max())


# ---- shadows on virtual surfaces ---------------------------------------------------------------------------------

OVERHANG = box((0.3, 0.5, 0.3), (0.66, 0.6, 0.66))
TABLE_TOP = box((0.2, 0.2, 0.2), (0.76, 0.22, 0.76))


def shade_top(
    engine: Engine, scene: Scene, solids: list[Box], light: Floats, rays: int = 81
) -> tuple[Floats, Floats, Floats, float]:
    """Occluded radiance [rows, cols, 4] on top of the first solid, its geometry buffer, and its cells' side."""
    x, z = np.meshgrid(np.linspace(0.25, 0.71, 20), np.linspace(0.25, 0.71, 20))
    points = np.stack([x, np.full_like(x, solids[0].high[1]), z], -1)
    positions, normals = buffer(points.reshape(-1, 3), UP, (20, 20), 2)
    valid = np.zeros(positions.shape[:2], bool)
    valid[4:] = True
    positions[~valid], normals = 0, np.where(valid[..., None], normals, 0)
    space = engine.workspace
    covered = valid.astype(np.float64)
    surface = VirtualSurface(
        space.upload("virtual_positions", float4(positions[..., :3], covered)),
        space.upload("virtual_normals", float4(normals[..., :3], covered)),
        space.upload("virtual_colors", float4(0.5 * np.ones((*valid.shape, 3)), covered)),
        space.upload("virtual_index", np.where(valid, 0, -1).astype(np.int32)),
        ((0, 4, valid.shape[1], valid.shape[0]),),
    )
    directions = direction_sets(rays, 4)
    device_light = upload_light(engine, light, directions)
    objects, volume = [placed(engine, solid) for solid in solids], fill_volume(engine, scene, VOXEL_M)
    traced = trace_scene(engine, volume, device_light, directions, FAR_M, objects)
    found: SampleGrid = shadow_virtual(engine, camera_of(positions), surface, traced)
    return download4(engine, found.values), positions, normals, max(traced.table.cell_m)


@pytest.mark.parametrize("name", ["uniform", "directional"])
def test_occlusion_is_the_twins(device: Device, engine: Engine, name: str) -> None:
    beside = box((0.3, 0.25, 0.3), (0.4, 0.4, 0.4))
    scene, light, rays = (OVERHANG,), LIGHTS[name], direction_sets(81, 4)
    occluded, positions, normals, cell_m = shade_top(engine, scene, [TABLE_TOP, beside], light)

    def expected(objects_m: float, volume_m: float) -> Floats:
        return twin.shadow_virtual(
            positions,
            normals,
            2,
            rays.directions.astype(float),
            rays.basis.astype(float) @ light,
            cell_m,
            VOXEL_M,
            lambda o, d: ~np.isfinite(np.minimum(TABLE_TOP.hit(o, d), hit([beside], o, d, objects_m))),
            lambda o, d: ~np.isfinite(hit(scene, o, d, volume_m)),
        )

    most, least = expected(1.05 * cell_m, 0.87 * VOXEL_M), expected(0.0, -1.31 * VOXEL_M)
    tolerance = relative_tolerance(device) * np.abs(light).max()
    np.testing.assert_array_equal(occluded[..., 3], most[..., 3])
    assert not occluded[occluded[..., 3] == 0].any()
    assert (occluded[..., :3] <= most[..., :3] + tolerance).all()
    assert (occluded[..., :3] >= least[..., :3] - tolerance).all()
    assert least[..., 0].max() > 0.1


def test_real_surface_that_it_touches_takes_its_own_half_alone(engine: Engine) -> None:
    """A slope that leans towards a wall 2 mm away: rays that begin a voxel off it would begin in the wall."""
    wall, normal = box((0.5, -1.0, -1.0), (2.0, 2.0, 2.0)), lights.unit([1.0, 1.0, 0.0])
    points = np.full((1600, 3), (0.498, 0.4, 0.48))
    points[:, 1] += np.linspace(0, 0.2, 1600)
    occluded = shade_points(engine, (wall,), points.reshape(40, 40, 3), normal)
    random = np.random.default_rng(1)
    rays = lights.unit(random.normal(size=(100_000, 3)))
    shares = np.maximum(rays @ normal, 0)
    hidden = shares[rays[:, 0] > 0].sum() / shares.sum()
    assert 0.8 < hidden < 0.9  # the wall's share of the slope's sky
    assert occluded[..., 0].mean() == pytest.approx(hidden, abs=0.03)


def shade_points(engine: Engine, scene: Scene, points: Floats, normal: Floats) -> Floats:
    """Radiance [20, 20, 4] that `scene` takes of an even sky of 1 from virtual points [40, 40, 3]."""
    space, covered = engine.workspace, np.ones(points.shape[:2])
    surface = VirtualSurface(
        space.upload("virtual_positions", float4(points, covered)),
        space.upload("virtual_normals", float4(np.broadcast_to(normal, points.shape), covered)),
        space.upload("virtual_colors", float4(0.5 * np.ones(points.shape), covered)),
        space.upload("virtual_index", np.zeros(points.shape[:2], np.int32)),
        ((0, 0, 40, 40),),
    )
    directions = direction_sets(81, 4)
    device_light, volume = upload_light(engine, lights.uniform(), directions), fill_volume(engine, scene, VOXEL_M)
    far = [placed(engine, box((5, 5, 5), (5.1, 5.1, 5.1)))]
    traced = trace_scene(engine, volume, device_light, directions, FAR_M, far)
    return download4(engine, shadow_virtual(engine, camera_of(points), surface, traced).values)


def test_real_overhang_darkens_what_is_below(engine: Engine) -> None:
    """Under an even sky of 1 the radiance taken is the overhang's share of the sky: closed form."""
    light = lights.uniform()
    occluded, positions, _, _ = shade_top(engine, (OVERHANG,), [TABLE_TOP], light, rays=1024)
    for row, col in [(10, 10), (10, 4), (3, 3), (18, 10)]:
        near = occluded[row : row + 2, col : col + 2, 0].mean()  # the four direction sets
        point = (
            positions[2 * row : 2 * row + 4 : 2, 2 * col : 2 * col + 4 : 2, :3].reshape(-1, 3).mean(0) + VOXEL_M * UP
        )
        assert near == pytest.approx(sky_behind(OVERHANG, point), abs=0.02)  # half a voxel of outline at 0.3 m: 1 %
    assert occluded[10, 10, 0] > 1.5 * occluded[3, 3, 0]


def test_open_virtual_surface_loses_nothing(engine: Engine) -> None:
    occluded, *_ = shade_top(engine, (floor(),), [TABLE_TOP], LIGHT)
    np.testing.assert_array_equal(occluded[..., :3], 0)


def test_arriving_light_is_the_lights_radiance(engine: Engine) -> None:
    rays = direction_sets(81, 4)
    light = upload_light(engine, LIGHT, rays)
    exact = sh_basis(rays.directions[..., :3].astype(float), 4) @ LIGHT
    arriving, coefficients = (light.table.array(part) for part in ("arriving", "coefficients"))
    np.testing.assert_allclose(download4(engine, arriving)[0, ..., :3], exact, atol=2e-6)
    np.testing.assert_allclose(download4(engine, coefficients)[0, :, :3], LIGHT, rtol=1e-6, atol=1e-12)
    assert coefficients.dtype == cl_types.float4
