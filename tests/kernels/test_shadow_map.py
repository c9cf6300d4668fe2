"""Shadow maps against their float64 twin, and against the exact light of a disc past a box, a ball and a wall."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from server.effects import functions as effects
from server.maths.direct_lights import DirectLight, SplitLight, split_light
from server.maths.directional_fit import directional_sh
from server.maths.disc_places import disc_places, ray_places, search_places
from server.objects.rasterize import VirtualSurface
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.shading.differential_rendering import DirectSamples, RealShadow, bounce_real, shadow_real
from server.shading.shadow_map import (
    MAP_SIDE,
    ShadowMaps,
    draw_shadow_maps,
    light_points_by_discs,
    light_real,
    light_samples,
    light_virtual,
    most_irradiance,
    trace_real,
)
from server.shading.traced_scene import DeviceLight, trace_scene, upload_light
from server.shading.virtual_point_lights import place_points
from server.transfer.indirect import MeanSent, gather_hits, observe_indirect
from server.transfer.radiance_transfer import Directions, direction_sets, transfer_radiance
from server.transfer.sample_grid import SampleGrid
from tests.reference import shadow_map as twin
from tests.scenes import glossy_surface, lights
from tests.scenes.contexts import context_of
from tests.scenes.lanes import KINDS, Narrow, Wide
from tests.scenes.painted_walls import WALL as WALL_COLOR
from tests.scenes.painted_walls import floor_beside_a_wall, wall_seen_from
from tests.scenes.shaded_floor import camera_of, placed
from tests.scenes.solids import (
    SIDE_M,
    Ball,
    Box,
    Scene,
    ball,
    box,
    download4,
    fill_volume,
    float4,
    floor,
    hit,
    upload_surface,
)
from tests.scenes.tolerance import relative_tolerance

VOXEL_M, FAR_M = 0.01, 1000.0
UP = np.array([0.0, 1.0, 0.0])
FLOOR_Y = 0.1
FLOOR: Scene = (floor(FLOOR_Y),)
CRATE = box((0.38, 0.1, 0.4), (0.54, 0.26, 0.52))
FLIPS = 0.01
"""Share of points that may differ from the twin: a look-up on the border of two texels takes either. Seen: none."""
TOWARD = lights.unit((0.5, 0.8, 0.15))
BEHIND = lights.unit((-0.3, 0.6, 0.6))

Floats = NDArray[np.float64]


def disc(half_angle_deg: float, toward: ArrayLike = TOWARD, color: ArrayLike = (1.0, 1.0, 1.0)) -> DirectLight:
    return DirectLight(lights.unit(toward), np.asarray(color, float), float(np.radians(half_angle_deg)))


def lamp(center_m: ArrayLike, radius_m: float, color: ArrayLike = (1.0, 1.0, 1.0)) -> DirectLight:
    """A disc at a place, its irradiance as it is one metre off."""
    angle = float(np.arctan(radius_m))
    return DirectLight(UP, np.asarray(color, float), angle, np.asarray(center_m, float), 1.0)


LAMP_M = np.array([0.7, 0.75, 0.3])
"""Half a metre from the crate: the direction to it differs by 30 degrees from one side of the crate to the other."""


@dataclass(frozen=True)
class Lit:
    """Maps of a scene, ready to light surfaces."""

    engine: Engine
    maps: ShadowMaps

    def reference(self, light: int = 0) -> twin.Disc:
        """The twin with the same finest map."""
        count = len(self.maps.light.discs)
        texels = self.engine.download(self.maps.objects)[:count].view(np.float32).reshape(count, -1, 2)
        level = texels[light, : MAP_SIDE**2].astype(float).reshape(MAP_SIDE, MAP_SIDE, 2)
        rows = download4(self.engine, self.maps.rows).astype(float)[light]
        return twin.Disc(
            twin.pyramid(level[..., 0] > 0, level[..., 1]),
            rows[:3, :3],
            rows[2, 3],
            self.maps.ball,
            search_places(),
            disc_places(),
            rows[0, 3],
            rows[1, 3],
        )

    def floor(self, points: Floats, normal: ArrayLike = UP) -> tuple[Floats, Floats]:
        """[n, 3] what discs bring to real points without and with the objects."""
        side = (8, max(-(-len(points) // 8), 8))
        positions = np.resize(points, (*side, 3))  # a picture's least height; the last are the first again
        normals = np.broadcast_to(np.asarray(normal, float), positions.shape)
        surface = upload_surface(self.engine, positions, normals, np.ones(side, bool))
        samples = SampleGrid(1, self.engine.workspace.upload("ones", float4(np.ones((*side, 3)))))
        camera = camera_of(positions)
        parts = trace_real(self.engine, camera, surface, samples, self.maps)
        found = light_samples(self.engine, camera, surface, parts, self.maps)
        both = (download4(self.engine, a)[..., :3] for a in (found.without, found.with_objects))
        without, past = (a.reshape(-1, 3)[: len(points)].astype(float) for a in both)
        return without, past

    def virtual(self, points: Floats, normals: Floats) -> Floats:
        """[h, w, 3] what they bring to points [h, w, 3] on the objects."""
        space, covered = self.engine.workspace, np.ones(points.shape[:2])
        covered[0, 0] = 0
        position, normal = (space.upload(n, float4(a, covered)) for n, a in (("v_p", points), ("v_n", normals)))
        unused = space.array("unused", (1,), np.float32)
        surface = VirtualSurface(position, normal, unused, unused, ((0, 0, *covered.shape[::-1]),))
        return download4(self.engine, light_virtual(self.engine, camera_of(points), surface, self.maps)).astype(float)


def lit(
    engine: Engine,
    *discs: DirectLight,
    solids: tuple[Box | Ball, ...] = (CRATE,),
    scene: Scene = FLOOR,
    ray_length_m: float = FAR_M,
) -> Lit:
    rays, volume = direction_sets(81, 4), fill_volume(engine, scene, VOXEL_M)
    light = upload_light(engine, lights.uniform(), rays, split=SplitLight(lights.uniform(), discs))
    objects = [placed(engine, solid) for solid in solids]
    return Lit(engine, draw_shadow_maps(engine, volume, light, objects, ray_length_m))


def floor_points(count: int = 300, seed: int = 1, around: float = 0.3) -> Floats:
    random = np.random.default_rng(seed)
    points = np.array([0.46, 0.0, 0.46]) + random.uniform(-around, around, (count, 3))
    points[:, 1] = FLOOR_Y
    return points


def exact(points: Floats, light: DirectLight, solids: Scene, normal: ArrayLike = UP, lift_m: float = 1e-6) -> Floats:
    """[n] what reaches white points past `solids`, over the disc's irradiance."""
    normal = np.asarray(normal, float)
    return twin.irradiance(
        points + lift_m * normal,
        normal,
        light.direction,
        light.half_angle_rad,
        lambda o, d: hit(solids, o, d) == np.inf if solids else np.ones(len(o), bool),
    )


