"""Image-space rendering (thesis 7.3): shadows beside closed forms, integrals and the volume family's; fig. 7.8."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import msgspec
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from client.options.source import open_source
from client.synthetic.lighting.lights import disc_light
from protocol.frames import CameraModel
from server.client_session import ClientSession
from server.culling.reason import CullReason
from server.effects import renderer
from server.maths.rigid import inverse_rigid
from server.objects.rasterize import Placed, VirtualSurface
from server.objects.virtual_object import VirtualObject
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.scene.placement import Placement
from server.shading.depth_views import draw_depth_views
from server.shading.differential_rendering import shadow_real, shadow_virtual
from server.shading.traced_scene import TracedScene, trace_scene, upload_light
from server.transfer.auxiliary_views import ViewsAround
from server.transfer.image_space import nearest_views
from server.transfer.radiance_transfer import direction_sets, transfer_radiance
from server.transfer.real_depth_views import RealDepthViews
from tests.bench.light.runs import at_preset, results_of, wishes_for
from tests.bench.rendering import turning
from tests.scenes import lights
from tests.scenes.meshes import pose, shape_of
from tests.scenes.solids import Scene, Solid, box, download4, fill_volume, float4, floor, upload_surface

VOXEL_M = 0.01
FAR_M = 1000.0
UP = np.array([0.0, 1.0, 0.0])
RAYS = direction_sets(256, 4)
VIEWS = 400
SIDE = 32
"""Points along a side of what is shaded: neighbours have other directions."""
CAMERA = CameraModel(width=SIDE, height=SIDE, fx=40.0, fy=40.0, cx=15.5, cy=15.5)

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Stand:
    """Real and virtual things in an even light, looked up."""

    engine: Engine
    scene: TracedScene

    def real(self, points: Floats, normal: Floats = UP) -> Floats:
        """[SIDE, SIDE] R' / R of real surface; points [SIDE, SIDE, 3]."""
        normals = np.broadcast_to(normal, points.shape)
        surface = upload_surface(self.engine, points, normals, np.ones(points.shape[:2], bool))
        volume = self.scene.volume
        transfer = transfer_radiance(self.engine, CAMERA, volume, surface, 1, RAYS, FAR_M)
        return download4(self.engine, shadow_real(self.engine, CAMERA, surface, transfer, self.scene).values)[..., 0]

    def virtual(self, points: Floats, normal: Floats = UP) -> Floats:
        """[SIDE / 2, SIDE / 2] radiance taken from virtual surface, of an even light of 1."""
        covered, space = np.ones(points.shape[:2]), self.engine.workspace
        parts = (np.broadcast_to(normal, points.shape), np.ones(points.shape))
        arrays = [space.upload(f"test_virtual_{k}", float4(v, covered)) for k, v in enumerate((points, *parts))]
        index = space.upload("test_virtual_index", np.zeros(covered.shape, np.int32))
        surface = VirtualSurface(*arrays, index, ((0, 0, SIDE, SIDE),))
        return download4(self.engine, shadow_virtual(self.engine, CAMERA, surface, self.scene).values)[..., 0]


def stand(engine: Engine, scene: Scene, objects: list[Placed], side_m: float = 0.96) -> Stand:
    """The camera sees nothing: all is known from the volume."""
    volume = fill_volume(engine, scene, VOXEL_M, side_m)
    around = ViewsAround(engine, VIEWS)
    views = around.update(volume)
    nothing = np.zeros((SIDE, SIDE, 3))
    real = RealDepthViews(
        views,
        nearest_views(RAYS, around.lattice)[1],
        CAMERA,
        inverse_rigid(pose((0.5, 0.5, -1.0))),
        upload_surface(engine, nothing, nothing, np.zeros((SIDE, SIDE), bool)),
        engine.workspace.upload("test_depths", np.zeros((SIDE, SIDE), np.float32)),
        near_m=0.0,
        ratio=1.5,
        threshold=0.05,
    )
    light = upload_light(engine, lights.uniform(), RAYS)
    traced = trace_scene(engine, volume, light, RAYS, FAR_M, objects)
    return Stand(engine, replace(traced, depth_views=draw_depth_views(engine, real, objects)))


def around_point(middle: Floats, half_m: float) -> Floats:
    """[SIDE, SIDE, 3] points around one of a level surface, so close together that they have the same shading."""
    x, z = np.meshgrid(np.linspace(-half_m, half_m, SIDE), np.linspace(-half_m, half_m, SIDE))
    return middle + np.stack([x, np.zeros_like(x), z], -1)


def share_behind(solid: Solid, point: Floats, normal: Floats = UP) -> float:
    """Cosine-weighted share of the half space above `normal` that a solid hides: dense directions, exact hits."""
    directions = lights.random_directions(200_000, 3)
    cosines = np.maximum(directions @ normal, 0)
    hidden = np.isfinite(solid.hit(np.tile(point, (len(directions), 1)), directions))
    return float((cosines * hidden).sum() / cosines.sum())


