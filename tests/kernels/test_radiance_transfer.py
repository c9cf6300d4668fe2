"""Radiance transfer against its float64 twin, and its visibility against rays that are known in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.stages.radiance_transfer import SETS, direction_sets, transfer_radiance
from server.stages.volume import Volume
from tests.reference import radiance_transfer as twin
from tests.reference.sh import open_transfer
from tests.reference.visibility import trace_volume
from tests.solids import (
    SCENES,
    SIDE_M,
    HalfSpace,
    box,
    fill_volume,
    floor,
    hit,
    points_on,
    solid_voxels,
    upload_surface,
)
from tests.tolerance import relative_tolerance

VOXEL_M = 0.01
ROOM_M = 1000.0
OUTER = 0.87 * VOXEL_M
"""A solid voxel's centre is behind the surface, so no point of it is farther out than half its diagonal."""
INNER = 1.31 * VOXEL_M
"""A point this far in lies in solid voxels, and so does one of the ray's samples: they are 0.87 voxels apart at most."""
EVERYWHERE = ((0.11, 0.05, 0.11), (0.85, 0.9, 0.85))

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Traced:
    """A result on the host, with what it was asked for."""

    transfer: Floats
    openness: Floats
    free: NDArray[np.bool_]
    points: Floats
    normals: Floats


def camera_of(width: int, height: int) -> CameraModel:
    return CameraModel(width=width, height=height, fx=100.0, fy=100.0, cx=0.0, cy=0.0)


def trace(
    engine: Engine,
    volume: Volume,
    points: Floats,
    normals: Floats,
    *,
    rays: int = 81,
    bands: int = 4,
    reach_m: float = ROOM_M,
) -> Traced:
    """Transfer of given points, one a pixel in rows of 8; 64 or more of them."""
    grid = (-1, 8, 3)
    points, normals = points.astype(np.float32).reshape(grid), normals.astype(np.float32).reshape(grid)
    surface = upload_surface(engine, points, normals, np.ones(points.shape[:2], bool))
    camera, directions = camera_of(8, len(points)), direction_sets(rays, bands)
    result = transfer_radiance(engine, camera, volume, surface, 1, directions, reach_m)
    words = engine.download(result.free_mask)
    bits = np.unpackbits(words.view(np.uint8), axis=-1, bitorder="little")[..., :rays].astype(bool)
    return Traced(engine.download(result.coefficients), engine.download(result.openness), bits, points, normals)


