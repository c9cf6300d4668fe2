"""Image-space transfer against its float64 twin, and its views against solids that are known voxel by voxel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from protocol.frames import CameraModel
from server.maths.rigid import inverse_rigid
from server.maths.self_occlusion import (
    neighbour_angles_rad,
    occlusion_threshold,
    printed_threshold,
    spherical_delaunay,
)
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.transfer import auxiliary_views, image_space
from server.transfer.auxiliary_views import AuxiliaryViews, ViewsAround
from server.transfer.image_space import ImageSpaceTransfer, near_distances, nearest_views, sample_phases
from server.transfer.radiance_transfer import Directions, Transfer, direction_sets, first_set, traced_transfer
from server.volume.raycast import LABEL_DYNAMIC, LABEL_FILLED, LABEL_NONE, LABEL_STATIC, Surface
from server.volume.volume import Volume
from tests.reference import image_space as twin
from tests.reference.radiance_transfer import direction_set
from tests.reference.visibility import first_solid
from tests.scenes.analytic import look_at, pixel_rays
from tests.scenes.depth_view_scene import host_views
from tests.scenes.lights import random_directions, unit
from tests.scenes.solids import SCENES, Scene, Solid, fill_volume, hit, normal_at, solid_voxels, upload_surface
from tests.scenes.tolerance import relative_tolerance
from tests.scenes.volumes import vectors

VOXEL_M = 0.02
ROOM_M = 1000.0
CAMERA = CameraModel(width=61, height=49, fx=52.0, fy=53.0, cx=31.3, cy=23.8)
VIEW = look_at((0.48, 0.75, 0.85), (0.5, 0.3, 0.4), up=(0.0, 1.0, 0.0))
"""Inside all scenes; volume space, in which they stand."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Looked:
    """A scene as a camera sees it, without noise."""

    volume: Volume
    surface: Surface
    positions: Floats
    """[h, w, 4], as are the normals; as the device has them."""
    normals: Floats
    labels: NDArray[np.uint8]
    solid: NDArray[np.bool_]
    """[z, y, x] voxels."""


def look(engine: Engine, scene: Scene, holes: float = 0.0, hand: Solid | None = None) -> Looked:
    """`holes`: share of pixels without surface, and with a guessed one. `hand`: what the sensor alone knows."""
    rays = unit(pixel_rays(CAMERA) @ VIEW[:3, :3].T).reshape(-1, 3)
    t = hit(scene, np.tile(VIEW[:3, 3], (len(rays), 1)), rays)
    random = np.random.default_rng(3)
    points = VIEW[:3, 3] + np.where(np.isfinite(t), t, 0)[:, None] * rays
    inside = ((points > 0) & (points < 0.96)).all(-1)
    seen = np.isfinite(t) & inside & (random.random(len(t)) >= holes)
    normals = np.zeros_like(points)
    normals[seen] = normal_at(scene, points[seen])
    shape = (CAMERA.height, CAMERA.width)
    points, normals, valid = points.reshape(*shape, 3), normals.reshape(*shape, 3), seen.reshape(shape)
    surface = upload_surface(engine, points, normals, valid)
    labels = np.where(valid, LABEL_STATIC, LABEL_NONE)
    if hand:
        labels[valid & (np.abs(hand.distance(points.reshape(-1, 3)).reshape(shape)) < 1e-6)] = LABEL_DYNAMIC
    labels[valid & (random.random(shape) < holes)] = LABEL_FILLED
    surface.labels.set(labels.astype(np.uint8))
    known = tuple(solid for solid in scene if solid is not hand)
    host = [vectors(engine.download(a)).astype(np.float64) for a in (surface.positions, surface.normals)]
    volume = fill_volume(engine, known, VOXEL_M)
    return Looked(volume, surface, *host, labels, solid_voxels(known, volume))


def visible_bits(engine: Engine, transfer: Transfer, count: int) -> NDArray[np.bool_]:
    bits = np.unpackbits(engine.download(transfer.free_mask).view(np.uint8), axis=-1, bitorder="little")
    return bits[..., :count].astype(bool)


