"""The hybrid geometry buffer against its float64 twin, its cases one by one, and normals of planes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl.cltypes as cl_types
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.engine import Engine
from server.stages.merge import merge_depth
from server.stages.raycast import LABEL_DYNAMIC, LABEL_NONE, LABEL_STATIC, Surface
from tests.analytic import look, look_at, pixel_rays, plane, quantised, room, sphere
from tests.reference import merge as twin
from tests.tolerance import relative_tolerance
from tests.volumes import upload_measurement, vectors

CAMERA = CameraModel(width=97, height=71, fx=80.0, fy=78.0, cx=47.313, cy=36.127)
VOXEL_M = 0.02
POSE = look_at((0.4, -0.3, -0.2), (-0.2, 0.2, 1.4))
FLIPS = 1e-3
"""Share of pixels whose disagreement is so near to the allowed one that float32 decides otherwise."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Merged:
    """A merged buffer on the host."""

    positions: NDArray[np.float32]
    normals: NDArray[np.float32]
    labels: NDArray[np.uint8]


def surface_from(depth_m: Floats, camera: CameraModel = CAMERA, pose: Floats = POSE) -> tuple[Floats, Floats]:
    """positions and normals [h, w, 4] as a volume that sees `depth_m` would give them; the normals are marked."""
    valid = depth_m > 0
    points = (depth_m[..., None] * pixel_rays(camera)) @ pose[:3, :3].T + pose[:3, 3]
    positions = np.where(valid[..., None], np.concatenate([points, np.ones((*valid.shape, 1))], -1), 0)
    normals = np.where(valid[..., None], np.array([0.6, 0.0, -0.8, 1.0]), 0)
    return positions, normals


def merge(
    engine: Engine,
    depth_m: Floats,
    positions: Floats,
    normals: Floats,
    *,
    camera: CameraModel = CAMERA,
    pose: Floats = POSE,
) -> Merged:
    def upload(name: str, values: Floats) -> Any:
        return engine.workspace.upload(name, values.astype(np.float32).view(cl_types.float4)[..., 0])

    labels = engine.workspace.upload("model_labels", np.full(depth_m.shape, 77, np.uint8))
    surface = Surface(upload("positions", positions), upload("normals", normals), labels)
    result = merge_depth(engine, camera, pose, upload_measurement(engine, depth_m), surface, VOXEL_M)
    buffers = (vectors(engine.download(a)) for a in (result.positions, result.normals))
    merged = Merged(*buffers, engine.download(result.labels))
    assert np.isfinite(merged.positions).all()
    assert np.isfinite(merged.normals).all()
    return merged


# ---- against the twin --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(97, 71), (64, 64), (8, 8), (17, 130)])
def test_matches_twin(engine: Engine, size: tuple[int, int]) -> None:
    """A scene with holes, noise, things that moved, and places where either knows nothing."""
    camera = replace(CAMERA, width=size[0], height=size[1], cx=size[0] / 2.1, cy=size[1] / 1.9)
    rng = np.random.default_rng(size[0])
    walls = room((-1.3, -1.0, -1.3), (1.4, 1.1, 2.6))
    volume_sees = look([walls, sphere((0.1, 0.2, 0.9), 0.3)], camera, POSE).depth_m
    sensor_sees = look([walls, sphere((-0.2, 0.2, 1.0), 0.3)], camera, POSE).depth_m
    sensor_sees = sensor_sees + rng.normal(size=sensor_sees.shape) * 0.02
    for picture in (volume_sees, sensor_sees):
        picture[rng.random(picture.shape) < 0.15] = 0
    depth = sensor_sees.astype(np.float32).astype(np.float64)
    positions, normals = surface_from(volume_sees, camera)
    merged = merge(engine, depth, positions, normals, camera=camera)
    expected = twin.merge_depth(camera, POSE, depth, VOXEL_M, positions, normals)
    same = merged.labels == expected[2]
    assert (~same).mean() <= FLIPS
    assert set(np.unique(expected[2])) == {LABEL_NONE, LABEL_STATIC, LABEL_DYNAMIC} or min(size) == 8
    rounding = relative_tolerance(engine.device)
    np.testing.assert_allclose(merged.positions[same], expected[0][same], atol=rounding * 3)  # metres, 3 m away
    # A normal is made of differences of 4 pixels, 5 % of the depth: their rounding is 20 times the coordinates'.
    np.testing.assert_allclose(merged.normals[same], expected[1][same], atol=20 * rounding)


# ---- the cases of eq. 4.3 ----------------------------------------------------------------------------------------

FLAT = np.full((CAMERA.height, CAMERA.width), 1.5)
ALLOWED_M = float(twin.agreement_m(np.float64(1.5), VOXEL_M))


@pytest.mark.parametrize("shift", [0.0, 0.9, -0.9])
def test_where_both_agree_the_volume_is_kept(engine: Engine, shift: float) -> None:
    positions, normals = surface_from(FLAT + shift * ALLOWED_M)
    merged = merge(engine, FLAT, positions, normals)
    assert (merged.labels == LABEL_STATIC).all()
    np.testing.assert_array_equal(merged.positions, positions.astype(np.float32))
    np.testing.assert_array_equal(merged.normals, normals.astype(np.float32))