# ---- against the twin --------------------------------------------------------------------------------------------


@KINDS
def test_pyramid_and_free_parts_are_the_twins(device: Device, kind: type[Engine]) -> None:
    engine = kind(device)
    light = disc(12.0), disc(25.0, BEHIND, (0.2, 0.5, 1.0))
    scene = lit(engine, *light, solids=(CRATE, ball((0.62, 0.22, 0.5), 0.08)))
    texels = engine.download(scene.maps.objects)[:2].view(np.float32).reshape(2, -1, 2).astype(float)
    references = [scene.reference(k) for k in range(2)]
    for found, reference in zip(texels, references, strict=True):
        expected = np.concatenate([np.stack(level, -1).reshape(-1, 2) for level in reference.levels])
        np.testing.assert_allclose(found, expected, atol=1e-5)  # means of floats, four at a time
    points = floor_points(200)
    without, found = scene.floor(points)
    opens = [float(r.open_part(UP[None])[0]) for r in references]
    free = np.array([[r.free_part(p, UP, False) for r in references] for p in points])
    colors = np.array([d.irradiance for d in light])
    np.testing.assert_allclose(without, np.tile(opens @ colors, (len(points), 1)), rtol=relative_tolerance(device))
    error = np.abs(found - (free * opens) @ colors).max(axis=1)
    assert 0.2 < (free < 1).any(axis=1).mean() < 0.9
    assert (error > 1e-4).mean() < FLIPS
    assert error.max() < 0.15


def test_virtual_surface_is_the_twins(engine: Engine) -> None:
    light = disc(20.0)
    scene = lit(engine, light, solids=(ball((0.46, 0.3, 0.46), 0.12), CRATE))
    normals = lights.random_directions(220, 3).reshape(10, 22, 3)
    points = [0.46, 0.3, 0.46] + 0.12 * normals
    found, reference = scene.virtual(points, normals)[..., :3], scene.reference()
    free = np.array(
        [reference.free_part(p, n, True) for p, n in zip(points.reshape(-1, 3), normals.reshape(-1, 3), strict=True)]
    )
    expected = (free * reference.open_part(normals.reshape(-1, 3))).reshape(10, 22)
    expected[0, 0] = 0  # not covered
    error = np.abs(found - expected[..., None]).max(axis=-1)
    assert (error > 1e-4).mean() < FLIPS
    assert error.max() < 0.15
    assert 0.2 < (expected > 0).mean() < 0.8