# ---- against the twin --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENES)
def test_views_see_the_first_solid_voxel(engine: Engine, name: str) -> None:
    volume = fill_volume(engine, SCENES[name], VOXEL_M)
    device_views = ViewsAround(engine, 24).update(volume, unit(np.array([0.3, 0.8, -0.2])))
    views = host_views(engine, device_views)
    solid = solid_voxels(SCENES[name], volume)
    assert device_views.has_light_view
    for view in (7, 24):
        lines = views.lines(view)[::3, ::3].reshape(-1, 3)
        length = np.linalg.norm(lines, axis=-1)
        eyes = np.broadcast_to(views.eye(view), lines.shape)
        met = first_solid(solid, VOXEL_M, eyes, lines / length[:, None])
        expected = np.where(np.isfinite(met), met / length, 0.0)
        found = views.depths[view, ::3, ::3].ravel()
        # Steps of less than a voxel miss corners that a line only clips, and go on to what is behind.
        assert (found[expected == 0] == 0).all()
        agree = np.abs(found - expected) < 0.05 * VOXEL_M
        assert agree.mean() > 0.99  # seen: all
        assert (found - expected)[~agree & (found > 0)].min(initial=0) > -1e-3
        assert (found > 0).mean() > 0.05


@pytest.mark.parametrize(("stride", "rays", "bands"), [(4, 81, 4), (3, 33, 2), (8, 169, 6)])
@pytest.mark.parametrize("ray_length_m", [ROOM_M, 0.15])
def test_transfer_is_the_twins(
    device: Device, engine: Engine, stride: int, rays: int, bands: int, ray_length_m: float
) -> None:
    scene = SCENES["ball above a floor" if stride == 3 else "room open at the top"]
    looked = look(engine, scene, holes=0.05, hand=scene[1] if stride < 8 else None)
    directions = direction_sets(rays, bands)
    threshold = occlusion_threshold(directions.directions[0, :, :3].astype(float))
    views = ViewsAround(engine, 48).update(looked.volume)
    _, view_of = nearest_views(directions, views.toward)
    arguments: Any = (
        engine,
        CAMERA,
        VIEW,
        looked.volume,
        looked.surface,
        views,
        view_of,
        stride,
        directions,
        ray_length_m,
    )
    result = image_space.transfer_from_views(*arguments, threshold)
    transfer, openness, visible = twin_of(engine, looked, views, view_of, stride, directions, ray_length_m, threshold)
    found = engine.download(result.coefficients)
    # Where a position falls on the brink of a pixel, float32 may take the other one: one direction of a sample differs.
    tolerance = 20 * relative_tolerance(device)
    agree = (np.abs(found - transfer) < tolerance).all(-1)
    assert agree.mean() > 0.99  # seen: all
    assert np.abs(found - transfer).max() < 0.05
    np.testing.assert_allclose(engine.download(result.openness)[agree], openness[agree], atol=tolerance)
    clear = np.abs(visible - 0.5) > 1e-3
    bits = visible_bits(engine, result, rays)
    np.testing.assert_array_equal(bits[agree][clear[agree]], (visible >= 0.5)[agree][clear[agree]])
    assert (openness == -1).any()
    assert ((openness > 0.05) & (openness < 0.9)).any()
    assert stride == 8 or ((visible > 0.01) & (visible < 0.99)).any()  # eq. 6.3 took part


def test_what_was_taken_out_hides_nothing(device: Device, engine: Engine) -> None:
    """Views drawn while a ball hung over the floor: without it the floor is as open as by views that are drawn anew."""
    rays, stride = direction_sets(81, 4), 4
    threshold = occlusion_threshold(rays.directions[0, :, :3].astype(float))
    scene = SCENES["ball above a floor"]
    stale = ViewsAround(engine, 48).update(fill_volume(engine, scene, VOXEL_M))
    stale = replace(stale, depths=stale.depths.copy())
    looked = look(engine, scene[:1])
    fresh = ViewsAround(engine, 48).update(looked.volume)
    _, view_of = nearest_views(rays, stale.toward)
    openness = {}
    for name, views in (("stale", stale), ("fresh", fresh)):
        result = image_space.transfer_from_views(
            *(engine, CAMERA, VIEW, looked.volume, looked.surface, views, view_of, stride, rays, ROOM_M, threshold)
        )
        openness[name] = engine.download(result.openness).copy()
    _, sky, _ = twin_of(engine, looked, stale, view_of, stride, rays, ROOM_M, threshold)
    assert (np.abs(openness["stale"] - sky) < 20 * relative_tolerance(device)).mean() > 0.99
    here = sky >= 0
    assert np.abs(openness["stale"] - openness["fresh"])[here].mean() < 0.01
    assert np.abs(openness["stale"] - openness["fresh"])[here].max() < 0.1


