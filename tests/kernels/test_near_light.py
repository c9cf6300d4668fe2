"""What samples see of emitters and of the sky, and the picture without lamps: against the twin and closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.light.light_estimation import LEAST_FLATNESS, LEAST_OPENNESS
from server.light.near_light import CLEARANCE_M, Emitters, remove_lamps, surround_patches
from server.light.near_samples import (
    LEAST_SHARE,
    lobe_radiance,
    pool_samples,
    see_samples,
    see_some,
)
from server.maths.emitters import Emitter
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.transfer.radiance_transfer import direction_sets
from server.volume.raycast import LABEL_DYNAMIC
from tests.reference import near_light as twin
from tests.scenes.light_samples import Floats, random_frame, samples_of
from tests.scenes.lights import random_directions
from tests.scenes.solids import (
    SCENES,
    Scene,
    ball,
    distance,
    download4,
    fill_volume,
    float4,
    hit,
    points_on,
    upload_surface,
)
from tests.scenes.tolerance import relative_tolerance

VOXEL_M = 0.01
SOLID_M = 1.31 * VOXEL_M
"""A ray this deep in a body has met a solid voxel, one this far outside has not (see test_radiance_transfer.py)."""


def free_of(scene: Scene, grown_m: float) -> twin.IsFree:
    """Ways that do not meet the scene's bodies before they are within the lamp's clearance."""

    def is_free(origins: Floats, directions: Floats, reach: Floats) -> NDArray[np.bool_]:
        return hit(scene, origins, directions, grown_m) >= reach - CLEARANCE_M

    return is_free


def float32(values: Floats) -> Floats:
    return values.astype(np.float32).astype(np.float64)


@pytest.mark.parametrize("name", SCENES)
def test_emitters_against_the_twin(engine: Engine, device: Device, name: str) -> None:
    scene = SCENES[name]
    volume = fill_volume(engine, scene, VOXEL_M)
    points, normals = (float32(a) for a in points_on(scene, 301, 3))
    random = np.random.default_rng(5)
    emitters = random.uniform(0.02, 0.94, (60, 3))
    emitters = float32(np.concatenate([emitters[distance(scene, emitters) > 0.02], [[0.5, 1.4, 0.4]]]))
    found = Emitters(engine, volume, samples_of(points, normals)).shares(emitters)
    # Where a ray passes a body within a voxel's size, which of the two the voxels say is open.
    most, least = (
        twin.emitter_shares(points, normals, emitters, VOXEL_M, free_of(scene, by)) for by in (-SOLID_M, 0.87 * VOXEL_M)
    )
    certain = most == least
    np.testing.assert_allclose(found[certain], most[certain], rtol=10 * relative_tolerance(device), atol=1e-6)
    unsure = found[~certain]
    np.testing.assert_allclose(unsure[unsure > 0], most[~certain][unsure > 0], rtol=1e-4)
    assert certain.mean() > 0.8
    assert (most[certain] > 0).mean() > 0.03
    if name == "floor under a wall":  # which shadows nothing but what faces away
        return
    assert ((most == 0) & certain)[twin.emitter_shares(points, normals, emitters, VOXEL_M, open_everywhere) > 0].any()


def open_everywhere(origins: Floats, _directions: Floats, _reach: Floats) -> NDArray[np.bool_]:
    return np.ones(len(origins), bool)


def test_a_lamp_does_not_shadow_itself(engine: Engine) -> None:
    """A bulb of 5 cm around the emitter is part of the volume, and yet the floor is lit as if it were not there."""
    scene = SCENES["floor under a wall"]
    lamp = np.array([[0.5, 0.5, 0.6]])
    points = np.array([[0.5, 0.1, 0.6], [0.3, 0.1, 0.5], [0.8, 0.1, 0.8]])
    up = np.tile([0.0, 1.0, 0.0], (3, 1))
    clear = Emitters(engine, fill_volume(engine, scene, VOXEL_M), samples_of(points, up)).shares(lamp)
    with_bulb = Emitters(engine, fill_volume(engine, (*scene, ball(lamp[0], 0.05)), VOXEL_M), samples_of(points, up))
    np.testing.assert_array_equal(with_bulb.shares(lamp), clear)
    away = lamp[0] - points
    expected = away[:, 1] / (np.pi * np.linalg.norm(away, axis=1) ** 3)
    np.testing.assert_allclose(clear[0], expected, rtol=1e-5)


def test_points_facing_away_or_at_the_emitter_see_nothing(engine: Engine) -> None:
    volume = fill_volume(engine, SCENES["floor under a wall"], VOXEL_M)
    points = np.array([[0.5, 0.5, 0.5], [0.5, 0.5, 0.5], [0.5, 0.8, 0.5]])
    normals = np.array([[0.0, 1, 0], [0, -1, 0], [0, 1, 0]])
    found = Emitters(engine, volume, samples_of(points, normals)).shares(np.array([[0.5, 0.5, 0.5], [0.5, 0.7, 0.5]]))
    assert np.isfinite(found).all()
    np.testing.assert_array_equal(found > 0, [[False, False, False], [True, False, False]])


@pytest.mark.parametrize(("height", "width", "stride"), [(96, 128, 4), (50, 70, 2), (37, 41, 1)])
def test_pools_against_the_twin(engine: Engine, device: Device, height: int, width: int, stride: int) -> None:
    frame = random_frame(height, width, stride)
    camera, radiance, surface, transfer = frame.upload(engine)
    rays = direction_sets(81, 4)
    free = np.random.default_rng(2).random((transfer.rows, transfer.cols, 96)) < 0.5
    free[..., 81:] = False
    transfer.free_mask.set(np.packbits(free, axis=-1, bitorder="little").view(np.uint32))
    voxel_m = 0.01
    found = pool_samples(engine, camera, radiance, surface, transfer, rays, voxel_m)
    place, facing, color, sky = twin.pool_sky(
        stride,
        float32(frame.positions),
        float32(frame.normals),
        frame.labels,
        float32(frame.radiance),
        float32(frame.openness),
        float32(frame.flatness),
        (LEAST_OPENNESS, LEAST_FLATNESS),
        voxel_m,
        rays.directions.astype(np.float64),
        lobe_radiance(rays.directions[..., :3].astype(np.float64)),
        free[..., :81],
    )
    used = place[..., 3] >= LEAST_SHARE
    assert len(found) == used.sum() > 10
    assert used.mean() < 1
    tolerance = relative_tolerance(device)
    np.testing.assert_allclose(found.positions, place[used][:, :3], rtol=tolerance, atol=1e-6)
    np.testing.assert_allclose(found.normals, facing[used], atol=10 * tolerance)
    np.testing.assert_allclose(found.colors, color[used], rtol=10 * tolerance)
    np.testing.assert_allclose(found.sky, sky[used], rtol=20 * tolerance, atol=1e-7)


def test_lobes_together_are_an_even_sky() -> None:
    together = lobe_radiance(random_directions(2000, 1)).sum(-1)
    np.testing.assert_allclose(together, 1, atol=0.1)
    assert together.mean() == pytest.approx(1, abs=0.003)


def test_surround_lies_around_the_volume() -> None:
    size = np.array([3.0, 2.0, 1.0])
    patches = surround_patches(size)
    assert patches.shape[1:] == (9, 3)
    outside = np.maximum(-patches, patches - size).max(-1)
    np.testing.assert_allclose(outside, 0.4, atol=1e-12)
    for axis in range(3):
        for side in (-0.4, size[axis] + 0.4):
            face = patches[np.isclose(patches[..., axis], side).all(1)]
            np.testing.assert_allclose(np.delete(face.mean((0, 1)), axis), np.delete(size / 2, axis), atol=1e-9)


def test_picture_without_lamps(engine: Engine, device: Device) -> None:
    scene = SCENES["ball above a floor"]
    volume = fill_volume(engine, scene, VOXEL_M)
    points, normals = points_on(scene, 15 * 21, 4)
    points, normals = (float32(a).reshape(15, 21, 3) for a in (points, normals))
    valid = np.random.default_rng(3).random((15, 21)) < 0.9
    surface = upload_surface(engine, points, normals, valid)
    seen = float32(np.random.default_rng(4).uniform(0, 0.6, (15, 21, 4)))
    radiance = engine.workspace.upload("radiance", float4(seen[..., :3], seen[..., 3]))
    lamps = tuple(
        Emitter(np.array(q), np.array(i), np.eye(3), np.ones(3), 1.0, 0.5)
        for q, i in (((0.2, 0.7, 0.3), (0.3, 0.2, 0.1)), ((0.8, 0.5, 0.7), (0.05, 0.1, 0.2)))
    )
    without = download4(engine, remove_lamps(engine, radiance, surface, volume, lamps, albedo=0.4)).reshape(-1, 4)
    sees = Emitters(engine, volume, samples_of(points.reshape(-1, 3), normals.reshape(-1, 3)))
    shares = sees.shares(float32(np.array([lamp.position for lamp in lamps]))) * valid.ravel()
    expected = twin.remove_lamps(seen.reshape(-1, 4), shares, np.array([lamp.intensity for lamp in lamps]), 0.4)
    np.testing.assert_allclose(without, expected, atol=relative_tolerance(device))
    assert 0.1 < (expected[:, :3] < seen.reshape(-1, 4)[:, :3]).mean() < 0.95
    assert (without[:, :3] == 0).any()
    assert remove_lamps(engine, radiance, surface, volume, ()) is radiance


def test_same_bits_twice(engine: Engine) -> None:
    scene = SCENES["ball above a floor"]
    volume = fill_volume(engine, scene, VOXEL_M)
    sees = Emitters(engine, volume, samples_of(*points_on(scene, 77, 9)))
    emitters = np.random.default_rng(1).uniform(0.1, 0.9, (13, 3))
    np.testing.assert_array_equal(sees.shares(emitters), sees.shares(emitters))


def test_camera_smaller_than_a_pool(engine: Engine) -> None:
    frame = random_frame(12, 12, 4)
    camera, radiance, surface, transfer = frame.upload(engine)
    assert isinstance(camera, CameraModel)
    assert len(pool_samples(engine, camera, radiance, surface, transfer, direction_sets(81, 4), VOXEL_M)) == 0


def test_some_samples_are_among_all(engine: Engine) -> None:
    """Under a ball on a floor of which a part is not static and a part is clipped."""
    volume = fill_volume(engine, SCENES["ball above a floor"], VOXEL_M)
    z, x = np.mgrid[0.15:0.85:48j, 0.15:0.85:64j]
    surface = upload_surface(engine, np.stack([x, 0 * x + 0.1, z], -1), np.tile([0.0, 1.0, 0.0], (48, 64, 1)), x > 0.2)
    labels = np.where(z < 0.3, LABEL_DYNAMIC, engine.download(surface.labels)).astype(np.uint8)
    surface = replace(surface, labels=engine.workspace.upload("other_labels", labels))
    seen = np.random.default_rng(4).uniform(0, 0.6, (48, 64, 3))
    radiance = engine.workspace.upload("radiance", float4(seen, (x < 0.7).astype(float)))
    camera = CameraModel(width=61, height=49, fx=60.0, fy=60.0, cx=31.5, cy=23.5)
    whole = see_samples(engine, camera, radiance, surface, volume)
    some = see_some(engine, camera, radiance, surface, volume, 20, np.random.default_rng(1))
    assert len(whole) > 50
    assert len(some) == 20
    numbers = [int(np.flatnonzero((whole.positions == position).all(axis=1))[0]) for position in some.positions]
    assert len(set(numbers)) == 20
    for name in ("normals", "colors", "sky"):
        np.testing.assert_array_equal(getattr(some, name), getattr(whole, name)[numbers])
    again = see_some(engine, camera, radiance, surface, volume, 1000, np.random.default_rng(2))
    np.testing.assert_array_equal(again.sky, whole.sky)
    empty = replace(surface, labels=engine.workspace.upload("no_labels", np.zeros_like(labels)))
    assert len(see_some(engine, camera, radiance, empty, volume, 20, np.random.default_rng(1))) == 0