@KINDS
def test_a_near_disc_is_the_twins(device: Device, kind: type[Engine]) -> None:
    """On the floor and on a ball beside the crate, with a distant disc beside it."""
    engine = kind(device)
    light = lamp(LAMP_M, 0.06), disc(12.0)
    points = floor_points(200)
    scene = lit(engine, *light, solids=(CRATE, ball((0.62, 0.22, 0.5), 0.08)))
    references = [scene.reference(k) for k in range(2)]
    assert [r.inverse_m > 0 for r in references] == [True, False]
    without, found = scene.floor(points)
    opens = np.array([[float(r.open_part(UP[None], p)[0]) for r in references] for p in points])
    free = np.array([[r.free_part(p, UP, False) for r in references] for p in points])
    colors = np.array([d.seen_from(scene.maps.ball[:3]).irradiance for d in light])
    np.testing.assert_allclose(without, opens @ colors, rtol=2 * relative_tolerance(device))
    error = np.abs(found - (free * opens) @ colors).max(axis=1)
    assert 0.1 < (free[:, 0] < 1).mean() < 0.9
    assert (error > 1e-4 * colors.max()).mean() < FLIPS
    normals = lights.random_directions(220, 3).reshape(10, 22, 3)
    on_ball = [0.62, 0.22, 0.5] + 0.08 * normals
    shaded = scene.virtual(on_ball, normals)[..., 0]
    expected = [
        sum(
            c[0] * float(r.open_part(n[None], p)[0]) * r.free_part(p, n, True)
            for r, c in zip(references, colors, strict=True)
        )
        for p, n in zip(on_ball.reshape(-1, 3), normals.reshape(-1, 3), strict=True)
    ]
    wrong = np.abs(shaded - np.reshape(expected, shaded.shape))
    wrong[0, 0] = 0  # not covered
    assert (wrong > 1e-4 * colors.max()).mean() < FLIPS


@pytest.mark.parametrize(("radius_m", "bound"), [(0.01, 0.008), (0.05, 0.01), (0.12, 0.04)])
def test_floor_darkens_as_a_near_lamp_is_hidden(engine: Engine, radius_m: float, bound: float) -> None:
    """The shadow diverges from the lamp, and the light falls off, as the integral over its disc says; the same light
    from afar, as it is at the crate's middle, is far off. Seen, root mean square: 0.004, 0.005, 0.021."""
    light, points = lamp(LAMP_M, radius_m), floor_points(400)
    points = points[CRATE.distance(points) > 0.004]
    scene = lit(engine, light)
    middle = scene.maps.ball[:3]
    here = light.seen_from(middle)
    without, found = (a[:, 0] / here.irradiance[0] for a in scene.floor(points))

    def met_m(solids: Scene) -> Any:
        return lambda o, d: hit(solids, o, d) if solids else np.full(len(o), np.inf)

    true_without, true = (twin.near_irradiance(points + 1e-6 * UP, UP, light, middle, met_m(s)) for s in ((), (CRATE,)))
    np.testing.assert_allclose(without, true_without, rtol=1e-4)  # seen: 4e-5
    darker, right = 1 - found / without, 1 - true / true_without
    assert (right > 0.9).any()
    assert np.sqrt(np.mean((darker - right) ** 2)) < bound
    assert darker[right == 0].mean() < 0.005
    far, past = (a[:, 0] for a in lit(engine, replace(here, center_m=None)).floor(points))
    assert np.sqrt(np.mean((1 - past / far - right) ** 2)) > 0.1


def test_a_lamp_far_away_is_a_distant_disc(engine: Engine) -> None:
    points, toward = floor_points(300), lights.unit(TOWARD)
    near = lit(engine, DirectLight(toward, np.ones(3), 0.1, 1000.0 * toward, 1000.0)).floor(points)
    for found, expected in zip(near, lit(engine, disc(np.degrees(0.1))).floor(points), strict=True):
        error = np.abs(found - expected).max(axis=1)
        assert (error > 5e-3).mean() < 2 * FLIPS  # of 1000 m, 0.3 m are 3e-4; look-ups of two maps


@pytest.mark.parametrize("center_m", [(0.46, 0.18, 0.46), (0.46, 0.3, 0.46)], ids=["inside", "touching"])
def test_a_lamp_among_the_objects_still_lights(engine: Engine, center_m: tuple[float, float, float]) -> None:
    """Its map cannot be drawn: it is taken as distant, as it is at their middle."""
    without, found = lit(engine, lamp(center_m, 0.03)).floor(floor_points(60))
    assert np.isfinite(without).all()
    assert np.isfinite(found).all()
    assert (found <= without * (1 + 1e-6)).all()


def test_the_lamp_itself_and_what_is_behind_it_hide_nothing(engine: Engine) -> None:
    """Its own surface in the scan, above it a ceiling; a board half-way does hide it."""
    center = np.array([0.46, 0.7, 0.46])
    body = box((0.4, 0.68, 0.4), (0.52, 0.72, 0.52))
    board = box((0.3, 0.5, 0.3), (0.6, 0.54, 0.6))
    points = np.array([[0.3, FLOOR_Y, 0.46], [0.46, FLOOR_Y, 0.3], [0.42, FLOOR_Y, 0.42]])
    alone, there, hidden = (
        lit(engine, lamp(center, 0.03), scene=scene).floor(points)[0]
        for scene in (FLOOR, (*FLOOR, body), (*FLOOR, board))
    )
    assert (alone > 0).all()
    np.testing.assert_allclose(there, alone, rtol=1e-5)
    assert (hidden[2] < 0.02 * alone[2]).all()


