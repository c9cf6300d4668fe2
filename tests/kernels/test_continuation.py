"""Planes continued beyond the pictures: the kernel against its twin, and extents found from shading alone."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from client.options.source import open_source
from client.sources.volume import default_volume, default_voxel
from protocol.frames import CameraModel
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.light.cell_transfer import PoolGrid, PoolWindow
from server.light.continuation import (
    LEAST_M,
    MOST_GROWTH,
    NO_PLANES,
    RETRY_FRAMES,
    TRIES,
    TRIES_OF_A_TABLE,
    Continuation,
    Judged,
    _Trial,
    spokes,
)
from server.light.light_model import LightModel
from server.light.lobe_estimator import LobeEstimator
from server.maths.light_direction import direction_error_deg
from server.maths.lobes import CELLS, RIDGE, cell_directions, lobe_family
from server.maths.planes import SIDES, STEPS_M, PlanePatch, find_planes
from server.opencl.device import Device
from server.opencl.engine import Engine
from tests.data import data_folder
from tests.reference.planes import beyond, looked_through
from tests.scenes.analytic import Floats
from tests.scenes.plane_patches import FLOOR, WALL, corner

CAMERA = CameraModel(width=64, height=48, fx=50.0, fy=50.0, cx=31.5, cy=23.5)


def settled(continuation: Continuation, judged: Judged) -> None:
    """Let extents be tried until they are believed, or not."""
    for _ in range(10):
        continuation.try_extents(lambda: judged)


def looking(points: Floats, normals: Floats) -> Continuation:
    continuation = Continuation()
    for _ in range(2):
        continuation.find(points, normals)
        continuation.look(CAMERA, np.eye(4), np.zeros((48, 64)))
    return continuation


def test_hidden_cells_match_twin(engine: Engine) -> None:
    rng = np.random.default_rng(1)
    continuation = Continuation()
    planes = continuation.planes = find_planes(*corner(), [])
    for plane in planes:
        plane.steps[:] = rng.integers(0, 8, 4)
        plane.empty |= rng.random(plane.empty.shape) < 0.2
    continuation._boxes = [plane.box for plane in planes]
    grid = PoolGrid(2, 3, 7)
    window = PoolWindow(engine, grid.count, 2)
    positions = rng.random((2, grid.count, 3)) * [1, 0.9, 0.9] + [0, 0, 1]
    raw = rng.random((2, grid.count, CELLS)).astype(np.float32)
    places = np.zeros((2, grid.count, 8), np.float32)
    places[..., :3], places[..., 3] = positions, 1
    window.raw.set(raw)
    window._places.set(places)
    window.hide([1], continuation.arrays())
    directions = spokes().reshape(-1, 3)
    hidden = np.zeros((grid.count, CELLS * 4), np.bool_)
    for plane in planes:
        needed = beyond(plane, positions[1], directions, LEAST_M)
        reach = np.array(STEPS_M)[plane.steps]
        hidden |= np.logical_and.reduce([side <= most for side, most in zip(needed, reach, strict=True)])
    expected = raw[1] * (1 - hidden.reshape(grid.count, CELLS, 4).mean(axis=2))
    got = engine.download(window.values)[1]
    assert 0.05 < hidden.mean() < 0.95
    differs = ~np.isclose(got, expected, atol=1e-5)
    assert differs.mean() < 0.002  # float32 decides otherwise at the edges of map cells
    window.hide([0], NO_PLANES)
    np.testing.assert_array_equal(engine.download(window.values)[0], raw[0])


def test_spokes_stay_in_their_cells() -> None:
    directions = spokes()
    np.testing.assert_allclose(np.linalg.norm(directions, axis=2), 1)
    own = np.einsum("ksx,kx->ks", directions, cell_directions())
    assert (own > np.cos(np.deg2rad(7))).all()
    np.testing.assert_allclose(directions.mean(axis=1) / np.linalg.norm(directions.mean(axis=1), axis=1)[:, None],
                               cell_directions(), atol=1e-6)  # fmt: skip


def shaded_corner(extent_m: float, noise: float = 0.02) -> tuple[Floats, Floats, Judged]:
    """A floor before a wall that goes on `extent_m` beyond both of its seen sides, under a light from behind the wall's
    unseen part: what the floor shows tells how far the wall goes."""
    rng = np.random.default_rng(2)
    points, normals = corner(250)
    transfer = np.maximum(normals @ cell_directions().T, 0)
    transfer /= transfer.sum(axis=1, keepdims=True)
    continuation = Continuation()
    continuation.planes = find_planes(points, normals, [])
    wall = next(plane for plane in continuation.planes if plane.normal @ WALL > 0.9)
    needed = np.stack(beyond(wall, points, spokes().reshape(-1, 3), LEAST_M)).max(axis=0)
    shown = transfer * (1 - (needed <= extent_m).reshape(len(points), CELLS, 4).mean(axis=2))
    towards = np.stack([[1.0, -0.3, 0.5], [-1.0, -0.5, 0.4], [0, -1, 0.2]])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    light = 0.3 + (8 * np.exp(-0.5 * (np.arccos(np.clip(cell_directions() @ towards.T, -1, 1)) / 0.5) ** 2)).sum(axis=1)
    target = shown @ light * (1 + noise * rng.normal(size=len(points)))
    weights = 1 / np.maximum(target, 0.05 * target.mean()) ** 2
    return points, normals, Judged(points, transfer, lobe_family(25.0), target, np.zeros(len(points)), weights)


def test_a_wall_goes_on_as_far_as_the_shading_says() -> None:
    points, normals, judged = shaded_corner(1.0)
    continuation = looking(points, normals)
    settled(continuation, judged)
    wall = next(plane for plane in continuation.planes if plane.normal @ WALL > 0.9)
    assert continuation.explained < 0.5
    across = np.array(STEPS_M)[wall.steps]
    assert np.sort(across)[-2:].min() >= 0.6
    assert continuation.arrays()[0].shape[0] == len(continuation.planes)


def test_what_extents_leave_is_that_of_the_best_light() -> None:
    """However many steps led to them: against all pools at once, in float64, by another solver."""
    points, normals, judged = shaded_corner(1.0)
    rng = np.random.default_rng(6)
    judged = replace(judged, beyond=0.1 * rng.random(len(points)))
    planes = looking(points, normals).planes
    trial = _Trial(planes, judged, 0.01)
    while trial.unprepared:
        trial.prepare()
    for turn in range(2 * SIDES * len(planes)):
        trial.settle(*divmod(turn % (SIDES * len(planes)), SIDES))
    assert sum(plane.steps.sum() for plane in planes) > 3
    directions = spokes().reshape(-1, 3)
    hidden = np.zeros((len(points), len(directions)), np.bool_)
    for plane in planes:
        needed = beyond(plane, points, directions, LEAST_M)
        reach = np.array(STEPS_M)[plane.steps]
        hidden |= np.logical_and.reduce([side <= most for side, most in zip(needed, reach, strict=True)])
    expected = misfit_of(judged, hidden)
    assert trial.misfit == pytest.approx(expected, rel=2e-3)  # of a direction at an edge float32 decides otherwise
    assert trial.misfit_of_none == pytest.approx(misfit_of(judged, np.zeros_like(hidden)), rel=1e-4)
    assert trial.misfit < 0.8 * trial.misfit_of_none


def misfit_of(judged: Judged, hidden: NDArray[np.bool_]) -> float:
    """What non-negative least squares of the lobes leaves; hidden: [n, CELLS * SPOKES]."""
    left = judged.transfer * (1 - hidden.reshape(len(hidden), CELLS, -1).mean(axis=2))
    root = np.sqrt(judged.weights)
    target = judged.target - judged.beyond * (judged.transfer - left).sum(axis=1)
    columns = root[:, None] * (left @ judged.lobes)
    ridge = np.sqrt(RIDGE * np.trace(columns.T @ columns) / columns.shape[1])
    amounts, _ = nnls(
        np.concatenate([columns, ridge * np.eye(columns.shape[1])]),
        np.concatenate([root * target, np.zeros(columns.shape[1])]),
    )
    return float(np.sum((root * target - columns @ amounts) ** 2))


def test_nothing_is_believed_that_explains_little() -> None:
    """Open surroundings: extents that noise alone suggests are not taken."""
    points, normals, judged = shaded_corner(-1.0)
    continuation = looking(points, normals)
    settled(continuation, judged)
    assert continuation.arrays()[0].shape[0] == 0


def test_later_trials_are_spread_over_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is tried from then on is about the same for every frame, and as much in all."""
    points, normals, judged = shaded_corner(1.0)
    continuation = looking(points, normals)
    settled(continuation, judged)
    work: list[int] = []
    prepare, settle = _Trial.prepare, _Trial.settle

    def counted_prepare(trial: _Trial) -> None:
        work[-1] += TRIES_OF_A_TABLE
        prepare(trial)

    def counted_settle(trial: _Trial, plane: int, side: int) -> int:
        tried = settle(trial, plane, side)
        work[-1] += tried
        return tried

    monkeypatch.setattr(_Trial, "prepare", counted_prepare)
    monkeypatch.setattr(_Trial, "settle", counted_settle)
    asked = []
    for _ in range(3 * RETRY_FRAMES):
        continuation._frames += 1
        work.append(0)
        continuation.try_extents(lambda: asked.append(1) or judged)
    whole = len(continuation.planes) * TRIES_OF_A_TABLE + TRIES
    assert 2 <= len(asked) <= 4
    assert max(work) <= whole / RETRY_FRAMES + TRIES_OF_A_TABLE + 4
    assert sum(work) >= 2 * len(continuation.planes) * TRIES_OF_A_TABLE


