"""Radiance transfer against its float64 twin, and its visibility against rays that are known in closed form."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from server.opencl.device import Device
from server.opencl.engine import Engine
from server.transfer.radiance_transfer import SETS, TransferBuffers, direction_sets, transfer_radiance
from server.volume.volume import Volume
from tests.reference import radiance_transfer as twin
from tests.reference.sh import open_transfer
from tests.reference.visibility import trace_volume
from tests.scenes.lights import random_directions, unit
from tests.scenes.solids import (
    SCENES,
    SIDE_M,
    HalfSpace,
    box,
    fill_volume,
    floor,
    hit,
    normal_at,
    points_on,
    solid_voxels,
    upload_surface,
)
from tests.scenes.tolerance import relative_tolerance
from tests.scenes.traced_points import ROOM_M, STRIDE, VOXEL_M, Floats, Traced, camera_of, trace, transfer_of
from tests.scenes.volumes import fill

OUTER = 0.87 * VOXEL_M
"""A solid voxel's centre is behind the surface, so no point of it is farther out than half its diagonal."""
INNER = 1.31 * VOXEL_M
"""A point this far in lies in solid voxels, and so does one of the ray's samples, at most 0.87 voxels apart."""


def rays_of(traced: Traced, count: int, bands: int = 4) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Origins and directions [rows, cols, count, 3] of every ray, and whether it lies above the surface."""
    rows, cols = np.indices(traced.openness.shape)
    directions = direction_sets(count, bands).directions.astype(np.float64)[twin.direction_set(rows, cols), :, :3]
    origins = np.broadcast_to(traced.origins[:, :, None], directions.shape)
    normals = traced.normals[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE, None, :3]
    return origins, directions, (directions * normals).sum(-1) > 1e-6


def twin_of(traced: Traced, stride: int, rays: int, bands: int) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
    """The twin's result for the visibility that the device found."""
    free = iter(traced.free[traced.openness >= 0])
    sets = direction_sets(rays, bands)
    directions, basis = sets.directions.astype(float), sets.basis.astype(float)
    return twin.transfer_radiance(
        traced.positions, traced.normals, stride, 1, directions, basis, VOXEL_M, lambda *_: next(free)
    )


# ---- against the twin --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rays", "bands"), [(81, 4), (169, 6), (32, 2), (33, 3), (1024, 5)])
def test_transfer_is_the_twins_for_the_same_visibility(device: Device, engine: Engine, rays: int, bands: int) -> None:
    scene = SCENES["ball above a floor"]
    points, normals = points_on(scene, 96, 1)
    traced = trace(engine, fill_volume(engine, scene, VOXEL_M), points, normals, rays=rays, bands=bands)
    assert (traced.openness < 0.95).any()
    assert (traced.openness > 0.999).any()
    assert_twins(device, traced, STRIDE, rays, bands)


@pytest.mark.parametrize("stride", [1, 4, 8])
def test_normals_are_smoothed_within_surfaces(device: Device, engine: Engine, stride: int) -> None:
    """A picture of a ball before a floor, with noisy normals and holes."""
    scene = SCENES["ball above a floor"]
    v, u = np.mgrid[:48, :64]
    rays = unit(np.stack([(u - 31.5) / 50, -(v - 23.5) / 50 - 0.3, np.ones_like(u)], -1).reshape(-1, 3))
    eye = np.array([0.5, 0.6, -0.3])
    t = hit(scene, np.tile(eye, (len(rays), 1)), rays)
    seen = np.isfinite(t)
    points = eye + np.where(seen, t, 0)[:, None] * rays
    normals = np.zeros_like(points)
    normals[seen] = normal_at(scene, points[seen])
    random = np.random.default_rng(4)
    noisy = unit(normals + 0.1 * random.normal(size=normals.shape))
    valid = seen & (random.random(len(rays)) < 0.9)
    buffers = [
        np.insert(a, 3, valid, -1).reshape(48, 64, 4).astype(np.float32).astype(np.float64) for a in (points, noisy)
    ]
    buffers = [np.where(valid.reshape(48, 64, 1), buffer, 0) for buffer in buffers]
    traced = transfer_of(engine, fill_volume(engine, scene, VOXEL_M), *buffers, stride)
    assert_twins(device, traced, stride, 81, 4, edges=0.02)
    here = (traced.flatness > 0.8) & (traced.openness == 1)
    pixels = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    exact, before = (a.reshape(48, 64, 3)[pixels][here] for a in (normals, noisy))
    after = unit(traced.transfer[here][:, [3, 1, 2]])
    # Eight or nine of them are averaged: a ninth of the variance, and a little of the ball's curvature.
    assert np.mean((after - exact) ** 2) < np.mean((before - exact) ** 2) / 5