def rays_of(traced: Traced, count: int, bands: int = 4) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Origins and directions [rows, cols, count, 3] of every ray, and whether it lies above the surface."""
    rows, cols = np.indices(traced.points.shape[:2])
    directions = direction_sets(count, bands).directions.astype(np.float64)[(rows % 2) * 2 + cols % 2, :, :3]
    origins = np.broadcast_to((traced.points + VOXEL_M * traced.normals)[:, :, None], directions.shape)
    cosines = (directions * traced.normals[:, :, None]).sum(-1)
    return origins.astype(np.float64), directions, cosines > 0


# ---- against the twin --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rays", "bands"), [(81, 4), (169, 6), (32, 2), (33, 3), (1024, 5)])
def test_transfer_is_the_twins_for_the_same_visibility(device: Device, engine: Engine, rays: int, bands: int) -> None:
    scene = SCENES["ball above a floor"]
    points, normals = points_on(scene, 96, 1, EVERYWHERE)
    traced = trace(engine, fill_volume(engine, scene, VOXEL_M), points, normals, rays=rays, bands=bands)
    free = iter(traced.free.reshape(-1, rays))
    sets = direction_sets(rays, bands)
    transfer, openness, above = twin.transfer_radiance(
        np.insert(traced.points, 3, 1, -1).astype(float),
        np.insert(traced.normals, 3, 1, -1).astype(float),
        1,
        sets.directions.astype(float),
        sets.basis.astype(float),
        VOXEL_M,
        lambda *_: next(free),
    )
    assert (traced.openness < 0.95).any() and (traced.openness > 0.999).any()
    # Coefficients are sums of up to 512 terms of magnitude below 1 / 50: their rounding adds to that of the largest.
    np.testing.assert_allclose(
        traced.transfer, transfer, rtol=relative_tolerance(device), atol=relative_tolerance(device)
    )
    np.testing.assert_allclose(traced.openness, openness, atol=relative_tolerance(device))
    np.testing.assert_array_equal(traced.free, above)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("reach_m", [ROOM_M, 0.1])
def test_visibility_is_the_twins(engine: Engine, name: str, reach_m: float) -> None:
    scene = SCENES[name]
    volume = fill_volume(engine, scene, VOXEL_M)
    traced = trace(engine, volume, *points_on(scene, 256, 2, EVERYWHERE), reach_m=reach_m)
    origins, directions, above = rays_of(traced, 81)
    exact = trace_volume(solid_voxels(scene, volume), VOXEL_M, origins[above], directions[above], reach_m)
    free = traced.free[above]
    # Samples less than a voxel apart miss corners that a ray only clips; what they find, is there.
    missed = (free & ~exact).mean()
    assert missed < 0.02
    assert (
        ~free & exact
    ).mean() < 1e-3  # float32 origins within 1e-6 of a voxel's face, and the last sample at `reach`
    assert (~free).mean() > 0.02


def test_strides_and_empty_pixels(engine: Engine) -> None:
    volume = fill_volume(engine, (floor(),), VOXEL_M)
    random = np.random.default_rng(5)
    points = np.stack(
        [random.uniform(0.2, 0.7, (13, 22)), np.full((13, 22), 0.1), random.uniform(0.2, 0.7, (13, 22))], -1
    )
    normals = np.broadcast_to([0.0, 1.0, 0.0], points.shape)
    valid = random.random((13, 22)) < 0.5
    surface = upload_surface(engine, points, normals, valid)
    for stride in (1, 4, 8):
        result = transfer_radiance(engine, camera_of(22, 13), volume, surface, stride, direction_sets(81, 4), ROOM_M)
        here = valid[stride // 2 :: stride, stride // 2 :: stride][: 13 // stride, : 22 // stride]
        openness, transfer = engine.download(result.openness), engine.download(result.coefficients)
        np.testing.assert_array_equal(openness, np.where(here, 1.0, -1.0))
        assert not transfer[~here].any()
        assert not engine.download(result.free_mask)[~here].any()
        np.testing.assert_allclose(transfer[here], np.tile(open_transfer(normals[0, 0], 4), (here.sum(), 1)), atol=1e-6)


# ---- against closed forms ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("reach_m", [ROOM_M, 0.1])
def test_every_ray_away_from_edges(engine: Engine, name: str, reach_m: float) -> None:
    scene = SCENES[name]
    traced = trace(engine, fill_volume(engine, scene, VOXEL_M), *points_on(scene, 512, 3, EVERYWHERE), reach_m=reach_m)
    origins, directions, above = rays_of(traced, 81)
    origins, directions, free = origins[above], directions[above], traced.free[above]
    inside = leaves_volume_after(origins, directions)  # what lies outside the volume cannot block
    must_block = hit(scene, origins, directions, -INNER) < np.minimum(reach_m, inside) - 2 * VOXEL_M
    must_pass = hit(scene, origins, directions, OUTER) >= reach_m
    assert not (must_block & free).any()
    assert not (must_pass & ~free).any()
    assert (must_block | must_pass).mean() > 0.75
    assert must_block.mean() > 0.02


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
        np.testing.assert_allclose(traced.transfer, open_transfer(traced.normals.astype(float), 4), atol=2e-6)


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
    near, far = (trace(engine, volume, points, up, reach_m=reach) for reach in (0.15, 0.3))
    np.testing.assert_array_equal(near.openness, 1.0)  # the ceiling is 19 cm above the rays' origin
    # Within 30 cm lie directions up to 50 degrees off: sin^2 of it of the sky.
    assert far.openness.mean() == pytest.approx((0.19 / 0.3) ** 2, abs=0.06)


def test_nothing_outside_the_volume_blocks(engine: Engine) -> None:
    volume = fill_volume(engine, (floor(),), VOXEL_M)
    random = np.random.default_rng(11)
    points = random.uniform(-2, 3, (64, 3))
    points = np.where((np.abs(points - 0.5) < 0.5).all(-1)[:, None], points + 3, points)
    traced = trace(engine, volume, points, np.tile([0.0, 1.0, 0.0], (64, 1)))
    downward = points[:, 1] > 0.2
    np.testing.assert_array_equal(traced.openness.ravel()[downward], 1.0)
    assert np.isfinite(traced.transfer).all()


def test_empty_volume_is_open(engine: Engine) -> None:
    volume = Volume(engine, (0, 0, 0, 1, 1, 1), VOXEL_M)
    traced = trace(engine, volume, np.random.default_rng(0).uniform(0, 1, (64, 3)), np.tile([0, 0, 1.0], (64, 1)))
    np.testing.assert_array_equal(traced.openness, 1.0)


def test_neighbouring_samples_use_different_directions() -> None:
    sets = direction_sets(81, 4).directions[..., :3].astype(float)
    for a in range(SETS):
        for b in range(a):
            assert (sets[a] @ sets[b].T).max() < 1 - 1e-6
    np.testing.assert_allclose(np.linalg.norm(sets, axis=-1), 1, atol=1e-6)
    assert direction_sets(81, 4).directions[..., 3].sum(-1) == pytest.approx([4 * np.pi] * SETS, rel=1e-6)


def test_same_bits_twice(engine: Engine) -> None:
    scene = SCENES["ball above a floor"]
    volume = fill_volume(engine, scene, VOXEL_M)
    points: Any = points_on(scene, 64, 13, EVERYWHERE)
    first, second = (trace(engine, volume, *points) for _ in range(2))
    np.testing.assert_array_equal(first.transfer, second.transfer)
    np.testing.assert_array_equal(first.free, second.free)