def test_the_first_frame_is_left_alone() -> None:
    points, normals, judged = shaded_corner(1.0)
    continuation = Continuation()
    continuation.find(points, normals)
    assert not continuation.try_extents(lambda: judged)
    assert not continuation.is_settled


def test_a_camera_that_looks_through_empties_the_plane() -> None:
    continuation = Continuation()
    points, normals = corner()
    continuation.find(points, normals)
    depth = np.full((48, 64), 3.0)  # beyond the wall at 2 m
    continuation.look(CAMERA, np.eye(4), depth)
    wall = next(plane for plane in continuation.planes if plane.normal @ WALL > 0.9)
    floor = next(plane for plane in continuation.planes if plane.normal @ FLOOR > 0.9)
    at = wall.cell_centers()
    seen = (np.abs(at[..., 0] / at[..., 2]) < 0.6) & (np.abs(at[..., 1] / at[..., 2]) < 0.44)
    assert wall.empty[seen].all()
    assert not wall.empty[~seen & ((np.abs(at[..., 0]) > 1.4) | (np.abs(at[..., 1]) > 1.1))].any()
    assert floor.empty.any()


def test_what_cameras_looked_through_is_what_the_twin_says() -> None:
    """Of a plane that was known all the time, and of a new one with which earlier views are compared."""
    rng = np.random.default_rng(8)
    poses, small = [np.eye(4), np.eye(4)], CameraModel(width=40, height=50, fx=30.0, fy=35.0, cx=20.0, cy=24.0)
    poses[1][:3, :3] = Rotation.from_rotvec([0.3, -0.5, 0.1]).as_matrix()
    poses[1][:3, 3] = 0.4, -0.2, 0.5
    cameras = [CAMERA, small]
    depths = [np.where(rng.random((c.height, c.width)) < 0.1, 0, rng.uniform(0.5, 4.0, (c.height, c.width)))
              for c in cameras]  # fmt: skip
    continuation = Continuation()
    planes = find_planes(*corner(), [])
    continuation.planes = planes[:1]
    for camera, pose, depth in zip(cameras, poses, depths, strict=True):
        continuation.look(camera, pose, depth.astype(np.float32))
    continuation.planes = planes
    continuation.look(CAMERA, np.eye(4), np.zeros((48, 64), np.float32))
    for plane in planes:
        expected = np.zeros_like(plane.empty)
        for camera, pose, depth in zip(cameras, poses, depths, strict=True):
            expected |= looked_through(plane, camera, np.linalg.inv(pose), depth, 0.1, 0.05)
        assert 0.02 < expected.mean() < 0.9
        assert (plane.empty != expected).mean() < 1e-3  # float32 rounds to another pixel at its edge