@pytest.mark.parametrize("shift", [1.1, -1.1, 10.0, -10.0])
def test_where_they_disagree_the_sensor_is_taken(engine: Engine, shift: float) -> None:
    positions, normals = surface_from(FLAT + shift * ALLOWED_M)
    merged = merge(engine, FLAT, positions, normals)
    assert (merged.labels == LABEL_DYNAMIC).all()
    np.testing.assert_allclose(merged.positions, surface_from(FLAT)[0], atol=1e-5)
    np.testing.assert_allclose(merged.normals[..., :3], np.broadcast_to(-POSE[:3, 2], (*FLAT.shape, 3)), atol=1e-3)


def test_where_the_sensor_is_blind_the_volume_is_kept(engine: Engine) -> None:
    positions, normals = surface_from(FLAT)
    merged = merge(engine, np.zeros_like(FLAT), positions, normals)
    assert (merged.labels == LABEL_STATIC).all()
    np.testing.assert_array_equal(merged.positions, positions.astype(np.float32))


def test_where_the_volume_is_empty_the_sensor_is_taken(engine: Engine) -> None:
    nothing = surface_from(np.zeros_like(FLAT))
    merged = merge(engine, FLAT, *nothing)
    assert (merged.labels == LABEL_DYNAMIC).all()
    assert (merged.positions[..., 3] == 1).all()
    assert (merged.normals[..., 3] == 1).all()


def test_where_neither_knows_there_is_nothing(engine: Engine) -> None:
    nothing = surface_from(np.zeros_like(FLAT))
    merged = merge(engine, np.zeros_like(FLAT), *nothing)
    assert (merged.labels == LABEL_NONE).all()
    assert not merged.positions.any()
    assert not merged.normals.any()


def test_a_hand_before_a_wall(engine: Engine) -> None:
    """Only the hand is dynamic, with its own position, and its rim has normals of the hand, not of the step."""
    hand = FLAT.copy()
    hand[20:50, 30:60] = 0.6
    merged = merge(engine, hand, *surface_from(FLAT))
    np.testing.assert_array_equal(merged.labels == LABEL_DYNAMIC, hand < 1)
    np.testing.assert_allclose(merged.positions, surface_from(hand)[0], atol=1e-5)
    np.testing.assert_allclose(merged.normals[hand < 1][:, :3], np.broadcast_to(-POSE[:3, 2], (900, 3)), atol=1e-3)


def test_a_lone_pixel_has_a_place_but_no_normal(engine: Engine) -> None:
    depth = np.zeros_like(FLAT)
    depth[30, 40] = 1.0
    merged = merge(engine, depth, *surface_from(np.zeros_like(FLAT)))
    assert merged.labels[30, 40] == LABEL_DYNAMIC
    assert merged.positions[30, 40, 3] == 1
    assert not merged.normals.any()


# ---- normals -----------------------------------------------------------------------------------------------------

PLANES = {
    "frontal": (0.0, 0.0, -1.0),
    "to the right": (-0.7, 0.0, -0.7),
    "to the left": (0.8, 0.1, -0.5),
    "floor": (0.0, -0.8, -0.6),
    "ceiling": (0.2, 0.7, -0.5),
}


@pytest.mark.parametrize("step_m", [0.0, 0.001])
@pytest.mark.parametrize("name", PLANES)
def test_normals_of_planes(engine: Engine, name: str, step_m: float) -> None:
    """A plane stays one at the picture's border, where differences are one-sided. Seen too flat, it has no normals."""
    normal = POSE[:3, :3] @ np.array(PLANES[name]) / np.linalg.norm(PLANES[name])
    depth = look([plane(POSE[:3, 3] + 0.9 * POSE[:3, 2], normal)], CAMERA, POSE).depth_m
    depth = np.where(depth < 3, depth, 0)
    depth = quantised(depth, step_m) if step_m else depth
    merged = merge(engine, depth, *surface_from(np.zeros_like(depth)))
    valid = merged.normals[..., 3] > 0
    rays = pixel_rays(CAMERA) @ POSE[:3, :3].T
    steep = -(rays @ normal) > np.cos(np.deg2rad(60)) * np.linalg.norm(rays, axis=-1)
    assert (depth > 0).mean() > 0.5
    assert valid[steep & (depth > 0)].all()
    error = np.degrees(np.arccos(np.clip(merged.normals[valid, :3] @ normal, -1, 1)))
    assert np.median(error) < 1.0
    if not step_m:
        assert np.percentile(error, 98) < 1.0


def test_normals_face_the_camera(engine: Engine) -> None:
    depth = look([room((-1.3, -1.0, -1.3), (1.4, 1.1, 2.6)), sphere((0.1, 0.2, 0.9), 0.3)], CAMERA, POSE)
    merged = merge(engine, depth.depth_m, *surface_from(np.zeros_like(FLAT)))
    rays = pixel_rays(CAMERA) @ POSE[:3, :3].T
    valid = merged.normals[..., 3] > 0
    assert valid.mean() > 0.98
    assert ((merged.normals[..., :3] * rays).sum(-1)[valid] < 0).all()
    inner = valid & depth.is_continuous
    cosine = (merged.normals[..., :3] * depth.normals).sum(-1)[inner]
    assert np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))) < 1
    np.testing.assert_allclose(np.linalg.norm(merged.normals[valid, :3], axis=-1), 1, atol=1e-5)