def assert_twins(device: Device, traced: Traced, stride: int, rays: int, bands: int, edges: float = 0.0) -> None:
    """Equal to the twin but for a share `edges` of samples with a neighbour on the brink of being another surface."""
    transfer, openness, flatness, free = twin_of(traced, stride, rays, bands)
    agree = np.abs(traced.flatness - flatness) < 1e-6
    assert (~agree).mean() <= edges
    # Coefficients are sums of up to 512 terms of magnitude below 1 / 50: their rounding adds to that of the largest.
    tolerance = 2 * relative_tolerance(device)
    np.testing.assert_allclose(traced.transfer[agree], transfer[agree], rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(traced.openness[agree], openness[agree], atol=tolerance)
    assert (traced.free[agree] & ~free[agree]).sum() <= 1e-4 * free.sum()  # directions in the surface to rounding


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("ray_length_m", [ROOM_M, 0.1])
def test_visibility_is_the_twins(engine: Engine, name: str, ray_length_m: float) -> None:
    scene = SCENES[name]
    volume = fill_volume(engine, scene, VOXEL_M)
    traced = trace(engine, volume, *points_on(scene, 256, 2), ray_length_m=ray_length_m)
    origins, directions, above = rays_of(traced, 81)
    exact = trace_volume(solid_voxels(scene, volume), VOXEL_M, origins[above], directions[above], ray_length_m)
    free = traced.free[above]
    # Samples less than a voxel apart miss corners that a ray only clips; what they find, is there.
    missed = (free & ~exact).mean()
    assert missed < 0.001  # seen: 0.0001
    assert (
        ~free & exact
    ).mean() < 1e-3  # float32 origins within 1e-6 of a voxel's face, and the last sample at `reach`
    assert ray_length_m < ROOM_M or (~free).mean() > 0.02


def test_rays_meet_single_voxels(engine: Engine) -> None:
    """Solid voxels scattered one by one: what a ray crosses by a voxel's side or more is met."""
    random = np.random.default_rng(15)
    volume = Volume(engine, (0, 0, 0, SIDE_M, SIDE_M, SIDE_M), VOXEL_M)
    solid = random.random([8 * n for n in volume.bricks[::-1]]) < 0.01
    fill(engine, volume, np.where(solid, -0.5, 1.0), np.ones(solid.shape))
    points, normals = random.uniform(0.35, 0.6, (64, 3)), random_directions(64, 16)
    traced = trace(engine, volume, points, normals, ray_length_m=0.3)
    origins, directions, above = rays_of(traced, 81)
    origins, directions, free = origins[above], directions[above], traced.free[above]
    assert not (~free & trace_volume(solid, VOXEL_M, origins, directions, 0.3)).any()
    # Along the ray in steps of a fiftieth of a voxel, the longest stay in one solid voxel.
    steps = np.arange(0.0, 0.28, VOXEL_M / 50)
    cells = ((origins[:, None] + steps[:, None] * directions[:, None]) / VOXEL_M).astype(int)
    inside = solid[cells[..., 2], cells[..., 1], cells[..., 0]]
    number = (cells @ [1, 1000, 1000000]) * inside
    stays = (number[:, 45:] == number[:, :-45]) & inside[:, 45:]  # 0.9 voxels, and samples are 0.87 apart at most
    assert stays.any(1).mean() > 0.1
    assert not (free & stays.any(1)).any()


@pytest.mark.parametrize("stride", [1, 4, 8])
def test_strides_and_empty_pixels(engine: Engine, stride: int) -> None:
    volume = fill_volume(engine, (floor(),), VOXEL_M)
    random = np.random.default_rng(5)
    valid = random.random((13, 22)) < 0.5
    x, z = random.uniform(0.2, 0.7, (2, 13, 22))
    positions = np.where(valid[..., None], np.stack([x, 0 * x + 0.1, z, 0 * x + 1], -1), 0)
    normals = np.where(valid[..., None], [0.0, 1.0, 0.0, 1.0], 0)
    traced = transfer_of(engine, volume, positions, normals, stride)
    here = valid[stride // 2 :: stride, stride // 2 :: stride][: 13 // stride, : 22 // stride]
    np.testing.assert_array_equal(traced.openness, np.where(here, 1.0, -1.0))
    np.testing.assert_array_equal(traced.flatness[~here], 0)
    assert not traced.transfer[~here].any()
    assert not traced.free[~here].any()
    np.testing.assert_allclose(
        traced.transfer[here], np.tile(open_transfer(np.eye(3)[1], 4), (here.sum(), 1)), atol=1e-6
    )


# ---- against closed forms ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("ray_length_m", [ROOM_M, 0.1])
def test_every_ray_away_from_edges(engine: Engine, name: str, ray_length_m: float) -> None:
    scene = SCENES[name]
    traced = trace(engine, fill_volume(engine, scene, VOXEL_M), *points_on(scene, 512, 3), ray_length_m=ray_length_m)
    origins, directions, above = rays_of(traced, 81)
    origins, directions, free = origins[above], directions[above], traced.free[above]
    inside = leaves_volume_after(origins, directions)  # what lies outside the volume cannot block
    must_block = hit(scene, origins, directions, -INNER) < np.minimum(ray_length_m, inside) - 2 * VOXEL_M
    must_pass = hit(scene, origins, directions, OUTER) >= ray_length_m
    assert not (must_block & free).any()
    assert not (must_pass & ~free).any()
    assert (must_block | must_pass).mean() > 0.6  # the slit is six voxels wide, three of them beside an edge
    assert ray_length_m < ROOM_M or must_block.mean() > 0.1


def leaves_volume_after(origins: Floats, directions: Floats) -> Floats:
    """[n] distance along rays from inside to the volume's boundary."""
    slope = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
    return np.maximum(-origins / slope, (SIDE_M - origins) / slope).min(-1)


def random_planes() -> list[HalfSpace]:
    random = np.random.default_rng(7)
    normals = random.normal(size=(20, 3))
    normals[:3] = np.eye(3)
    normals[3] = (1, 1, 1)
    normals[4] = (1, -1, 0)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return [HalfSpace(SIDE_M / 2 + random.uniform(-2, 2, 3) * VOXEL_M, normal) for normal in normals]


@pytest.mark.parametrize("plane", random_planes(), ids=lambda p: "n=" + ",".join(f"{x:.2f}" for x in p.normal))
def test_flat_wall_does_not_darken_itself(engine: Engine, plane: HalfSpace) -> None:
    volume = fill_volume(engine, (plane,), VOXEL_M)
    points, normals = points_on((plane,), 256, 8, ((0.1,) * 3, (0.86,) * 3))
    for rays in (32, 81, 169):
        traced = trace(engine, volume, points, normals, rays=rays)
        np.testing.assert_array_equal(traced.openness, 1.0)
        np.testing.assert_allclose(
            traced.transfer, np.broadcast_to(open_transfer(plane.normal, 4), traced.transfer.shape), atol=2e-6
        )


@pytest.mark.parametrize("distance_m", [0.02, 0.05, 0.1, 0.2, 0.4])
def test_openness_of_a_floor_under_a_wall(engine: Engine, distance_m: float) -> None:
    volume = fill_volume(engine, SCENES["floor under a wall"], VOXEL_M)
    random = np.random.default_rng(9)
    x = random.uniform(0.4, 0.56, 64)
    points = np.stack([x, np.full(64, 0.1), np.full(64, 0.2 + distance_m)], -1)
    traced = trace(engine, volume, points, np.tile([0.0, 1.0, 0.0], (64, 1)), rays=1024)
    expected = 1 - np.mean(
        [wall_share(distance_m, 0.85, left) + wall_share(distance_m, 0.85, SIDE_M - left) for left in x]
    )
    # Half a voxel of the wall's place at the nearest distance, and 1024 directions: both below 0.01 on average.
    assert traced.openness.mean() == pytest.approx(expected, abs=0.01)
    if distance_m == 0.02:
        assert traced.openness.mean() == pytest.approx(0.5, abs=0.03)


def wall_share(distance_m: float, height_m: float, width_m: float) -> float:
    """Share of a floor point's cosine-weighted sky behind a wall that begins beside it (form factor of a rectangle)."""
    slant = np.hypot(distance_m, height_m)
    return float(np.arctan2(width_m, distance_m) - distance_m / slant * np.arctan2(width_m, slant)) / (2 * np.pi)


def test_reach_ends_visibility(engine: Engine) -> None:
    ceiling = box((-1, 0.5, -1), (2, 0.6, 2))
    volume = fill_volume(engine, (ceiling,), VOXEL_M)
    points = np.tile([0.48, 0.3, 0.48], (64, 1))
    up = np.tile([0.0, 1.0, 0.0], (64, 1))
    near, far = (trace(engine, volume, points, up, ray_length_m=reach) for reach in (0.15, 0.3))
    np.testing.assert_array_equal(near.openness, 1.0)  # the ceiling is 19 cm above the rays' origin
    # Within 30 cm lie directions up to 50 degrees off: sin^2 of it of the sky.
    assert far.openness.mean() == pytest.approx((0.19 / 0.3) ** 2, abs=0.06)


def test_nothing_outside_the_volume_blocks(engine: Engine) -> None:
    volume = fill_volume(engine, (floor(),), VOXEL_M)
    random = np.random.default_rng(11)
    points = random.uniform(-2, 3, (64, 3))
    points = np.where((np.abs(points - 0.5) < 0.5).all(-1)[:, None], points + 3, points)
    traced = trace(engine, volume, points, np.tile([0.0, 1.0, 0.0], (64, 1)))
    np.testing.assert_array_equal(traced.openness.ravel()[points[:, 1] > 0.2], 1.0)
    assert np.isfinite(traced.transfer).all()


def test_empty_volume_is_open(engine: Engine) -> None:
    volume = Volume(engine, (0, 0, 0, 1, 1, 1), VOXEL_M)
    traced = trace(engine, volume, np.random.default_rng(0).uniform(0, 1, (64, 3)), np.tile([0, 0, 1.0], (64, 1)))
    np.testing.assert_array_equal(traced.openness, 1.0)


@pytest.mark.parametrize("count", [32, 81, 324])
def test_direction_sets(count: int) -> None:
    """Each set is as even as a lattice of its own size, those of 4 x 4 neighbours together as one of 16 times that."""
    sets = direction_sets(count, 4).directions
    assert len(sets) == SETS
    np.testing.assert_allclose(sets[..., 3].sum(-1), 4 * np.pi, rtol=1e-6)
    directions = sets[..., :3].astype(float)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-6)

    def unevenness(points: Floats) -> float:
        """Greatest angle from anywhere to the nearest point, in units of that of points on a square grid."""
        farthest = np.arccos(np.clip((random_directions(4000, 14) @ points.T).max(1), -1, 1)).max()
        return float(farthest / np.sqrt(2 * np.pi / len(points)))

    assert max(unevenness(one) for one in directions) < 1.5
    blocks = directions.reshape(-1, 16 * count, 3)
    assert max(unevenness(block) for block in blocks) < 1.6
    for a in range(SETS):
        for b in range(a):
            assert np.abs(directions[a] - directions[b]).max() > 0.1


def test_same_bits_twice(engine: Engine) -> None:
    scene = SCENES["ball above a floor"]
    volume = fill_volume(engine, scene, VOXEL_M)
    points: Any = points_on(scene, 64, 13)
    first, second = (trace(engine, volume, *points) for _ in range(2))
    np.testing.assert_array_equal(first.transfer, second.transfer)
    np.testing.assert_array_equal(first.free, second.free)


def test_chosen_samples_are_those_of_the_whole_picture(engine: Engine) -> None:
    """And of the others what was there stays."""
    volume = fill_volume(engine, SCENES["ball above a floor"], VOXEL_M)
    z, x = np.mgrid[0.2:0.8:48j, 0.2:0.8:64j]
    surface = upload_surface(engine, np.stack([x, 0 * x + 0.1, z], -1), np.tile([0.0, 1.0, 0.0], (48, 64, 1)), x > 0.25)
    rays, camera = direction_sets(81, 4), camera_of(64, 48)

    def found(chosen: NDArray[np.int32] | None) -> list[NDArray[Any]]:
        result = transfer_radiance(engine, camera, volume, surface, 4, rays, ROOM_M, chosen=chosen)
        return [engine.download(a) for a in (result.openness, result.flatness, result.free_mask, result.coefficients)]

    whole = found(None)
    assert np.ptp(whole[0]) > 1.1
    chosen = np.array([3, 0, 100, 77, 191], np.int32)
    engine.buffers(TransferBuffers).openness[12, 16].array((12, 16)).fill(-7.0)
    some = found(chosen)
    np.testing.assert_array_equal(some[0].flat[chosen], whole[0].flat[chosen])
    assert (np.delete(some[0], chosen) == -7.0).all()
    for one, other in zip(some[1:], whole[1:], strict=True):
        np.testing.assert_array_equal(one, other)
    assert (found(np.zeros(0, np.int32))[0].flat[chosen] == whole[0].flat[chosen]).all()