@pytest.mark.parametrize("share", [0.0, 0.85, 1.0])
def test_samples_that_were_found_keep_their_values(device: Device, engine: Engine, share: float) -> None:
    """Of transfer_cache.py. The others are the twin's, for which surface that the sensor alone knows blocks nothing."""
    scene, stride, turn = SCENES["ball above a floor"], 2, 3
    looked = look(engine, scene, holes=0.05, hand=scene[1])
    rays = direction_sets(33, 2)
    threshold = occlusion_threshold(rays.directions[0, :, :3].astype(float))
    views = ViewsAround(engine, 48).update(looked.volume)
    _, view_of = nearest_views(rays, views.toward)
    room = traced_transfer(engine, CAMERA, stride, rays)
    assert room.sets is not None
    arrays = (room.coefficients, room.openness, room.flatness, room.free_mask, room.sets)
    for array in arrays:
        array.fill(array.dtype.type(7))
    found = np.random.default_rng(5).random((room.rows, room.cols)) < share
    places = engine.workspace.upload("test_found", np.where(found, 3, -1).astype(np.int32))
    image_space.transfer_from_views(
        *(engine, CAMERA, VIEW, looked.volume, looked.surface, views, view_of, stride, rays, ROOM_M, threshold),
        turn,
        places,
    )
    transfer, openness, flatness, mask, sets = (engine.download(array) for array in arrays)
    for array in (transfer, openness, flatness, mask, sets):
        assert (array[found] == 7).all()
    later = replace(
        rays, directions=np.roll(rays.directions, -first_set(turn), 0), basis=np.roll(rays.basis, -first_set(turn), 0)
    )
    turned = np.roll(view_of, -first_set(turn), 0)
    expected, sky, _ = twin_of(engine, looked, views, turned, stride, later, ROOM_M, threshold, has_unknown=False)
    agree = (np.abs(transfer - expected) < 20 * relative_tolerance(device)).all(-1)[~found]
    assert share == 1 or agree.mean() > 0.99  # seen: all
    np.testing.assert_allclose(openness[~found][agree], sky[~found][agree], atol=20 * relative_tolerance(device))
    row, col = np.nonzero(~found)
    np.testing.assert_array_equal(sets[~found][..., 0], first_set(turn) + np.asarray(direction_set(row, col)))


def twin_of(
    engine: Engine,
    looked: Looked,
    views: AuxiliaryViews,
    view_of: NDArray[np.int32],
    stride: int,
    rays: Directions,
    ray_length_m: float,
    threshold: float,
    *,
    has_unknown: bool = True,
) -> tuple[Floats, Floats, Floats]:
    """has_unknown: whether surface that the sensor alone knows blocks anything."""
    near_m = min(image_space.NEAR_PIXELS * views.pixel_m, ray_length_m)
    starts, ratio = near_distances(rays.count, VOXEL_M, near_m)
    camera_from_volume = inverse_rigid(VIEW)
    in_camera = looked.positions[..., :3] @ camera_from_volume[:3, :3].T + camera_from_volume[:3, 3]
    unknown = (looked.labels == LABEL_DYNAMIC) & has_unknown
    blocking = unknown | (looked.labels == LABEL_STATIC)
    near = twin.Near(
        np.where(blocking, in_camera[..., 2], 0),
        unknown,
        camera_from_volume,
        (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy),
        starts.astype(np.float64),
        ratio,
        image_space.FURTHER_STEPS if unknown.any() else image_space.NEAR_STEPS,
        near_m,
        ray_length_m,
        image_space.SLACK,
        threshold,
    )
    return twin.transfer_from_views(
        looked.positions,
        looked.normals,
        stride,
        1,
        VOXEL_M,
        rays.directions.astype(np.float64),
        rays.basis.astype(np.float64),
        replace(host_views(engine, views), solid=looked.solid, voxel_m=VOXEL_M),
        view_of,
        near,
        ray_length_m,
        image_space.LIFT_VOXELS * VOXEL_M,
    )


# ---- what must hold ----------------------------------------------------------------------------------------------


def test_views_are_drawn_in_turn(engine: Engine) -> None:
    """A round of 7 views, 3 a frame: what the volume has become is seen by all of them after three frames."""
    before, after = (fill_volume(engine, SCENES[n], VOXEL_M) for n in ("ball above a floor", "room open at the top"))
    expected = engine.download(ViewsAround(engine, 7).update(after).depths)[:7]
    around = ViewsAround(engine, 7, round_frames=3)
    around.update(before)
    drawn = []
    for _ in range(3):
        depths = engine.download(around.update(after).depths)[:7]
        drawn.append([bool((depth == want).all()) for depth, want in zip(depths, expected, strict=True)])
    assert [sum(views) for views in drawn] == [3, 6, 7]


