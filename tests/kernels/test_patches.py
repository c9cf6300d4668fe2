"""What pictures show of patches of surface, against the float64 twin; and the memory of patches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from protocol.frames import CameraModel
from server.light.shell import picture as stage
from server.light.shell.known_room import KnownPatches
from server.light.shell.patches import (
    GRIDS,
    MOST_PATCHES,
    MOST_WEIGHT,
    PATCH_M,
    RAYS,
    Patches,
    hemisphere_weights,
    patch_side_m,
    ray_directions,
)
from server.light.shell.picture import Seen
from server.opencl.engine import Engine
from server.volume.volume import Volume
from tests.reference.patches import gather_clipped
from tests.reference.patches import gather_patches as twin
from tests.scenes.analytic import Floats
from tests.scenes.solids import float4, upload_surface

VOXEL_M = 0.02


def made_up(width: int, height: int) -> tuple[Floats, Floats, np.ndarray, Floats]:
    """Two tilted planes with holes, moving pixels, clipped, black and missing colours."""
    random = np.random.default_rng(8)
    y, x = np.mgrid[:height, :width]
    left = x < 0.6 * width
    normals = np.where(left[..., None], [0.0, -1.0, 0.0], [-0.6, 0.0, -0.8])
    heights = np.where(left, 0.0, 0.3) + random.normal(0, 0.015, (height, width))
    positions = np.stack([x * 0.01, y * 0.01, 1 + 0 * x], -1) + heights[..., None] * normals
    valid = random.random((height, width)) > 0.1
    labels = np.where(valid, np.where(random.random((height, width)) > 0.1, 1, 2), 0).astype(np.uint8)
    color = random.uniform(0, 1, (height, width, 3)) ** 2
    mark = random.choice([1.0, 1.0, 1.0, 0.0, -0.5, -1.0], (height, width))
    color[: height // 2, : width // 4] = 1.0
    mark[: height // 2, : width // 4] = 0.0
    radiance = np.concatenate([color, mark[..., None]], -1)
    pad = valid[..., None].astype(float)
    return np.concatenate([positions * pad, pad], -1), np.concatenate([normals * pad, pad], -1), labels, radiance


@pytest.mark.parametrize("size", [(331, 93), (203, 61)])
def test_matches_twin(engine: Engine, size: tuple[int, int]) -> None:
    width, height = size
    positions, normals, labels, radiance = made_up(width, height)
    camera = CameraModel(width=width, height=height, fx=200.0, fy=200.0, cx=width / 2, cy=height / 2)
    volume = Volume(engine, (1.0, 2.0, 3.0, 2.0, 3.0, 4.0), VOXEL_M)
    surface = upload_surface(engine, positions[..., :3], normals[..., :3], labels > 0)
    surface.labels.set(labels, engine.queue)
    seen_radiance = engine.workspace.upload("test_radiance", float4(radiance[..., :3], radiance[..., 3]))
    found = stage.PatchesInPicture(engine, camera, surface, seen_radiance, volume, np.eye(4)).seen()
    step = max(2, width // 40)
    places, facing, shown = (a.reshape(-1, 4) for a in twin(positions, normals, labels, radiance, step, 1.5 * VOXEL_M))
    # Pixels at the very tolerance may fall on either side of it in float32.
    used = places[:, 3] >= stage.LEAST_SHARE
    assert 10 < used.sum() < 0.9 * len(used)
    assert abs(found.count - used.sum()) <= 1
    if found.count == used.sum():
        np.testing.assert_allclose(found.positions - volume.origin_world, places[used, :3], atol=1e-5)
        apart = np.abs(found.logarithms - shown[used, :3]).max(1) > 1e-4
        assert apart.mean() < 0.03
        np.testing.assert_allclose(found.normals[~apart], facing[used, :3][~apart], atol=1e-4)
        np.testing.assert_allclose(found.clipped[~apart], facing[used, 3][~apart], atol=1e-5)
        np.testing.assert_allclose(found.variances[~apart], shown[used, 3][~apart], atol=2e-4)
        assert (found.clipped > 0.5).any()


def test_clipped_surface_matches_twin(engine: Engine) -> None:
    """Where it is, how it is turned, its radiance and its area across the line of sight."""
    width, height, random = 331, 93, np.random.default_rng(4)
    positions, normals, labels, radiance = made_up(width, height)
    positions[..., :3] += random.choice([0.0, 0.0, 0.3], (height, width, 1)) * [0, 0, 1]
    bright = random.random((height, width)) < 0.1
    radiance[bright] = [1.0, 0.95, 0.92, 0.0]
    camera = CameraModel(width=width, height=height, fx=200.0, fy=180.0, cx=width / 2, cy=height / 2)
    volume = Volume(engine, (1.0, 2.0, 3.0, 2.0, 3.0, 4.0), VOXEL_M)
    surface = upload_surface(engine, positions[..., :3], normals[..., :3], labels > 0)
    surface.labels.set(labels, engine.queue)
    seen_radiance = engine.workspace.upload("test_radiance", float4(radiance[..., :3], radiance[..., 3]))
    pose = np.eye(4)
    pose[:3, 2], pose[:3, 0], pose[:3, 3] = [0.6, 0.0, 0.8], [0.8, 0.0, -0.6], [0.3, 0.2, -1.0]
    found = stage.PatchesInPicture(engine, camera, surface, seen_radiance, volume, pose).seen().bright
    places, facing, shown = (
        a.reshape(-1, 4)
        for a in gather_clipped(positions, normals, labels, radiance, max(2, width // 40), pose, (200.0, 180.0))
    )
    used = places[:, 3] > 0
    assert 30 < used.sum() < len(used)
    np.testing.assert_allclose(found.positions - volume.origin_world, places[used, :3], atol=1e-5)
    np.testing.assert_allclose(found.areas_m2, places[used, 3], rtol=1e-4)
    np.testing.assert_allclose(found.normals, facing[used, :3], atol=1e-5)
    np.testing.assert_allclose(found.radiance, shown[used, :3], atol=1e-5)
    np.testing.assert_allclose(found.eye, pose[:3, 3] + volume.origin_world)


def test_the_area_of_a_clipped_ball_is_that_of_its_disc(engine: Engine) -> None:
    """Seen aside of the middle of a picture, where its image is an ellipse."""
    width, height, focal, radius_m = 320, 240, 280.0, 0.1
    center = np.array([0.5, 0.3, 1.5])
    y, x = np.mgrid[:height, :width]
    rays = np.stack([(x + 0.5 - width / 2) / focal, (y + 0.5 - height / 2) / focal, np.ones_like(x, float)], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    along = rays @ center
    root = radius_m**2 - (center @ center - along**2)
    hit = root > 0
    positions = (along - np.sqrt(np.maximum(root, 0.0)))[..., None] * rays
    normals = (positions - center) / radius_m
    camera = CameraModel(width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2)
    volume = Volume(engine, (0.0, 0.0, 0.0, 1.0, 1.0, 1.0), VOXEL_M)
    surface = upload_surface(engine, positions, normals, hit)
    surface.labels.set(hit.astype(np.uint8), engine.queue)
    seen_radiance = engine.workspace.upload(
        "test_radiance", float4(np.ones((height, width, 3)), np.zeros((height, width)))
    )
    bright = stage.PatchesInPicture(engine, camera, surface, seen_radiance, volume, np.eye(4)).seen().bright
    # Its near half is nearer than its middle by up to the radius: the disc that stands for it is smaller by that.
    assert 0.85 < bright.areas_m2.sum() / (np.pi * radius_m**2) < 1.0
    away = np.arcsin(radius_m / np.linalg.norm(center))
    sky = (bright.areas_m2 / ((bright.positions - bright.eye) ** 2).sum(axis=1)).sum()
    np.testing.assert_allclose(sky, 2 * np.pi * (1 - np.cos(away)), rtol=0.02)


def one(position: Floats, radiance: float, normal: tuple[float, float, float] = (0.0, 1.0, 0.0)) -> Seen:
    position = np.atleast_2d(position)
    n = len(position)
    return Seen(position, np.tile(normal, (n, 1)), np.full((n, 3), np.log(radiance)), np.zeros(n), np.zeros(n))


def test_a_patch_is_the_mean_of_its_frames() -> None:
    patches = Patches()
    for radiance in (0.1, 0.2, 0.4):
        patches.add(one(np.array([0.05, 0.05, 0.05]), radiance))
    rows = patches.seen
    assert len(rows) == GRIDS
    np.testing.assert_allclose(patches.logarithms[rows], np.log(0.2), atol=1e-12)
    assert (patches.weights[rows] == 3).all()
    changes = patches.changes(one(np.array([0.06, 0.04, 0.05]), 0.3))[0]
    np.testing.assert_allclose(changes, [np.log(1.5)] * GRIDS, atol=1e-12)


def test_all_surface_lies_in_a_patch_of_each_grid() -> None:
    """Of which the cells of one end in the middle of the other's, on all axes, below zero too."""
    patches, along = Patches(), np.array([-1.2, -0.9, -0.6, -0.4, -0.1, 0.1, 0.4, 0.6, 0.9, 1.2])
    places = PATCH_M * (0.3 + np.concatenate([np.outer(along, axis) for axis in np.eye(3)]))
    patches.add(one(places, 0.5))
    seen = patches.keys[patches.seen]
    for grid, cells in enumerate(np.floor(places / PATCH_M + 0.5 * shift) for shift in range(GRIDS)):
        np.testing.assert_array_equal(
            np.unique(seen[seen[:, -1] == grid, :3], axis=0), np.unique(cells, axis=0).astype(int)
        )


