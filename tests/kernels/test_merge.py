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
from server.geometry.merge import STILL_WEIGHT, TRUSTED_WEIGHT, merge_depth
from server.opencl.engine import Engine
from server.volume.raycast import LABEL_DYNAMIC, LABEL_FILLED, LABEL_NONE, LABEL_STATIC, Surface
from server.volume.volume import Volume
from tests.reference import merge as twin
from tests.scenes.analytic import look, look_at, pixel_rays, plane, quantised, room, sphere
from tests.scenes.tolerance import relative_tolerance
from tests.scenes.volumes import fill, upload_measurement, vectors

CAMERA = CameraModel(width=97, height=71, fx=80.0, fy=78.0, cx=47.313, cy=36.127)
VOXEL_M = 0.05
BOUNDS = (-1.4, -1.1, -1.4, 1.5, 1.2, 2.7)
VIEW = look_at((0.4, -0.3, -0.2), (-0.2, 0.2, 1.4))
FLIPS = 1e-3
"""Share of pixels where two depths or intensities are so near to a threshold that float32 decides otherwise."""
GREY, WHITE = 0.25, 0.8
"""Linear radiance of two surfaces with different intensities."""

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Merged:
    """A merged buffer on the host."""

    positions: NDArray[np.float32]
    normals: NDArray[np.float32]
    labels: NDArray[np.uint8]
    depth_m: Floats


def in_volume(view: Floats = VIEW) -> Floats:
    """volume_from_camera of a view."""
    pose = view.copy()
    pose[:3, 3] -= BOUNDS[:3]
    return pose


def surface_from(depth_m: Floats, camera: CameraModel = CAMERA) -> tuple[Floats, Floats]:
    """positions and normals [h, w, 4] as a volume that sees `depth_m` would give them; the normals are marked."""
    pose, valid = in_volume(), depth_m > 0
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
    radiance: Floats | None = None,
    weight: Floats | float = 64.0,
    frames: int = 100,
) -> Merged:
    """radiance: linear [h, w] or [h, w, 3]; weight: of the voxels [z, y, x]; frames: that the volume has integrated."""

    def upload(name: str, values: Floats) -> Any:
        return engine.workspace.upload(name, values.astype(np.float32).view(cl_types.float4)[..., 0])

    color = None if radiance is None else np.broadcast_to(radiance.reshape(*depth_m.shape, -1), (*depth_m.shape, 3))
    volume = Volume(engine, BOUNDS, VOXEL_M)
    shape = tuple(8 * count for count in reversed(volume.bricks))
    fill(engine, volume, np.ones(shape), np.broadcast_to(weight, shape))
    volume.frames = frames
    labels = engine.workspace.upload("model_labels", np.full(depth_m.shape, 77, np.uint8))
    surface = Surface(upload("test_positions", positions), upload("test_normals", normals), labels)
    measurement = upload_measurement(engine, depth_m, color)
    result = merge_depth(engine, camera, in_volume(), measurement, surface, volume)
    buffers = [vectors(engine.download(a)) for a in (result.positions, result.normals)]
    depth = (buffers[0][..., :3] - in_volume()[:3, 3]) @ in_volume()[:3, 2]
    merged = Merged(*buffers, engine.download(result.labels), np.where(buffers[0][..., 3] > 0, depth, 0))
    assert np.isfinite(merged.positions).all()
    assert np.isfinite(merged.normals).all()
    np.testing.assert_array_equal(merged.labels == LABEL_NONE, merged.positions[..., 3] == 0)
    return merged