@pytest.mark.parametrize(
    ("bricks", "frames", "expected"),
    [
        # of 12, those of 100 or 101 bricks: 12, 8, 4, none
        ((100, 101, 120, 120, 120, 120, 123, 200), (99,) * 8, [12, 2, 4, 4, 4, 2, 2, 4]),
        # of one frame: 6 and 2 at 2, the other 4 at 3; of 2 at 4: 6; of 3 and 4 at 30: 6, then the others; not of 16
        ((100,) * 8, (1, 2, 3, 4, 30, 31, 32, 90), [12, 8, 6, 8, 8, 6, 2, 2]),
    ],
    ids=["more bricks", "more frames"],
)
def test_more_views_are_drawn_while_the_volume_grows(
    engine: Engine,
    monkeypatch: pytest.MonkeyPatch,
    bricks: tuple[int, ...],
    frames: tuple[int, ...],
    expected: list[int],
) -> None:
    """Those out of date besides those whose turn it is, oldest first, up to the most that a frame draws."""
    monkeypatch.setattr(auxiliary_views, "GROWTH_ROUND", 3)
    monkeypatch.setattr(auxiliary_views, "YOUNG_ROUND", 2)
    monkeypatch.setattr(auxiliary_views, "draw_views", lambda *args: drawn.append(len(args[-1])))
    volume = fill_volume(engine, SCENES["ball above a floor"], VOXEL_M)
    drawn: list[int] = []
    around = ViewsAround(engine, 12, round_frames=6)
    for counts in zip(bricks, frames, strict=True):
        monkeypatch.setattr(Volume, "allocated_bricks", counts[0])
        monkeypatch.setattr(volume, "frames", counts[1])
        around.update(volume)
    assert drawn == expected


def test_the_lights_view_has_its_turn(engine: Engine) -> None:
    before, after = (fill_volume(engine, SCENES[n], VOXEL_M) for n in ("ball above a floor", "room open at the top"))
    toward = unit(np.array([0.2, 0.8, 0.3]))
    expected = engine.download(ViewsAround(engine, 7).update(after, toward).depths)
    around = ViewsAround(engine, 7, round_frames=3)
    around.update(before, toward)
    for _ in range(3):  # 3 + 3 + 2 of 7 and the light's
        depths = engine.download(around.update(after, toward).depths)
    np.testing.assert_array_equal(depths, expected)


def test_light_view_is_drawn_when_the_light_turns(engine: Engine) -> None:
    volume = fill_volume(engine, SCENES["ball above a floor"], VOXEL_M)
    around = ViewsAround(engine, 8, round_frames=8)
    assert not around.update(volume).has_light_view
    assert not around.update(volume, np.zeros(3)).has_light_view
    for toward in random_directions(3, 5):
        views = around.update(volume, toward)
        np.testing.assert_allclose(views.toward[-1], toward)
        light = engine.download(views.depths)[-1]
        fresh = ViewsAround(engine, 8, round_frames=8).update(volume, toward)
        np.testing.assert_array_equal(light, engine.download(fresh.depths)[-1])


def test_dominant_view_takes_the_directions_around_it(engine: Engine) -> None:
    """More directions are answered by the light's own view where it is nearer than the lattice's, and only there."""
    looked = look(engine, SCENES["room open at the top"])
    rays = direction_sets(81, 4)
    stage = ImageSpaceTransfer(engine, rays, views=64)
    toward = unit(np.array([0.2, 1.0, 0.1]))
    views = ViewsAround(engine, 64).update(looked.volume, toward)
    chosen = stage._views_for(views)
    cosines = rays.directions[..., :3] @ views.toward.T
    np.testing.assert_allclose(np.take_along_axis(cosines, chosen[..., None], -1)[..., 0], cosines.max(-1), atol=1e-6)
    assert (chosen == 64).any()