def test_a_disc_is_the_same_from_wherever_it_is_described() -> None:
    light = lamp((1.0, 2.0, 3.0), 0.3, (4.0, 2.0, 1.0))
    there, back = light.seen_from(np.array([1.0, 0.0, 3.0])), light.seen_from(np.array([1.0, 0.0, 3.0]))
    np.testing.assert_allclose(there.irradiance, [1.0, 0.5, 0.25])
    np.testing.assert_allclose(there.direction, UP)
    assert np.tan(there.half_angle_rad) == pytest.approx(0.15)
    back = there.seen_from(np.array([2.0, 2.0, 3.0]))
    np.testing.assert_allclose(back.irradiance, light.irradiance)
    assert back.half_angle_rad == pytest.approx(light.half_angle_rad)
    assert disc(5.0).seen_from(np.ones(3)).direction.tolist() == lights.unit(TOWARD).tolist()


# ---- against the exact light of a disc ---------------------------------------------------------------------------


@pytest.mark.parametrize(("half_angle_deg", "bound"), [(2.0, 0.02), (6.0, 0.03), (14.0, 0.05), (25.0, 0.08)])
@pytest.mark.parametrize("solid", [CRATE, ball((0.46, 0.2, 0.46), 0.1)], ids=["box", "ball"])
def test_floor_darkens_as_the_disc_is_hidden(
    engine: Engine, solid: Box | Ball, half_angle_deg: float, bound: float
) -> None:
    """The share of the light that a thing on the floor takes, from where it touches through all of the penumbra.

    Seen, root mean square: 0.004, 0.010, 0.022, 0.036 of the box; 0.011, 0.017, 0.036, 0.065 of the ball, which is as
    far from flat as can be. In the mean over the floor 0.0005 and 0.007 at most.
    """
    light = disc(half_angle_deg)
    points = floor_points(500)
    points = points[solid.distance(points) > 0.004]
    without, found = (a[:, 0] for a in lit(engine, light, solids=(solid,)).floor(points))
    darker, true = 1 - found / without, 1 - exact(points, light, (solid,)) / exact(points, light, ())
    assert (true > 0.9).any()
    assert np.sqrt(np.mean((darker - true) ** 2)) < bound
    assert np.corrcoef(darker, true)[0, 1] > 0.96
    assert abs(darker.mean() - true.mean()) < 0.012
    assert darker[true == 0].mean() < 0.005


def test_penumbra_widens_with_distance(engine: Engine) -> None:
    """A plate's edge, twice as high: from 10 % to 90 % of the darkening it is twice as far, as tan(half angle) says."""
    widths, light = [], disc(10.0, UP)
    for height in (0.1, 0.2):
        plate = box((0.1, FLOOR_Y + height, 0.1), (0.46, FLOOR_Y + height + 0.01, 0.86))
        x = np.linspace(0.3, 0.62, 400)
        points = np.stack([x, np.full_like(x, FLOOR_Y), np.full_like(x, 0.48)], -1)
        without, found = (a[:, 0] for a in lit(engine, light, solids=(plate,)).floor(points))
        true = exact(points, light, (plate,)) / exact(points, light, ())
        shares = found / without
        ends = [[x[np.argmax(s > level)] for level in (0.1, 0.9)] for s in (shares, true)]
        widths.append(ends[0][1] - ends[0][0])
        assert abs(np.mean(ends[0]) - np.mean(ends[1])) < 0.0015  # seen: 0.0004; points are 0.0008 m apart
        assert widths[-1] == pytest.approx(ends[1][1] - ends[1][0], rel=0.2)
    assert widths[1] == pytest.approx(2 * widths[0], rel=0.15)


def test_shadow_is_attached(engine: Engine) -> None:
    """Floor right behind the box, from 1 mm on, and along all of that edge: no light leaks in between."""
    light = disc(5.0, (1.0, 1.0, 0.0))
    z = np.linspace(0.42, 0.50, 30)
    for away in (0.001, 0.003, 0.01, 0.03):
        points = np.stack([np.full_like(z, 0.38 - away), np.full_like(z, FLOOR_Y), z], -1)
        without, found = lit(engine, light).floor(points)
        assert (found < 0.02 * without).all()


def test_lit_floor_has_no_acne(engine: Engine) -> None:
    """Everywhere that the disc is seen whole: exactly nothing is taken, at grazing light too."""
    for toward in (TOWARD, (1.0, 0.25, 0.1)):
        light = disc(4.0, toward)
        points = floor_points(600, around=0.4)
        points = points[
            exact(points, disc(5.0, toward), (CRATE.grown(0.006),)) >= 0.999 * exact(points[:1], disc(5.0, toward), ())
        ]
        without, found = lit(engine, light).floor(points)
        assert len(points) > 200
        np.testing.assert_array_equal(found, without)