@pytest.mark.parametrize("side_m", [0.075, PATCH_M])
def test_patches_stand_for_the_surface_that_there_is(side_m: float) -> None:
    """Each of its parts lies in a patch of each grid, and counts once."""
    patches, along = Patches(side_m), np.arange(0.005, 3.0, 0.01)
    x, y = (axis.ravel() for axis in np.meshgrid(along, along))
    patches.add(one(np.column_stack([x, np.full(x.size, 0.01), y]), 0.5))
    assert len(patches.seen) * patches.area_m2 == pytest.approx(3.0**2, rel=0.1)  # patches at the rim are parts


@pytest.mark.parametrize(
    ("size_m", "voxel_m", "side_m"),
    [
        ((6.0, 3.0, 6.0), 0.02, 0.15),
        ((2.2, 1.5, 1.3), 0.009, 0.15),  # the corner of a room, 3 m across
        ((1.5, 0.6, 1.0), 0.006, 0.075),
        ((1.08, 0.5, 0.86), 0.0045, 0.075),
        ((0.5, 0.3, 0.5), 0.0025, 0.0375),
        ((0.5, 0.3, 0.5), 0.02, 0.08),  # four voxels
        ((0.5, 0.3, 0.5), 0.1, 0.15),
        ((0.0, 0.0, 0.0), 0.01, 0.04),
    ],
)
def test_patches_are_as_large_as_what_is_scanned(
    size_m: tuple[float, float, float], voxel_m: float, side_m: float
) -> None:
    positions = np.array([1.0, -2.0, 0.5]) + np.array(size_m) * np.linspace(0, 1, 300)[:, None]
    stray = np.vstack([positions, [[40.0, 0.0, 0.0]]])
    assert patch_side_m(positions, voxel_m) == patch_side_m(stray, voxel_m) == pytest.approx(side_m)