@pytest.mark.data
@pytest.mark.parametrize(("name", "bound_deg", "gain"), [("key_white_direct", 8.0, 3.0), ("key_tex_direct", 8.0, 2.0)])
def test_the_light_of_a_room_seen_in_part(device: Device, name: str, bound_deg: float, gain: float) -> None:
    """mitsuba_room: what no picture shows of its walls lets light through unless it is continued."""
    source = open_source(str(data_folder("mitsuba_room") / name))
    true = np.array(json.loads((data_folder("mitsuba_room") / name / "light.json").read_text())["sh"])
    bounds = default_volume(source, range(len(source)))
    albedo = "estimated" if "tex" in name else "constant"
    wishes = Wishes(volume_m=bounds, voxel_m=default_voxel(bounds), albedo=albedo, indirect="none", up=source.up)
    errors_deg = {}
    for continued in (True, False):
        pipeline = ClientSession(device, source.camera, wishes)
        model = LightModel(albedos=albedo == "estimated")
        light = LobeEstimator(pipeline._engine, 4, model, Continuation() if continued else None)
        pipeline._room.light._harmonics, pipeline._room.light._lobes = None, light
        for index in range(len(source)):
            sh = np.array(pipeline.process(source[index]).light.sh)
        errors_deg[continued] = direction_error_deg(sh, true)
        pipeline.close()
    assert errors_deg[True] < bound_deg
    assert gain * errors_deg[True] < errors_deg[False]  # seen: 2.1 of 24.7, and 1.7 of 14.5 degrees


