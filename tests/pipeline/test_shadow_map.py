"""A small light through the whole spine: a shadow on a floor has the edge that the light's size says, in its place."""

from __future__ import annotations

from functools import cache
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Preset, Wishes
from server.client_session import ClientSession
from server.input.measure import linear_values
from server.light import room_light
from server.maths.direct_lights import SplitLight, split_light
from server.maths.directional_fit import directional_sh
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.pipeline import FrameResult
from server.scene.placement import Placement
from server.shading import shadow_map as shadow_maps
from server.transfer.radiance_transfer import Cells
from tests.reference.shadow_map import irradiance
from tests.scenes import lights
from tests.scenes.analytic import look, look_at, plane
from tests.scenes.meshes import shape_of
from tests.scenes.solids import Scene, box, hit

CAMERA = CameraModel(width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5)
BOUNDS = (-0.8, -0.6, 0.5, 0.8, 0.4, 2.1)
FLOOR_Y = 0.2
"""y is down."""
VIEW = look_at((0.3, -0.7, 0.2), (0.0, FLOOR_Y, 1.2))
GREY = 150
PLATE = box((-0.12, 0.08, 1.08), (0.12, 0.1, 1.32))
"""Floats: nothing but its shadow says where it is."""
TOWARD = lights.unit((-0.5, -0.8, -0.2))
SKY = 0.2

Floats = NDArray[np.float64]


def light_of(spread_deg: float, toward: Floats = TOWARD) -> Floats:
    """[16, 3] a round lobe over an even sky."""
    lobe = np.outer(directional_sh(toward, np.radians(spread_deg), 4), (1.0, 0.9, 0.7))
    return lobe + lights.uniform((SKY,) * 3)


def frames(wall: bool = False) -> RgbdFrame:
    things = [plane((0.0, FLOOR_Y, 0.0), (0.0, -1.0, 0.0))]
    if wall:
        things.append(plane((-0.35, 0.0, 0.0), (1.0, 0.0, 0.0)))
    seen = look(things, CAMERA, VIEW).depth_m
    depth = np.where(seen < 4, np.rint(1000 * seen), 0).astype(np.uint16)
    return RgbdFrame(0, 0.0, np.full((CAMERA.height, CAMERA.width, 3), GREY, np.uint8), depth, VIEW)


def shown(
    device: Device, light: Floats, preset: Preset = "rm", *, wall: bool = False, indirect: bool = False
) -> FrameResult:
    """The floor with a plate above it."""
    wishes = Wishes(
        volume_m=BOUNDS,
        voxel_m=0.01,
        up=(0.0, -1.0, 0.0),
        preset=preset,
        indirect="observed" if indirect else "none",
        edges="hard",
        light=tuple((float(r), float(g), float(b)) for r, g, b in light),
    )
    pipeline = ClientSession(device, CAMERA, wishes)
    size, middle = PLATE.high - PLATE.low, (PLATE.high + PLATE.low) / 2
    place = Placement(position_m=(middle[0], PLATE.high[1], middle[2]))
    pipeline.place_object("plate", shape_of(trimesh.creation.box(size[[0, 2, 1]])), place)
    result = pipeline.process(frames(wall))
    pipeline.close()
    return result


def ratio_of(result: FrameResult) -> Floats:
    """[h, w] R' / R in green that the picture shows."""
    linear = linear_values("srgb8").astype(float)
    return np.asarray(linear[result.color[..., 1]] / linear[GREY])