@pytest.mark.parametrize("half_angle_deg", [4.0, 20.0])
def test_ball_does_not_shade_itself(engine: Engine, half_angle_deg: float) -> None:
    """A convex body is lit as if it were alone with its normals, up to its terminator."""
    center, radius, light = np.array([0.46, 0.4, 0.46]), 0.15, disc(half_angle_deg)
    normals = lights.random_directions(900, 7).reshape(30, 30, 3)
    found = lit(engine, light, solids=(Ball(center, radius),)).virtual(center + radius * normals, normals)[..., 0]
    expected = np.array([exact(np.zeros((1, 3)), light, (), n)[0] for n in normals.reshape(-1, 3)]).reshape(30, 30)
    expected[0, 0] = 0
    assert np.abs(found - expected).max() < 0.01  # seen: 0.0024
    assert np.abs(found - expected).mean() < 0.001  # seen: 0.0002


def test_faces_that_face_the_light_are_lit(engine: Engine) -> None:
    """Where depths are the face's own but for their rounding, and there is no slope to allow for."""
    x, z = np.meshgrid(np.linspace(0.385, 0.535, 40), np.linspace(0.405, 0.515, 40))
    points = np.stack([x, np.full_like(x, 0.26), z], -1)
    light = disc(5.0, UP)
    found = lit(engine, light).virtual(points, np.broadcast_to(UP, points.shape))[..., 0].ravel()[1:]
    np.testing.assert_allclose(found, exact(points[0, :1], light, ())[0], rtol=1e-5)  # seen: 3e-7


def test_one_object_shades_another(engine: Engine) -> None:
    """A plate above a box: what it takes from the box's top is what it takes of the disc."""
    light, plate = disc(8.0), box((0.5, 0.4, 0.44), (0.7, 0.42, 0.64))
    x, z = np.meshgrid(np.linspace(0.385, 0.535, 24), np.linspace(0.405, 0.515, 24))
    points = np.stack([x, np.full_like(x, 0.26), z], -1)
    found = lit(engine, light, solids=(CRATE, plate)).virtual(points, np.broadcast_to(UP, points.shape))[..., 0]
    expected = exact(points.reshape(-1, 3), light, (plate, CRATE)).reshape(24, 24)
    error = np.abs(found - expected)[1:, 1:]
    assert expected.min() < 0.1
    assert expected.max() > 0.7
    assert np.sqrt(np.mean(error**2)) < 0.05


# ---- real things that hide the light already ---------------------------------------------------------------------


WALL = box((0.62, 0.1, 0.1), (0.72, 0.7, 0.86))


@KINDS
def test_nothing_is_darkened_twice(device: Device, kind: type[Engine]) -> None:
    """A wall's shadow over the box's: where the wall hides the disc, the box takes nothing; virtual things are dark."""
    engine, light = kind(device), disc(6.0, (0.9, 0.5, 0.0))
    scene = lit(engine, light, scene=(*FLOOR, WALL))
    points = floor_points(800, around=0.4)
    points = points[WALL.distance(points) > 3 * VOXEL_M]
    without, found = (a[:, 0] for a in scene.floor(points))
    real = exact(points, light, (WALL,), lift_m=VOXEL_M)
    hidden = exact(points, light, (WALL.grown(-2 * VOXEL_M),), lift_m=VOXEL_M) == 0
    assert 0.5 < hidden.mean() < 0.8
    assert (real > 0.4).mean() > 0.1
    np.testing.assert_array_equal(found[hidden], without[hidden])
    assert without[hidden].max() == 0
    assert np.sqrt(np.mean((without - real) ** 2)) < 0.03  # seen: 0.016, of 8 rays, voxels taken whole
    assert (found <= without).all()
    top = np.stack(np.meshgrid(np.linspace(0.39, 0.53, 8), [0.26], np.linspace(0.41, 0.51, 8), indexing="ij"), -1)[:, 0]
    assert scene.virtual(top, np.broadcast_to(UP, top.shape)).max() == 0


def test_real_surface_that_a_virtual_one_touches_does_not_hide_the_disc(engine: Engine) -> None:
    """Tops of boxes that stand 2 mm within a wall: rays that began there would begin in its voxels."""
    light = disc(6.0, (-0.7, 0.7, 0.0))
    points = np.full((8, 16, 3), (0.622, 0.26, 0.0))
    points[..., 2] = np.linspace(0.4, 0.52, 128).reshape(8, 16)
    found = lit(engine, light, scene=(*FLOOR, WALL)).virtual(points, np.broadcast_to(UP, points.shape))[..., 0]
    np.testing.assert_allclose(found.ravel()[1:], exact(points[0, :1], light, ())[0], rtol=2e-4)  # seen: 4e-5


def test_rays_are_as_long_as_they_are_said_to_be(engine: Engine) -> None:
    scene = lit(engine, disc(6.0, (0.9, 0.5, 0.0)), scene=(*FLOOR, WALL), ray_length_m=0.05)
    points = floor_points(100, around=0.05) - [0.2, 0, 0]
    np.testing.assert_allclose(scene.floor(points)[0], exact(points[:1], disc(6.0, (0.9, 0.5, 0.0)), ())[0], rtol=3e-4)


# ---- both parts of the light together ----------------------------------------------------------------------------

SKY, BESIDE_M = 0.2, 0.1