def box_at(engine: Engine, low: Any, high: Any, turn_rad: float = 0.0) -> Placed:
    solid = box(low, high)
    mesh = shape_of(trimesh.creation.box(solid.high - solid.low))
    return VirtualObject.upload(engine, mesh), pose((solid.low + solid.high) / 2, UP, turn_rad)


# ---- exact shadows -----------------------------------------------------------------------------------------------


def test_ball_above_a_plane_takes_its_form_factor(engine: Engine) -> None:
    """A ball wholly above the plane hides r^2 h / d^3 of the sky, h high and d away; 256 directions, 16 sets."""
    radius, center = 0.12, np.array([0.48, 0.4, 0.48])
    ball_mesh = VirtualObject.upload(engine, shape_of(trimesh.creation.icosphere(4, radius)))
    scene = stand(engine, (floor(),), [(ball_mesh, pose(center, (1, 1, 0), 0.7))])
    for x in (0.48, 0.4, 0.3, 0.1):
        middle = np.array([x, 0.1, 0.48])
        offset = center - middle
        expected = radius**2 * offset[1] / np.linalg.norm(offset) ** 3
        cell = scene.scene.table.cell_m[0]
        grown = (radius + 0.72 * cell) ** 2 * offset[1] / np.linalg.norm(offset) ** 3
        taken = 1 - scene.real(around_point(middle, 0.004)).mean()
        assert expected - 0.004 < taken < grown + 0.004


def test_box_on_a_plane_takes_its_integral(engine: Engine) -> None:
    """From 2 to 20 cm beside the box; within a pixel of its views, which is 1 cm, a little too dark."""
    scene = stand(engine, (floor(),), [box_at(engine, (0.36, 0.1, 0.36), (0.6, 0.3, 0.6))])
    solid, cell = box((0.36, 0.1, 0.36), (0.6, 0.3, 0.6)), scene.scene.table.cell_m[0]
    errors = []
    for aside in (0.005, 0.02, 0.05, 0.1, 0.2):
        middle = np.array([0.6 + aside, 0.1, 0.48])
        taken = 1 - scene.real(around_point(middle, 0.002)).mean()
        errors.append(taken - share_behind(solid.grown(0.36 * cell), middle))  # between the box and what is drawn
    assert np.abs(errors[1:]).max() < 0.015  # seen: 0.0075
    assert abs(np.mean(errors[1:])) < 0.006  # seen: 0.0029
    assert -0.02 < errors[0] < 0.14


def test_virtual_and_real_things_shade_a_virtual_top(engine: Engine) -> None:
    """A real overhang alone, a virtual one alone, and the real one above the virtual: nothing is taken twice."""
    top = box_at(engine, (0.3, 0.1, 0.3), (0.66, 0.12, 0.66))
    real, virtual = box((0.4, 0.4, 0.3), (0.7, 0.44, 0.66)), box((0.44, 0.3, 0.36), (0.6, 0.34, 0.6))
    slab = box_at(engine, virtual.low, virtual.high)
    points = around_point(np.array([0.48, 0.12, 0.48]), 0.003)
    middle = np.array([0.48, 0.12, 0.48])
    by_real = share_behind(real, middle)
    by_virtual = share_behind(virtual.grown(0.5 * stand(engine, (real,), [top, slab]).scene.table.cell_m[1]), middle)
    assert 0.1 < by_virtual < by_real
    assert stand(engine, (real,), [top]).virtual(points).mean() == pytest.approx(by_real, abs=0.015)  # seen: 0.007
    nothing = (box((0.9, 0.9, 0.9), (0.95, 0.95, 0.95)),)
    # Seen: 0.0001.
    assert stand(engine, nothing, [top, slab]).virtual(points).mean() == pytest.approx(by_virtual, abs=0.005)
    wider = box((0.2, 0.4, 0.1), (0.8, 0.44, 0.9))
    both = stand(engine, (wider,), [top, slab]).virtual(points).mean()
    assert both == pytest.approx(share_behind(wider, middle), abs=0.03)


def test_real_floor_hides_half_of_the_light_of_a_side(engine: Engine) -> None:
    """What a virtual box sees of the real floor that it stands on."""
    scene = stand(engine, (floor(),), [box_at(engine, (0.3, 0.1, 0.3), (0.66, 0.4, 0.66))])
    x, y = np.meshgrid(np.linspace(0.45, 0.5, SIDE), np.linspace(0.2, 0.22, SIDE))
    side = np.stack([x, y, np.full_like(x, 0.66)], -1)
    # The volume ends 20 cm in front of it: beyond, nothing is known, and light comes from there.
    patch_of_floor = box((0.0, 0.0, 0.0), (0.96, 0.1, 0.96))
    expected = share_behind(patch_of_floor, np.array([0.48, 0.21, 0.66]), np.array([0.0, 0.0, 1.0]))
    assert 0.2 < expected < 0.5
    assert scene.virtual(side, np.array([0.0, 0.0, 1.0])).mean() == pytest.approx(expected, abs=0.008)  # seen: 0.002