@cache
def exact_ratio(spread_deg: float) -> tuple[Floats, NDArray[np.bool_]]:
    """[h, w] of a floor in the open under the sky and a disc of the lobe's spread; and where the floor is seen."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u, float)], -1)
    rays = rays @ VIEW[:3, :3].T
    eye = VIEW[:3, 3]
    points = eye + ((FLOOR_Y - eye[1]) / rays[..., 1])[..., None] * rays
    length = np.linalg.norm(rays, axis=-1)
    toward_floor = hit(
        [PLATE], np.broadcast_to(eye, points.shape).reshape(-1, 3), (rays / length[..., None]).reshape(-1, 3)
    )
    is_floor = (rays[..., 1] > 0) & (toward_floor.reshape(u.shape) == np.inf)
    is_floor &= (np.abs(points[..., 0]) < 0.6) & (points[..., 2] > 0.7) & (points[..., 2] < 1.9)
    up, flat = np.array([0.0, -1.0, 0.0]), points[is_floor] - [0, 1e-6, 0]

    def over(solids: Scene, half_angle_rad: float) -> Floats:
        return irradiance(flat, up, TOWARD, half_angle_rad, lambda o, d: hit(solids, o, d) == np.inf, 200)

    far = box((9.0, 9.0, 9.0), (9.1, 9.1, 9.1))
    disc = 0.9 * over((PLATE,), 1.75 * np.radians(spread_deg)), 0.9 * over((far,), 1.75 * np.radians(spread_deg))
    ratio = np.ones(u.shape)
    ratio[is_floor] = (SKY + disc[0]) / (SKY + disc[1])
    return ratio, is_floor


@pytest.mark.parametrize("preset", ["rm", "art4", "gr15", "gr15fast"])
def test_small_light_throws_its_shadow(device: Device, preset: Preset) -> None:
    """Against the exact ratio; the sky is taken to be open, of which the plate hides a tenth at most."""
    spread_deg = 10.0
    result = shown(device, light_of(spread_deg), preset)
    assert {"shadow_map", "direct_real", "direct_virtual"} <= set(result.plan.run)
    found, (expected, is_floor) = ratio_of(result), exact_ratio(spread_deg)
    error = (found - expected)[is_floor]
    assert (expected[is_floor] < 0.4).sum() > 100
    assert np.sqrt(np.mean(error**2)) < 0.04  # seen: 0.020
    assert np.corrcoef(found[is_floor], expected[is_floor])[0, 1] > 0.98


def test_shadow_is_sharper_than_the_harmonics_can_show(device: Device) -> None:
    light = light_of(9.0)
    with patch.object(room_light, "split_light", lambda sh: SplitLight(sh, ())):
        blurred = shown(device, light)
    assert "shadow_map" not in blurred.plan.run
    expected, is_floor = exact_ratio(9.0)
    errors = [np.sqrt(np.mean((ratio_of(r) - expected)[is_floor] ** 2)) for r in (shown(device, light), blurred)]
    assert errors[0] < 0.6 * errors[1]


@pytest.mark.parametrize("indirect", [False, True])
def test_soft_light_is_drawn_as_before(device: Device, indirect: bool) -> None:
    """Byte for byte what comes without anything taken out, and the plan says why."""
    light = light_of(35.0)
    result = shown(device, light, indirect=indirect)
    left_out = {item.effect: item for item in result.plan.left_out}
    assert left_out["direct_real"].reason == "the light is soft"
    assert left_out["direct_real"].error_bound == 0.0
    with patch.object(room_light, "split_light", lambda sh: SplitLight(sh, ())):
        np.testing.assert_array_equal(result.color, shown(device, light, indirect=indirect).color)
    assert (result.color != GREY).any()


def test_shadow_of_a_wall_is_not_darkened_twice(device: Device) -> None:
    """A wall to the light's side stands before all of the disc: floor in its shadow keeps its picture but for the sky
    that the plate hides, and the plate is dark."""
    light = light_of(8.0, lights.unit((-0.9, -0.35, 0.0)))
    assert split_light(light).discs
    open_floor, walled = (ratio_of(shown(device, light, wall=wall)) for wall in (False, True))
    beside = np.zeros(open_floor.shape, bool)
    beside[:, 104:] = True  # of the plate, away from the light
    cast = beside & (open_floor < 0.8)
    assert cast.sum() > 150
    assert walled[cast].min() > 0.9
    plate = np.s_[43:55, 72:88]
    assert walled[plate].mean() < 0.4 * open_floor[plate].mean()


def test_surfaces_that_send_light_see_both_parts(device: Device) -> None:
    """With indirect light: the plate's underside and the floor send what the disc brings them; nothing is darker."""
    light = light_of(10.0)
    direct, both = (ratio_of(shown(device, light, indirect=indirect)) for indirect in (False, True))
    expected, is_floor = exact_ratio(10.0)
    umbra = is_floor & (expected < expected[is_floor].min() + 0.02)
    assert both[umbra].mean() > direct[umbra].mean()
    assert np.abs(both - direct)[is_floor].mean() < 0.02  # seen: 0.008
    with patch("server.effects.functions.shadow_maps.light_points_by_discs"):
        dim = ratio_of(shown(device, light, indirect=True))
    assert (both >= dim).all()
    assert (both > dim).any()


@pytest.mark.parametrize("indirect", [False, True])
def test_what_real_surface_leaves_of_a_disc_is_kept(
    device: Device, monkeypatch: pytest.MonkeyPatch, indirect: bool
) -> None:
    """By whichever effect comes last: without indirect light none lights the samples before the pixels."""
    kept: list[NDArray[np.int32]] = []
    traced, lit, cells = shadow_maps.trace_real, shadow_maps.light_real, []

    def trace_real(*arguments: Any, **options: Any) -> Any:
        cells.extend(given for given in arguments if isinstance(given, Cells))
        return traced(*arguments, **options)

    def light_real(engine: Engine, *arguments: Any) -> Any:
        kept.append(engine.download(cells[0].disc_frames))
        return lit(engine, *arguments)

    monkeypatch.setattr(shadow_maps, "trace_real", trace_real)
    monkeypatch.setattr(shadow_maps, "light_real", light_real)
    result = shown(device, light_of(10.0), "reg4", indirect=indirect)
    assert ("light_samples" in result.plan.run) == indirect
    assert len(kept) == 1
    assert (kept[0] == 1).sum() > 100