def test_patches_are_put_together_where_the_scan_has_grown() -> None:
    patches = Patches(0.075)
    places = np.array([[0.02, 0.02, 0.02], [0.1, 0.02, 0.02], [0.2, 0.02, 0.02]])
    shown = np.repeat(np.log([[0.2], [0.4], [0.9]]), 3, axis=1)
    for _ in range(3):
        patches.add(replace(one(places, 1.0), logarithms=shown))
    larger = patches.grown(0.15)
    rows = larger.seen
    order = np.argsort(larger.positions[rows, 0])
    # One grid holds the first two places in one of its patches, the other the last two.
    assert (larger.side_m, larger.fresh) == (0.15, 4)
    assert not patches.has_walls
    assert larger.has_walls
    along = [0.02, 0.06, 0.15, 0.2]
    np.testing.assert_allclose(larger.positions[rows][order], np.insert([[0.02] * 2] * 4, 0, along, 1), atol=1e-12)
    means = np.log([0.2, np.sqrt(0.2 * 0.4), np.sqrt(0.4 * 0.9), 0.9])
    np.testing.assert_allclose(larger.logarithms[rows][order, 0], means, atol=1e-12)
    np.testing.assert_array_equal(larger.weights[rows], 3.0)


def test_small_patches_are_told_apart_and_resumed() -> None:
    patches = Patches(0.02)
    places = np.array([[0.01, 0.01, 0.01], [0.03, 0.01, 0.01]])
    patches.add(one(places, 0.5))
    known = patches.known()
    assert len(known.keys) == 2 * GRIDS
    again = Patches.resumed(known)
    again.add(one(places, 0.5))
    assert sorted(again.weights)[-2 * GRIDS - 1 :] == [0.0, *[2.0] * 2 * GRIDS]