def test_object_under_a_real_ceiling_takes_nothing_more(engine: Engine) -> None:
    """What real things hide already is not darkened twice."""
    plate = box_at(engine, (0.4, 0.3, 0.4), (0.56, 0.32, 0.56))
    ceiling = box((0.2, 0.5, 0.2), (0.76, 0.54, 0.76))
    points = around_point(np.array([0.48, 0.1, 0.48]), 0.003)
    open_sky, covered = (stand(engine, scene, [plate]).real(points) for scene in ((floor(),), (floor(), ceiling)))
    assert 1 - open_sky.mean() > 0.1
    assert 1 - covered.mean() < 0.005


def test_shadows_move_with_the_object(engine: Engine) -> None:
    """Its views are drawn once, in its own axes: turned and moved, it casts the same shadow, turned and moved."""
    ratios = []
    for turn, middle in ((0.0, (0.48, 0.1, 0.48)), (0.5 * np.pi, (0.4, 0.1, 0.52))):
        center = np.array(middle)
        low, high = center + np.array((-0.1, 0.1, -0.05)), center + np.array((0.1, 0.2, 0.05))
        scene = stand(engine, (floor(),), [box_at(engine, low, high, turn)])
        aside = pose((0, 0, 0), UP, turn)[:3, :3] @ (0.13, 0.0, 0.02)
        ratios.append(scene.real(around_point(center + aside, 0.003)).mean())
    assert ratios[0] < 0.93
    assert ratios[1] == pytest.approx(ratios[0], abs=0.002)  # seen: 0.0003


# ---- in the whole spine ------------------------------------------------------------------------------------------


def pictures(device: Device, source: str, preset: str, indirect: str, traced: bool) -> tuple[Floats, tuple[str, ...]]:
    """The first frame's codes [h, w, 3] with a box and a ball, and the effects that were run."""
    opened = open_source(source)
    wishes = msgspec.structs.replace(at_preset(wishes_for(opened, range(1)), preset), indirect=indirect)
    light = tuple((float(r), float(g), float(b)) for r, g, b in opened.truth(0).sh)  # type: ignore[attr-defined]
    pipeline = ClientSession(device, opened.camera, msgspec.structs.replace(wishes, light=light))
    pipeline.place_object(
        "box", shape_of(trimesh.creation.box((0.5, 0.3, 0.4))), Placement(position_m=(-0.3, 0.0, 0.0))
    )
    pipeline.place_object("ball", shape_of(trimesh.creation.icosphere(4, 0.2)), Placement(position_m=(0.4, 0.0, 0.2)))
    by_rays = (lambda _facts: CullReason("traced for comparison", 0.0),)
    effects = tuple(
        replace(e, disabled_by=by_rays) if traced and e.name == "draw_depth_views" else e
        for e in renderer.EFFECTS.effects
    )
    with patch.object(renderer, "EFFECTS", replace(renderer.EFFECTS, effects=effects)):
        result = pipeline.process(opened[0])
    pipeline.close()
    return result.color.astype(float), result.plan.run


@pytest.mark.parametrize("indirect", ["none", "observed"])
def test_both_families_agree(device: Device, indirect: str) -> None:
    """One picture in both: within 0.7 codes in the mean where the objects change it."""
    source = "synthetic:room?size=160x120"
    looked, run = pictures(device, source, "gr15fast", indirect, traced=False)
    traced, other_run = pictures(device, source, "gr15fast", indirect, traced=True)
    assert set(run) - set(other_run) == {"draw_depth_views"}
    without = open_source(source)[0].color.astype(float)
    changed = (np.abs(traced - without) > 1).any(-1)
    assert changed.mean() > 0.1  # seen: 0.20
    difference = (looked - traced)[changed]
    assert np.abs(difference).mean() < 0.6  # seen: 0.28
    assert abs(difference.mean()) < 0.2  # seen: 0.09
    assert (np.abs(difference).max(-1) > 16).mean() < 0.001  # seen: 0
    assert np.abs((traced - without)[changed]).mean() > 10 * abs(difference.mean())


def test_shadow_of_what_left_the_picture_stays(device: Device, tmp_path: Path) -> None:
    """Fig. 7.8: a real slab shades a virtual ball and leaves the picture; its shadow changes by less than 5 %."""
    turn = turning.Turn(3, 2)
    light = disc_light(turning.TOWARDS_LIGHT / np.linalg.norm(turning.TOWARDS_LIGHT)).sh
    wishes = at_preset(turning.turning_wishes(light), "gr15fast")
    source: Any = SimpleNamespace(camera=turning.turning_camera())
    mesh = turning.write_ball(tmp_path / "ball.ply")
    with_slab, without = (
        [result.color for result in results_of(device, source, turn.frames(solids), wishes, [mesh])]
        for solids in ([turning.TABLE, turning.SLAB], [turning.TABLE])
    )
    before, after = (turning.shadow_at(turn, with_slab, without, end) for end in (turn.still, len(turn.poses())))
    assert before.sum() == pytest.approx(turning.exact_shadow(light).sum(), rel=0.05)  # seen: 0.023
    assert turning.shadow_change(before, after) < 5