@pytest.mark.parametrize("stride", [1, 4])
def test_strides_and_empty_pixels(engine: Engine, stride: int) -> None:
    looked = look(engine, SCENES["ball above a floor"], holes=0.3)
    result = ImageSpaceTransfer(engine, direction_sets(81, 4)).transfer(
        CAMERA, VIEW, looked.volume, looked.surface, stride, ROOM_M
    )
    here = (looked.positions[..., 3] > 0)[stride // 2 :: stride, stride // 2 :: stride]
    assert (result.rows, result.cols) == here.shape
    openness, transfer = engine.download(result.openness), engine.download(result.coefficients)
    np.testing.assert_array_equal(openness >= 0, here)
    assert not transfer[~here].any()
    assert not visible_bits(engine, result, 81)[~here].any()
    assert np.isfinite(transfer).all()
    assert (engine.download(result.flatness)[here] > 0).all()


def test_a_thing_only_the_sensor_knows_shades(engine: Engine) -> None:
    """A ball that is in the geometry buffer but not in the volume (a hand) takes sky from the floor beside it.

    Less than it should: a picture shows its front, which stands for all of it.
    """
    floor, ball = SCENES["ball above a floor"]
    stage = ImageSpaceTransfer(engine, direction_sets(81, 4))
    positions = look(engine, (floor, ball)).positions
    from_center = np.hypot(positions[..., 0] - 0.5, positions[..., 2] - 0.45)
    beside = (np.abs(positions[..., 1] - 0.1) < 1e-3) & (from_center < 0.25)
    assert beside.sum() > 20
    means = []
    for seen in ((floor,), (floor, ball)):
        looked = look(engine, seen, hand=ball)
        result = stage.transfer(CAMERA, VIEW, looked.volume, looked.surface, 1, ROOM_M)
        means.append(engine.download(result.openness)[beside].mean())
    assert means[0] > 0.9999
    assert means[1] < 0.99


def test_same_bits_twice(engine: Engine) -> None:
    looked = look(engine, SCENES["room open at the top"])
    rays = direction_sets(81, 4)
    first, second = (
        engine.download(
            ImageSpaceTransfer(engine, rays)
            .transfer(CAMERA, VIEW, looked.volume, looked.surface, 4, ROOM_M, np.array([0.0, 1.0, 0.0]))
            .coefficients
        )
        for _ in range(2)
    )
    np.testing.assert_array_equal(first, second)


def test_samples_begin_elsewhere_in_each_of_2_x_2() -> None:
    phases = sample_phases(81)
    assert ((phases >= 0) & (phases < 1)).all()
    gaps = np.diff(np.sort(phases, axis=0), axis=0)
    np.testing.assert_allclose(gaps, 0.25)
    starts, ratio = near_distances(81, 0.01, 0.4)
    assert starts.min() >= 0.02 - 1e-6
    assert starts.max() <= 0.02 * ratio
    assert starts.max() * ratio ** (image_space.NEAR_STEPS - 1) > 0.2
    assert near_distances(81, 0.02, 0.05)[1] == image_space.LEAST_RATIO


# ---- the self-occlusion threshold --------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [4, 5, 32, 81, 169, 400])
def test_triangulation_is_scipys(count: int) -> None:
    points = random_directions(count, count)
    try:
        triangles = spherical_delaunay(points)
    except ValueError:
        assert not ConvexHull(points).equations[:, 3].max() < 0  # all on one half of the sphere
        return
    assert len(triangles) == 2 * count - 4
    assert {tuple(sorted(t)) for t in triangles.tolist()} == {
        tuple(sorted(t)) for t in ConvexHull(points).simplices.tolist()
    }
    a, b, c = points[triangles].transpose(1, 0, 2)
    assert ((np.cross(b - a, c - a) * a).sum(-1) > 0).all()  # left, seen from outside


def test_thresholds() -> None:
    """An octahedron's neighbours are 90 degrees apart."""
    jitter = unit(np.concatenate([np.eye(3), -np.eye(3)]) + 1e-9 * np.random.default_rng(1).normal(size=(6, 3)))
    np.testing.assert_allclose(neighbour_angles_rad(jitter), np.pi / 2, atol=1e-6)
    assert occlusion_threshold(jitter) == pytest.approx(1 - np.sqrt(0.5))
    assert printed_threshold(jitter) == pytest.approx(np.sqrt(0.5))
    for rays in (81, 169):
        directions = direction_sets(rays, 4).directions[0, :, :3].astype(float)
        assert np.arccos(1 - occlusion_threshold(directions)) == pytest.approx(
            np.median(neighbour_angles_rad(directions)) / 2
        )
        assert printed_threshold(directions) > 0.95


def test_too_few_directions_are_refused() -> None:
    with pytest.raises(ValueError, match="3 points"):
        spherical_delaunay(np.eye(3))