def test_a_save_with_one_grid_is_resumed_with_all() -> None:
    """As earlier programs wrote them: each of its patches lies in one of each grid now."""
    known = KnownPatches(
        keys=np.array([[0, 0, 0, 0, 1, 0], [3, 0, 0, 0, 1, 0]]),
        positions=np.array([[0.07, 0.01, 0.05], [0.5, 0.01, 0.05]]),
        normals=np.array([[0.0, 1.0, 0.0]] * 2),
        logarithms=np.log([[0.2] * 3, [0.4] * 3]),
        variances=np.array([0.1, 0.2]),
        clipped=np.array([0.0, 0.5]),
        weights=np.array([7.0, 3.0]),
    )
    patches = Patches.resumed(known)
    rows = patches.seen
    order = np.argsort(patches.positions[rows, 0], kind="stable")
    for name in ("positions", "normals", "logarithms", "variances", "clipped"):
        expected = np.repeat(getattr(known, name), GRIDS, axis=0)
        np.testing.assert_allclose(getattr(patches, name)[rows][order], expected, atol=1e-12)
    assert (patches.weights[rows] == 7.0).all()
    assert set(patches.keys[rows, -1].tolist()) == set(range(GRIDS))


def test_a_patch_never_weighs_more_than_its_memory() -> None:
    patches = Patches()
    for _ in range(int(3 * MOST_WEIGHT)):
        patches.add(one(np.zeros(3), 0.5))
    assert patches.weights.max() == MOST_WEIGHT
    patches.add(one(np.zeros(3), 0.5 * np.e))
    np.testing.assert_allclose(patches.logarithms[0], np.log(0.5) + 1 / MOST_WEIGHT, atol=1e-9)


def test_memory_is_bounded_and_keeps_what_was_seen_last() -> None:
    patches = Patches()
    places = PATCH_M * (np.stack(np.meshgrid(np.arange(60), [0], np.arange(64)), -1).reshape(-1, 3) + 0.25)
    for start in range(0, len(places), 256):
        patches.add(one(places[start : start + 256], 0.5))
    kept = patches.positions[patches.weights > 0]
    assert len(kept) == MOST_PATCHES
    last = places[-MOST_PATCHES // GRIDS :]
    assert {tuple(p) for p in np.round(last, 6)} >= {tuple(p) for p in np.round(kept, 6)}


def test_a_picture_of_more_patches_than_there_is_room_for_fills_it() -> None:
    patches, places = Patches(), PATCH_M * (np.arange(3 * (MOST_PATCHES + 500)).reshape(-1, 3) + 0.25)
    patches.add(one(places, 0.5))
    assert (patches.weights == 1).all()
    np.testing.assert_allclose(patches.logarithms, np.log(0.5))
    assert {tuple(p) for p in np.round(places, 6)} >= {tuple(p) for p in np.round(patches.positions, 6)}


def test_a_change_of_light_leaves_nothing_of_the_old() -> None:
    patches = Patches()
    patches.add(one(np.zeros(3), 0.1))
    patches.forget(1.0)
    assert len(patches.changes(one(np.zeros(3), 0.8))[0]) == 0
    patches.add(one(np.zeros(3), 0.8))
    np.testing.assert_allclose(patches.logarithms[0], np.log(0.8))


def test_rays_count_as_the_cosine() -> None:
    normals = np.array([[0.0, 0.0, 1.0], [0.6, -0.8, 0.0], [-1.0, 0.0, 0.0]])
    rays, weights = ray_directions(), hemisphere_weights(normals)
    assert weights.shape == (3, RAYS)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, atol=1e-6)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    np.testing.assert_array_equal(weights > 0, normals @ rays.T > 0)
    mean = weights @ rays
    np.testing.assert_allclose(mean, 2 / 3 * normals, atol=1e-3)  # of a cosine-weighted hemisphere