class BesideAWall:
    """16 x 16 samples of floor beside a wall, under an even sky and a disc that a small bar hides."""

    def __init__(self, engine: Engine, sky: float) -> None:
        self.engine, self.light = engine, disc(2.0, (0.0, 0.8, 0.6))
        self.middle = np.array([0.48, FLOOR_Y, 0.2 + BESIDE_M])
        bar = box(self.middle + 0.3 * self.light.direction - 0.02, self.middle + 0.3 * self.light.direction + 0.02)
        points = np.tile(self.middle, (16, 16, 1))
        points[..., 0] += 0.005 * np.linspace(-1, 1, 256).reshape(16, 16)
        self.camera, rays, even = camera_of(points), direction_sets(81, 4), lights.uniform((sky,) * 3)
        volume, _ = floor_beside_a_wall(engine)
        surface = upload_surface(engine, points, np.broadcast_to(UP, points.shape), np.ones((16, 16), bool))
        self.surface = surface
        self.transfer = transfer_radiance(engine, self.camera, volume, surface, 1, rays, FAR_M)
        hits = gather_hits(engine, self.camera, volume, surface, self.transfer, rays, FAR_M)
        self.indirect = observe_indirect(engine, self.transfer, rays, hits, MeanSent())
        split = upload_light(engine, even, rays, indirect=self.indirect, split=SplitLight(even, (self.light,)))
        objects = [placed(engine, bar)]
        self.context = context_of(engine, self.camera, surface, volume, rays, FAR_M)
        self.maps = draw_shadow_maps(engine, volume, split, objects, FAR_M)
        self.scene = trace_scene(engine, volume, split, rays, FAR_M, objects)

    def shadow(self, samples: DirectSamples, step: int = 1) -> RealShadow:
        engine, camera, indirect = self.engine, self.camera, self.indirect
        return shadow_real(engine, camera, self.surface, self.transfer, self.scene, indirect, samples, step)

    def bounced(self, shadow: RealShadow, samples: DirectSamples, returned: float) -> RealShadow:
        assert self.indirect.met is not None
        return bounce_real(
            self.engine,
            self.camera,
            np.eye(4),
            self.surface,
            self.transfer,
            self.scene,
            shadow,
            self.indirect.met,
            returned,
            samples=samples,
        )


def test_an_umbra_keeps_what_surfaces_send(engine: Engine) -> None:
    """Floor beside a wall, under an even sky and a disc that a small bar hides: R' / R is the sky and what the wall
    sends over that and the disc, in closed form, at samples and at pixels.

    The bar hides 1 / 200 of the sky: most samples have no direction that meets it, and R is the same there.
    """
    case = BesideAWall(engine, SKY)
    samples = effects.light_samples(case.context, case.transfer, case.maps)
    shadow = case.shadow(samples)
    parts = trace_real(engine, case.camera, case.surface, shadow, case.maps)
    pixels = download4(engine, light_real(engine, case.camera, case.surface, shadow, parts, case.maps)).astype(float)
    assert shadow.whole is not None
    buffers = (shadow.values, shadow.shaded, shadow.whole.values, shadow.whole.shaded)
    by_rays, shaded, ratio, whole = (download4(engine, a)[..., :3].astype(float) for a in buffers)

    hidden = wall_seen_from(BESIDE_M + VOXEL_M, SIDE_M, SIDE_M - FLOOR_Y)
    expected = SKY * (1 - hidden) + hidden * np.array(WALL_COLOR)
    brought = exact(case.middle[None], case.light, ())[0]
    missed = (by_rays == 1).all(axis=-1)
    assert 0.5 < missed.mean() < 1
    for at in (missed, ~missed):
        np.testing.assert_allclose(shaded[at].mean(axis=0), expected, rtol=0.1)
        np.testing.assert_allclose(whole[at].mean(axis=0), expected + brought, rtol=0.1)
    for found in (ratio, pixels[..., :3]):
        np.testing.assert_allclose(found.mean(axis=(0, 1)), expected / (expected + brought), rtol=0.08)
    assert (pixels[..., 3] == 1).all()


@pytest.mark.parametrize("step", [1, 2])
@pytest.mark.parametrize("sky", [SKY, -0.3])
def test_mixed_ratios_are_the_twins_and_come_apart_again(device: Device, engine: Engine, sky: float, step: int) -> None:
    """With any light from discs at the samples: under a sky, and where the rest of the light is nothing but ringing."""
    case = BesideAWall(engine, sky)
    random, shape = np.random.default_rng(3), (16, 16, 3)
    without, least = random.uniform(0, 2, shape), np.array([1e-2, 2e-2, 3e-2])
    with_objects = without * random.uniform(0, 1, shape)
    values = {"without": without, "with": with_objects}
    samples = DirectSamples(*(engine.workspace.upload(f"mixed_{n}", float4(a)) for n, a in values.items()), least)
    shadow = case.shadow(samples, step)
    assert shadow.whole is not None
    buffers = (shadow.values, shadow.shaded, shadow.whole.values, shadow.whole.shaded)
    ratio, rest, whole, whole_shaded = (download4(engine, a).astype(float)[..., :3] for a in buffers)
    assert (rest < 0).any() == (sky < 0)
    assert (ratio != 1).any() == (sky > 0)

    expected = twin.mixed_ratio(ratio, rest, without, with_objects, least)
    np.testing.assert_allclose(whole, expected, rtol=relative_tolerance(device))
    np.testing.assert_allclose(whole_shaded, np.maximum(rest, least) + without, rtol=relative_tolerance(device))
    assert (expected <= np.maximum(ratio, 1) + 1e-6).all()

    apart = case.bounced(shadow, samples, returned=0.0)  # by nothing: the same ratios
    assert apart.whole is not None
    np.testing.assert_array_equal(download4(engine, apart.whole.values)[..., :3], whole.astype(np.float32))
    bright = (rest > 0.05) & (ratio * rest + with_objects > 1.01 * least)
    np.testing.assert_allclose(download4(engine, apart.values)[..., :3][bright], ratio[bright], atol=1e-5)