@pytest.mark.data
def test_a_light_that_is_given_shows_the_room_too(device: Device) -> None:
    """What the pictures show of a known light says how far walls go on; the light stays what was given."""
    source = open_source(str(data_folder("mitsuba_room") / "key_white_direct"))
    light = np.array(json.loads((data_folder("mitsuba_room") / "key_white_direct" / "light.json").read_text())["sh"])
    bounds = default_volume(source, range(len(source)))
    given = tuple(tuple(float(v) for v in row) for row in light)
    wishes = Wishes(volume_m=bounds, voxel_m=default_voxel(bounds), albedo="estimated", up=source.up, light=given)
    pipeline = ClientSession(device, source.camera, wishes)
    for index in range(3):
        found = pipeline.process(source[index]).light
    shapes = pipeline._room.light.planes[0]
    pipeline.close()
    np.testing.assert_array_equal(np.array(found.sh), light)
    assert len(shapes) >= 3
    sides_m = shapes[:, 3, 1::2] - shapes[:, 3, ::2]  # seen and beyond
    assert sides_m.max() > 2.5  # of a wall 3.4 m wide of which the pictures show 2


@pytest.mark.parametrize(("seen_m", "most_m"), [(0.21, 0.3), (0.6, 0.8), (2.1, 3.0)])
def test_a_small_face_does_not_become_a_wall(seen_m: float, most_m: float) -> None:
    """Beyond a side a plane goes on for so many times what was seen of it, at most."""
    face = PlanePatch(
        normal=np.array([0.0, 0, 1]),
        offset_m=0.0,
        across=np.array([1.0, 0, 0]),
        along=np.array([0.0, 1, 0]),
        corner=np.zeros(2),
        empty=np.zeros((4, 4), np.bool_),
        seen=np.array([[1.0, 1.0], [1.0 + seen_m, 1.1]]),
    )
    steps = _Trial._candidates(object.__new__(_Trial), 0, MOST_GROWTH * face.longest_m)
    assert max(STEPS_M[step] for step in steps) == most_m