# ---- against the twin --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(97, 71), (64, 64), (8, 8), (17, 130)])
def test_matches_twin(engine: Engine, size: tuple[int, int]) -> None:
    """A scene with holes, noise, moved objects, and pixels unknown to sensor or volume or with few observations."""
    camera = replace(CAMERA, width=size[0], height=size[1], cx=size[0] / 2.1, cy=size[1] / 1.9)
    rng = np.random.default_rng(size[0])
    walls = room((-1.3, -1.0, -1.3), (1.4, 1.1, 2.6))
    volume_sees = look([walls, sphere((0.1, 0.2, 0.9), 0.3)], camera, VIEW).depth_m
    sensor_sees = look([walls, sphere((-0.2, 0.2, 1.0), 0.3)], camera, VIEW).depth_m
    ball = np.abs(sensor_sees - look([walls], camera, VIEW).depth_m) > 0
    sensor_sees = sensor_sees + rng.normal(size=sensor_sees.shape) * 0.02
    holes = rng.random((-(-size[1] // 6), -(-size[0] // 6))) < 0.2
    holes = np.kron(holes, np.ones((6, 6), bool))[: size[1], : size[0]]
    for picture in (volume_sees, sensor_sees):
        picture[rng.random(picture.shape) < 0.1] = 0
    sensor_sees[holes] = 0
    volume_sees[np.roll(holes, 9, axis=1)] = 0
    depth = sensor_sees.astype(np.float32).astype(np.float64)
    color = np.where(ball[..., None], [0.5, 0.3, 0.2], [0.2, 0.25, 0.3]) + rng.normal(size=(*ball.shape, 3)) * 0.02
    color = color.astype(np.float32).astype(np.float64)
    weight = rng.choice([0.0, 4.0, 5.0, 64.0], (48, 48, 64), p=[0.1, 0.1, 0.2, 0.6])
    weight = np.ones((88, 48, 64)) * np.resize(weight, (88, 48, 64))
    positions, normals = surface_from(volume_sees, camera)
    positions = positions.astype(np.float32).astype(np.float64)
    voxel = (positions[..., :3] / VOXEL_M).astype(int)
    age = weight[voxel[..., 2], voxel[..., 1], voxel[..., 0]]
    merged = merge(engine, depth, positions, normals, camera=camera, radiance=color, weight=weight)
    expected = twin.merge_depth(
        camera,
        in_volume(),
        depth,
        color,
        VOXEL_M,
        positions,
        normals,
        trusted=age >= TRUSTED_WEIGHT,
        still=age >= STILL_WEIGHT,
    )
    same = merged.labels == expected[2]
    assert (~same).mean() <= FLIPS
    assert set(np.unique(expected[2])) == {LABEL_NONE, LABEL_STATIC, LABEL_DYNAMIC, LABEL_FILLED} or min(size) == 8
    rounding = relative_tolerance(engine.device)
    far = np.abs(merged.positions - expected[0]).max(axis=-1) > rounding * 5  # metres, 5 m from the volume's corner
    assert (far & same).mean() <= FLIPS
    # A slope is made of differences of inverse depths over 8 pixels, some hundredth of them: 100 times their rounding.
    turned = np.abs(merged.normals - expected[1]).max(axis=-1) > 100 * rounding
    assert (turned & same).mean() <= FLIPS
    assert (merged.normals[merged.labels == LABEL_DYNAMIC][:, 3] > 0).mean() > 0.99  # seen: all


# ---- D', the cases of eq. 4.3 ------------------------------------------------------------------------------------

FLAT = np.full((CAMERA.height, CAMERA.width), 1.5)
NOTHING = np.zeros_like(FLAT)
ALLOWED_M = float(twin.agreement_m(np.float64(1.5), VOXEL_M))
ALLOWED_MEAN_M = VOXEL_M + 0.8 * (0.0012 + 0.0019 * 1.1**2)
HAND_M = 0.6
HAND = np.zeros(FLAT.shape, bool)
HAND[20:50, 30:60] = True
BEFORE_WALL = np.where(HAND, HAND_M, FLAT)
BRIGHT_HAND = np.where(HAND, WHITE, GREY)


def block(rows: slice, columns: slice) -> Bools:
    result = np.zeros(FLAT.shape, bool)
    result[rows, columns] = True
    return result


@pytest.mark.parametrize("shift", [0.0, 0.9, -0.9])
def test_where_both_agree_the_volume_is_kept(engine: Engine, shift: float) -> None:
    positions, normals = surface_from(FLAT + shift * ALLOWED_MEAN_M)
    merged = merge(engine, FLAT, positions, normals)
    assert (merged.labels == LABEL_STATIC).all()
    np.testing.assert_array_equal(merged.positions, positions.astype(np.float32))
    np.testing.assert_array_equal(merged.normals, normals.astype(np.float32))


def test_noise_is_not_motion_but_a_shift_all_around_is(engine: Engine) -> None:
    """Both by less than lambda_D: here and there, to and fro; or in one piece, where the volume lags."""
    shift = 0.5 * ALLOWED_M * np.random.default_rng(2).choice([-1.0, 1.0], FLAT.shape)
    positions, normals = surface_from(FLAT)
    inside = block(slice(2, -2), slice(2, -2))  # with 25 pixels around, over which this averages out
    assert (merge(engine, FLAT + shift, positions, normals).labels == LABEL_STATIC)[inside].all()
    merged = merge(engine, np.where(HAND, FLAT - 0.9 * ALLOWED_M, FLAT), positions, normals)
    inner = block(slice(24, 46), slice(34, 56))
    assert (merged.labels[inner] == LABEL_DYNAMIC).all()
    assert (merged.labels[~block(slice(18, 52), slice(28, 62))] == LABEL_STATIC).all()


@pytest.mark.parametrize("shift", [1.1, -1.1, 5.0, -5.0])
def test_where_they_disagree_the_sensor_is_taken(engine: Engine, shift: float) -> None:
    positions, normals = surface_from(FLAT + shift * ALLOWED_M)
    merged = merge(engine, FLAT, positions, normals)
    assert (merged.labels == LABEL_DYNAMIC).all()
    np.testing.assert_allclose(merged.positions, surface_from(FLAT)[0], atol=1e-5)
    np.testing.assert_allclose(merged.normals[..., :3], np.broadcast_to(-VIEW[:3, 2], (*FLAT.shape, 3)), atol=1e-6)


def test_where_the_sensor_is_blind_the_volume_is_kept(engine: Engine) -> None:
    positions, normals = surface_from(FLAT)
    merged = merge(engine, NOTHING, positions, normals)
    assert (merged.labels == LABEL_STATIC).all()
    np.testing.assert_array_equal(merged.positions, positions.astype(np.float32))


def test_where_the_volume_is_empty_the_sensor_is_taken(engine: Engine) -> None:
    merged = merge(engine, FLAT, *surface_from(NOTHING))
    assert (merged.labels == LABEL_DYNAMIC).all()
    assert (merged.positions[..., 3] == 1).all()
    assert (merged.normals[..., 3] == 1).all()


def test_where_neither_knows_there_is_nothing(engine: Engine) -> None:
    merged = merge(engine, NOTHING, *surface_from(NOTHING))
    assert (merged.labels == LABEL_NONE).all()
    assert not merged.positions.any()
    assert not merged.normals.any()


def test_a_hand_before_a_wall(engine: Engine) -> None:
    """Only the hand is dynamic, with its own position, and its rim has normals of the hand, not of the step."""
    merged = merge(engine, BEFORE_WALL, *surface_from(FLAT), radiance=BRIGHT_HAND)
    np.testing.assert_array_equal(merged.labels == LABEL_DYNAMIC, HAND)
    np.testing.assert_allclose(merged.positions, surface_from(BEFORE_WALL)[0], atol=1e-5)
    np.testing.assert_allclose(merged.normals[HAND][:, :3], np.broadcast_to(-VIEW[:3, 2], (900, 3)), atol=1e-6)


def test_a_thing_that_was_taken_away_is_gone(engine: Engine) -> None:
    merged = merge(engine, FLAT, *surface_from(BEFORE_WALL))
    np.testing.assert_array_equal(merged.labels == LABEL_DYNAMIC, HAND)
    np.testing.assert_allclose(merged.positions, surface_from(FLAT)[0], atol=1e-5)


def test_a_lone_pixel_has_a_place_but_no_normal(engine: Engine) -> None:
    depth = NOTHING.copy()
    depth[30, 40] = 1.0
    merged = merge(engine, depth, *surface_from(NOTHING))
    assert merged.labels[30, 40] == LABEL_DYNAMIC
    assert merged.positions[30, 40, 3] == 1
    assert not merged.normals.any()


# ---- D', holes of the sensor -------------------------------------------------------------------------------------


def test_a_hole_in_a_hand_is_filled_with_hand(engine: Engine) -> None:
    """The volume knows the wall behind it, but the pixels as bright as the hole say that the scene has changed."""
    hole = block(slice(30, 38), slice(40, 50))
    merged = merge(engine, np.where(hole, 0, BEFORE_WALL), *surface_from(FLAT), radiance=BRIGHT_HAND)
    np.testing.assert_allclose(merged.depth_m, BEFORE_WALL, atol=1e-5)
    np.testing.assert_array_equal(merged.labels == LABEL_FILLED, hole)
    np.testing.assert_array_equal(merged.labels == LABEL_DYNAMIC, HAND & ~hole)
    assert (merged.normals[hole][:, 3] == 1).all()


def test_a_hole_beside_a_hand_is_the_volume(engine: Engine) -> None:
    """As behind a hand in the projector's shadow: the pixels as bright as the hole agree with the volume."""
    hole = block(slice(20, 50), slice(18, 30))
    merged = merge(engine, np.where(hole, 0, BEFORE_WALL), *surface_from(FLAT), radiance=BRIGHT_HAND)
    np.testing.assert_allclose(merged.depth_m, BEFORE_WALL, atol=1e-5)
    assert (merged.labels[hole] == LABEL_STATIC).all()


def test_a_hole_unlike_all_around_it_is_the_volume_or_stays(engine: Engine) -> None:
    """Too few supporting neighbours for a median."""
    hole = block(slice(30, 38), slice(40, 50))
    depth, radiance = np.where(hole, 0, BEFORE_WALL), np.where(hole, GREY / 4, BRIGHT_HAND)
    merged = merge(engine, depth, *surface_from(FLAT), radiance=radiance)
    assert (merged.labels[hole] == LABEL_STATIC).all()
    merged = merge(engine, depth, *surface_from(NOTHING), radiance=radiance)
    assert (merged.labels[hole] == LABEL_NONE).all()


def test_without_a_volume_a_hole_is_filled_as_far_as_support_reaches(engine: Engine) -> None:
    hole = block(slice(15, 60), slice(20, 70))
    merged = merge(engine, np.where(hole, 0, FLAT), *surface_from(NOTHING))
    filled = merged.labels == LABEL_FILLED
    assert (filled <= hole).all()
    assert not filled[24:51, 29:61].any()
    assert filled[16, 30:60].all()
    np.testing.assert_allclose(merged.depth_m[filled], 1.5, atol=1e-5)


@pytest.mark.parametrize(
    ("weight", "frames", "label"), [(14, 40, LABEL_NONE), (15, 40, LABEL_STATIC), (3, 6, LABEL_STATIC)]
)
def test_surface_that_is_new_does_not_fill_holes(engine: Engine, weight: float, frames: int, label: int) -> None:
    """A hand that moved on left surface behind; in a hole of the sensor only its age distinguishes it."""
    hole = block(slice(15, 60), slice(20, 70))
    merged = merge(
        engine, np.where(hole, 0, FLAT), *surface_from(np.where(hole, HAND_M, FLAT)), weight=weight, frames=frames
    )
    assert (merged.labels[26:49, 31:59] == label).all()
    assert (merged.labels[~hole] == LABEL_STATIC).all()


def test_surface_that_the_sensor_contradicts_does_not_fill_holes(engine: Engine) -> None:
    """The volume still has a hand that is gone: the sensor sees the wall through most of it, and nothing in a hole."""
    hole = block(slice(32, 40), slice(42, 50))
    radiance = np.where(hole, WHITE, GREY)  # no neighbour is like the hole: eq. 4.3 alone would keep the volume
    merged = merge(engine, np.where(hole, 0, FLAT), *surface_from(BEFORE_WALL), radiance=radiance)
    assert (merged.labels[hole] == LABEL_NONE).all()
    merged = merge(engine, np.where(hole, 0, FLAT), *surface_from(BEFORE_WALL))
    np.testing.assert_allclose(merged.depth_m[hole], 1.5, atol=1e-5)


def test_pixels_that_mix_two_surfaces_are_taken_for_holes(engine: Engine) -> None:
    """The rim of the hand has depths between hand and wall, as time-of-flight and stereo cameras give them."""
    share = np.random.default_rng(3).uniform(0.1, 0.9, FLAT.shape)
    inner = block(slice(21, 49), slice(31, 59))
    depth = np.where(HAND & ~inner, share * HAND_M + (1 - share) * 1.5, BEFORE_WALL)
    for volume_sees in (FLAT, NOTHING):
        merged = merge(engine, depth, *surface_from(volume_sees), radiance=BRIGHT_HAND)
        between = np.minimum(np.abs(merged.depth_m - HAND_M), np.abs(merged.depth_m - 1.5)) > 0.06
        assert between.sum() <= 2  # of 116
        assert (np.abs(merged.depth_m - HAND_M) < 0.06)[HAND].mean() > 0.99


# ---- D'' and D''' ------------------------------------------------------------------------------------------------


def test_the_lower_of_two_middle_values_is_the_median(engine: Engine) -> None:
    depth = NOTHING.copy()
    depth[30, [40, 42]] = 1.0, 1.02
    merged = merge(engine, depth, *surface_from(NOTHING))
    np.testing.assert_allclose(merged.depth_m[30, [40, 42]], 1.0, atol=1e-6)
    depth[32, 40] = 1.01  # three: the middle one
    merged = merge(engine, depth, *surface_from(NOTHING))
    np.testing.assert_allclose(merged.depth_m[[30, 30, 32], [40, 42, 40]], 1.01, atol=1e-6)


@pytest.mark.parametrize("shift_px", [(1, 0), (0, 1), (-1, -1)])
def test_depth_edges_move_to_the_edges_of_the_picture(engine: Engine, shift_px: tuple[int, int]) -> None:
    """Colour and depth that are a pixel apart (eq. 4.4); unlike the volume, both hand and wall have moved."""
    depth = np.roll(BEFORE_WALL, shift_px, axis=(0, 1))
    merged = merge(engine, depth, *surface_from(NOTHING), radiance=BRIGHT_HAND)
    wrong = np.abs(merged.depth_m - BEFORE_WALL) > 1e-3
    assert (np.abs(depth - BEFORE_WALL) > 1e-3).sum() >= 58
    assert wrong.sum() <= 4  # corners


def test_what_is_the_volumes_all_around_is_not_filtered(engine: Engine) -> None:
    """An edge of depth beside one of the picture: it stays where the volume has it, but near what the sensor says."""
    depth = np.roll(BEFORE_WALL, (1, 1), axis=(0, 1))
    merged = merge(engine, depth, *surface_from(depth), radiance=BRIGHT_HAND)
    assert (merged.labels == LABEL_STATIC).all()
    np.testing.assert_allclose(merged.depth_m, depth, atol=1e-5)
    row, col = np.argwhere(np.diff(depth, axis=1))[5]
    known = depth.copy()
    known[row, col + 1] = 0
    some = merge(engine, depth, *surface_from(known), radiance=BRIGHT_HAND)
    changed = np.argwhere(np.abs(some.depth_m - depth) > 1e-3)
    assert len(changed) > 0
    assert (np.abs(changed - [row, col + 1]) <= 3).all()


def test_speckles_are_removed(engine: Engine) -> None:
    rng = np.random.default_rng(5)
    speckled = rng.random(FLAT.shape) < 0.03
    depth = np.where(speckled, FLAT * rng.uniform(0.4, 0.9, FLAT.shape), FLAT)
    for volume_sees in (FLAT, NOTHING):
        merged = merge(engine, depth, *surface_from(volume_sees))
        np.testing.assert_allclose(merged.depth_m, 1.5, atol=1e-5)


@pytest.mark.parametrize("width_px", [1, 2, 3])
def test_thin_things_survive(engine: Engine, width_px: int) -> None:
    """A rod before a wall, brighter than it, upright or slanting."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    for slope in (0.0, 0.5):
        offset = u - 40 - np.floor(slope * v)
        rod = (offset >= 0) & (offset < width_px)
        depth = np.where(rod, 0.9, FLAT)
        for volume_sees in (FLAT, NOTHING):
            merged = merge(engine, depth, *surface_from(volume_sees), radiance=np.where(rod, WHITE, GREY))
            np.testing.assert_allclose(merged.depth_m[2:-2], depth[2:-2], atol=1e-5)
            assert (merged.normals[5:-5][rod[5:-5]][:, 3] == 1).all()  # at an end, too little is seen of a rod


# ---- normals -----------------------------------------------------------------------------------------------------

PLANES = {
    "frontal": (0.0, 0.0, -1.0),
    "to the right": (-0.7, 0.0, -0.7),
    "to the left": (0.8, 0.1, -0.5),
    "floor": (0.0, -0.8, -0.6),
    "ceiling": (0.2, 0.7, -0.5),
}


LENS = replace(CAMERA, width=160, height=120, fx=140.0, fy=138.0, cx=78.3, cy=61.1)
RIM_PX = 7
"""Nearer to the picture's border the medians' windows are one-sided, and move a sloping surface by up to a pixel."""


@pytest.mark.parametrize("step_m", [0.0, 0.001])
@pytest.mark.parametrize("name", PLANES)
def test_normals_of_planes(engine: Engine, name: str, step_m: float) -> None:
    """Inverse depth is linear, so the fit is exact up to the ridge, which flattens by 1 %."""
    normal = VIEW[:3, :3] @ np.array(PLANES[name]) / np.linalg.norm(PLANES[name])
    depth = look([plane(VIEW[:3, 3] + 0.9 * VIEW[:3, 2], normal)], LENS, VIEW).depth_m
    depth = np.where(depth < 3, depth, 0)
    depth = quantised(depth, step_m) if step_m else depth
    merged = merge(engine, depth, *surface_from(np.zeros_like(depth), LENS), camera=LENS)
    rays = pixel_rays(LENS) @ VIEW[:3, :3].T
    inner = (depth > 0) & (-(rays @ normal) > np.cos(np.deg2rad(60)) * np.linalg.norm(rays, axis=-1))
    rim = ~np.pad(np.ones((120 - 2 * RIM_PX, 160 - 2 * RIM_PX), bool), RIM_PX)
    assert (inner & ~rim).mean() > 0.4
    assert (merged.normals[inner][:, 3] > 0).all()
    error = np.degrees(np.arccos(np.clip(merged.normals[..., :3] @ normal, -1, 1)))
    assert np.percentile(error[inner & ~rim], 98) < (2.0 if step_m else 0.7)
    assert np.median(error[inner & rim]) < 10


def test_normals_face_the_camera(engine: Engine) -> None:
    depth = look([room((-1.3, -1.0, -1.3), (1.4, 1.1, 2.6)), sphere((0.1, 0.2, 0.9), 0.3)], CAMERA, VIEW)
    merged = merge(engine, depth.depth_m, *surface_from(NOTHING))
    rays = pixel_rays(CAMERA) @ VIEW[:3, :3].T
    valid = merged.normals[..., 3] > 0
    assert valid.mean() > 0.98
    assert ((merged.normals[..., :3] * rays).sum(-1)[valid] < 0).all()
    inner = valid & depth.is_continuous
    cosine = (merged.normals[..., :3] * depth.normals).sum(-1)[inner]
    assert np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))) < 1
    np.testing.assert_allclose(np.linalg.norm(merged.normals[valid, :3], axis=-1), 1, atol=1e-5)


def test_noise_of_the_sensor_is_smoothed(engine: Engine) -> None:
    """Noise as of a Kinect, an eighth of a pixel's disparity in steps of one: 40 degrees from pixel to pixel."""
    rng = np.random.default_rng(7)
    camera = replace(CAMERA, width=320, height=240, fx=290.0, fy=290.0, cx=160.0, cy=120.0)
    normal = VIEW[:3, :3] @ np.array([0.3, -0.4, -0.87])
    truth = look([plane(VIEW[:3, 3] + 1.5 * VIEW[:3, 2], normal)], camera, VIEW).depth_m
    disparity = 580 * 0.075 / truth
    disparity = np.rint(8 * (disparity + 0.06 * rng.normal(size=truth.shape))) / 8
    merged = merge(engine, 580 * 0.075 / disparity, *surface_from(np.zeros_like(truth), camera), camera=camera)
    cosine = merged.normals[..., :3] @ (normal / np.linalg.norm(normal))
    assert np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))) < 3.5