def test_pixels_of_real_surface_hold_the_whole_ratio(engine: Engine) -> None:
    """Rest and discs at every pixel, from samples of the one: 1 where nothing is touched, by nothing at all."""
    light, side, stride = disc(8.0), 48, 4
    scene = lit(engine, light)
    x, z = np.meshgrid(np.linspace(0.1, 0.8, side), np.linspace(0.1, 0.8, side))
    points = np.stack([x, np.full_like(x, FLOOR_Y), z], -1).astype(np.float32).astype(float)
    surface = upload_surface(engine, points, np.broadcast_to(UP, points.shape), np.ones((side, side), bool))
    samples, camera, space = (side // stride, side // stride), camera_of(points), engine.workspace
    ratio = np.ones((*samples, 3))
    ratio[-4:] = 0.7
    rest = np.full((*samples, 3), 0.4)
    shadow = RealShadow(stride, space.upload("m_ratio", float4(ratio)), space.upload("m_rest", float4(rest)))
    parts = trace_real(engine, camera, surface, shadow, scene.maps)
    found = download4(engine, light_real(engine, camera, surface, shadow, parts, scene.maps)).astype(float)
    without, past = scene.floor(points.reshape(-1, 3))
    for rows, factor in ((slice(42, None), 0.7), (slice(0, 20), 1.0)):
        expected = twin.mixed_ratio(
            np.full(3, factor),
            np.full(3, 0.4),
            *(a.reshape(side, side, 3)[rows] for a in (without, past)),
            scene.maps.least,
        )
        counted = found[rows][..., 3] > 0
        np.testing.assert_allclose(found[rows][counted][:, :3], expected[counted], rtol=1e-4)
        np.testing.assert_allclose(expected[~counted], 1.0, atol=1e-6)
    assert found[42:, :, 3].all()
    assert 0.05 < (found[:20, :, 3] > 0).mean() < 0.9
    assert not found[found[..., 3] == 0].any()


def test_one_lane_and_eight_light_a_rough_floor_alike(device: Device) -> None:
    """Of a width that eight do not divide, with holes, under two discs: as on a GPU, to rounding."""
    rng, height, width, stride = np.random.default_rng(3), 40, 45, 4
    x, z = np.meshgrid(np.linspace(0.1, 0.8, width), np.linspace(0.1, 0.8, height))
    points = np.stack([x, FLOOR_Y + rng.uniform(-0.01, 0.01, x.shape), z], -1).astype(np.float32).astype(float)
    normals = np.asarray(UP, float) + rng.uniform(-0.2, 0.2, points.shape)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    known = rng.random(x.shape) > 0.1
    samples = (height // stride, width // stride)
    ratio, rest = rng.uniform(0.5, 1.0, (*samples, 3)), rng.uniform(0.1, 0.5, (*samples, 3))
    found = []
    for kind in (Narrow, Wide):
        engine = kind(device)
        scene, space, camera = lit(engine, disc(8.0), disc(20.0, BEHIND)), engine.workspace, camera_of(points)
        surface = upload_surface(engine, points, normals, known)
        shadow = RealShadow(stride, space.upload("m_ratio", float4(ratio)), space.upload("m_rest", float4(rest)))
        parts = trace_real(engine, camera, surface, shadow, scene.maps)
        assert trace_real(engine, camera, surface, shadow, scene.maps) is parts  # once a frame
        mixed = light_real(engine, camera, surface, shadow, parts, scene.maps)
        brought = light_samples(engine, camera, surface, parts, scene.maps)
        found.append([download4(engine, a) for a in (mixed, brought.without, brought.with_objects)])
        engine.close()
    for narrow, wide in zip(*found, strict=True):
        apart = np.abs(narrow - wide).max(axis=-1)
        assert (apart < 1e-5).mean() > 0.995  # a look that falls on a texel's border may fall on either side
        assert apart.max() < 0.1
    assert (found[1][0][..., 3] > 0).mean() > 0.8


def test_points_on_objects_send_what_the_disc_brings_them(engine: Engine) -> None:
    """Besides what they sent already: their albedo times the disc's light, past the other object and themselves."""
    light = disc(7.0, TOWARD, (1.0, 0.5, 0.2))
    plate = box((0.5, 0.4, 0.44), (0.7, 0.42, 0.64))
    scene = lit(engine, light, solids=(CRATE, plate))
    points = place_points(engine, [placed(engine, solid) for solid in (CRATE, plate)])
    before = np.full((points.count, 3), 0.25)
    point_lights = replace(points.point_lights, radiances=engine.workspace.upload("sent", float4(before)))
    light_points_by_discs(engine, points, point_lights, scene.maps)
    sent = download4(engine, point_lights.radiances)[:, :3].astype(float) - before
    places, normals = (download4(engine, a)[:, :3].astype(float) for a in (points.points, points.normals))
    expected = [exact(p[None], light, (CRATE, plate), n, lift_m=1e-4)[0] for p, n in zip(places, normals, strict=True)]
    expected = np.array(expected)[:, None] * points.colors * light.irradiance
    assert expected.max() > 0.3
    assert np.sqrt(np.mean((sent - expected) ** 2)) < 0.015  # seen: 0.007, of at most 8 texels a look


def test_mirrors_show_all_of_the_light(engine: Engine) -> None:
    """Byte for byte what they show of a light that nothing was taken out of."""
    light = lights.uniform((0.3,) * 3) + np.outer(directional_sh(BEHIND * [1, 1, -1], 0.2, 4), (1.0, 0.8, 0.5))
    assert split_light(light).discs

    def split_upload(engine: Engine, sh: Floats, rays: Directions, **rest: Any) -> DeviceLight:
        return upload_light(engine, sh, rays, **rest, split=split_light(sh))

    whole, _ = glossy_surface.reflect(engine, *glossy_surface.surfaces(), light=light)
    with patch.object(glossy_surface, "upload_light", split_upload):
        split, _ = glossy_surface.reflect(engine, *glossy_surface.surfaces(), light=light)
    np.testing.assert_array_equal(split, whole)
    assert split.max() > 0.5


def test_exposure_brightens_both_parts(engine: Engine) -> None:
    light = lights.uniform((0.3,) * 3) + np.outer(directional_sh(TOWARD, 0.2, 4), (1.0, 0.8, 0.5))
    rays, split = direction_sets(81, 4), split_light(light)
    one, three = (upload_light(engine, light, rays, exposure=e, split=split) for e in (1.0, 3.0))
    np.testing.assert_allclose(three.discs[0].irradiance, 3 * one.discs[0].irradiance)
    rest, whole = (download4(engine, three.table.array(part))[0, :, :3] for part in ("coefficients", "whole"))
    np.testing.assert_allclose(rest, 3 * split.rest, atol=1e-5)
    np.testing.assert_allclose(whole, 3 * light, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(three.mean, 3 * one.mean)


def test_surfaces_send_what_the_whole_light_is_changed_to(engine: Engine) -> None:
    scene, samples = lit(engine, disc(5.0)), engine.workspace.upload("r", float4(np.ones((4, 4, 3))))
    rays, camera = direction_sets(81, 4), camera_of(np.zeros((16, 16, 3)))
    traced = trace_scene(engine, scene.maps.volume, scene.maps.light, rays, FAR_M, [placed(engine, CRATE)])
    surface = upload_surface(engine, np.zeros((16, 16, 3)), np.zeros((16, 16, 3)), np.zeros((16, 16), bool))
    whole = SampleGrid(4, samples)
    context = context_of(engine, camera, surface, scene.maps.volume, rays, FAR_M)
    for ratio, expected in ((RealShadow(4, samples, samples, whole), whole), (RealShadow(4, samples, samples), None)):
        changed = effects.add_objects(context, traced, None, ratio, None).changed
        assert changed is not None
        assert changed.ratio is (expected or ratio)


def test_places_cover_their_disc_evenly() -> None:
    for places in (disc_places(), ray_places(), *ray_places().reshape(16, 8, 2)):
        radius2 = (places**2).sum(axis=1)
        assert radius2.max() < 1
        assert radius2.mean() == pytest.approx(0.5, abs=0.1)
        assert np.linalg.norm(places.mean(axis=0)) < 0.25
    np.testing.assert_allclose(disc_places().sum(axis=0), 0, atol=1e-9)


def test_no_point_of_an_object_gets_more_of_a_near_lamp_than_the_bound(engine: Engine) -> None:
    for center in (LAMP_M, (0.46, 0.6, 0.46), (0.1, 0.3, 0.2)):
        scene = lit(engine, lamp(center, 0.05, (1.0, 2.0, 0.5)), disc(10.0, BEHIND))
        most = most_irradiance(scene.maps.light, [placed(engine, CRATE)])
        random = np.random.default_rng(3)
        points = random.uniform((0.38, 0.1, 0.4), (0.54, 0.26, 0.52), (20, 20, 3))
        normals = lights.random_directions(400, 1).reshape(20, 20, 3)
        found = scene.virtual(points, normals)[..., :3].max(axis=(0, 1))
        assert (found <= most).all()
        assert (found > 0.05 * most).all()
