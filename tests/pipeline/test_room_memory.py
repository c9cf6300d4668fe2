"""Memory follows the surface: a budget that holds, bricks that go to the host and come back, and no surface lost."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.transfer.radiance_transfer import direction_sets, transfer_radiance
from server.volume.brick_pool import BRICK_BYTES
from server.volume.brick_table import AWAY_SLOT, BRICK, NO_SLOT
from server.volume.raycast import raycast
from server.volume.volume import Volume
from tests.bench.geometry.memory import room_memory
from tests.bench.truth.rooms import LIVING_ROOM, walk
from tests.scenes.analytic import look, look_at, plane, room, sphere
from tests.scenes.volumes import allocate_everywhere, cast, fuse, upload_depth

CAMERA = CameraModel(width=160, height=120, fx=131.0, fy=131.0, cx=79.5, cy=59.5)
ROOM_BOUNDS = (-0.1, -0.1, -0.1, 6.1, 3.1, 6.1)
VOXEL_M = 0.04
TIGHT = 800
"""Bricks: as many as the largest view of the room needs, and under half of what the room does."""

Floats = NDArray[np.float64]


def room_volume(engine: Engine, bricks: int, host_bricks: int = 10**6) -> Volume:
    host_bytes = host_bricks * 12 * BRICK**3
    return Volume(engine, ROOM_BOUNDS, VOXEL_M, bricks * BRICK_BYTES, host_bytes)


def fuse_walk(engine: Engine, volume: Volume, views: Sequence[Floats]) -> None:
    for view in views:
        fuse(engine, volume, CAMERA, view, LIVING_ROOM.depth_m(CAMERA, view))


def contents(volume: Volume) -> dict[tuple[int, ...], list[Any]]:
    """tsdf, weight and colour of every brick by its place."""
    bricks = volume.download_bricks()
    arrays = (bricks.tsdf, bricks.weight, bricks.colors, bricks.color_weight)
    return {tuple(place): parts for place, *parts in zip(bricks.indices.tolist(), *arrays, strict=True)}


def assert_same(one: dict[tuple[int, ...], list[Any]], other: dict[tuple[int, ...], list[Any]]) -> None:
    assert one.keys() == other.keys()
    for place, arrays in one.items():
        for a, b in zip(arrays, other[place], strict=True):
            np.testing.assert_array_equal(a, b)


# ---- released and brought back -----------------------------------------------------------------------------------


def test_a_tight_budget_ends_with_the_same_bits(engine: Engine, device: Device) -> None:
    views = walk(60)
    ample, tight = room_volume(engine, 10**5), room_volume(Engine(device), TIGHT)
    released = 0
    for number, view in enumerate(views):
        fuse_walk(engine, ample, [view])
        fuse_walk(tight._engine, tight, [view])
        if number == 30:  # the light has changed in part
            ample.forget_colors(0.6)
            tight.forget_colors(0.6)
        assert not ample.is_full
        assert not tight.is_full
        assert tight.voxels.nbytes + tight.colors.nbytes + tight.octets.nbytes <= (TIGHT + 1) * BRICK_BYTES
        released = max(released, tight.released_bricks)
    assert released > TIGHT
    assert ample.released_bricks == 0
    assert_same(contents(ample), contents(tight))
    for view in views[::20]:
        tight.bring_back(CAMERA, tight.volume_from_world() @ view)
        found, wanted = cast(tight._engine, tight, CAMERA, view), cast(engine, ample, CAMERA, view)
        np.testing.assert_array_equal(found[0], wanted[0])
        assert np.abs(found[1] - wanted[1]).max() < 0.02 * VOXEL_M  # rays start elsewhere where less is resident
    tight._engine.close()


def test_colors_that_lose_weight_are_saved_again(engine: Engine) -> None:
    volume = room_volume(engine, TIGHT)
    fuse_walk(engine, volume, walk(12)[:4])
    assert volume.released_bricks > 0
    saved = volume.changes
    assert not len(volume.changed_since(saved))
    volume.forget_colors(1.0)
    np.testing.assert_array_equal(volume.changed_since(saved), volume.places())
    assert set(np.unique(volume.download_bricks().color_weight)) == {0, 1}


def test_colours_come_back_too(engine: Engine) -> None:
    volume = room_volume(engine, TIGHT)
    views = walk(12)
    fuse_walk(engine, volume, views[:1])
    before = volume.download_bricks()
    assert before.color_weight.any()
    known = {tuple(place): color for place, color in zip(before.indices.tolist(), before.colors, strict=True)}
    fuse_walk(engine, volume, views[1:4])
    assert volume.released_bricks > 0
    after = volume.download_bricks()
    same = [
        np.array_equal(known[tuple(place)], color)
        for place, color in zip(after.indices.tolist(), after.colors, strict=True)
        if tuple(place) in known
    ]
    assert np.mean(same) > 0.9  # all but those that both halves share


def test_what_the_camera_sees_is_never_away(engine: Engine) -> None:
    volume = room_volume(engine, TIGHT)
    for view in walk(40):
        fuse_walk(engine, volume, [view])
        slots = engine.download(volume.slots_device)
        z, y, x = np.nonzero(slots == AWAY_SLOT)
        centers = (np.stack([x, y, z], -1) + 0.5) * BRICK * VOXEL_M + ROOM_BOUNDS[:3]
        in_camera = (centers - view[:3, 3]) @ view[:3, :3]
        pixels = in_camera[:, :2] / np.maximum(in_camera[:, 2:], 1e-6) * 131.0 + (79.5, 59.5)
        seen = (in_camera[:, 2] > 0) & (np.abs(pixels - (79.5, 59.5)) < (80, 60)).all(-1)
        assert not seen.any()
    assert volume.released_bricks > 0


def test_few_frames_release_many(engine: Engine) -> None:
    """Hysteresis: on a tight budget not every frame moves bricks to the host."""
    volume = room_volume(engine, 1300)
    moves = 0
    for view in walk(60):
        before = volume.released_bricks
        fuse_walk(engine, volume, [view])
        moves += volume.released_bricks > before
    assert 0 < moves <= 25


def test_a_released_wall_still_stops_rays(engine: Engine) -> None:
    """Transfer under a ceiling is the same, but for the voxel by which a released surface is thicker."""
    views = walk(30)
    volume = room_volume(engine, 10**5)
    fuse_walk(engine, volume, views)
    floor_view = views[15]
    volume_from_camera = volume.volume_from_world() @ floor_view
    rays, count = direction_sets(81, 2), 81
    surface = raycast(engine, CAMERA, volume_from_camera, volume)

    def blocked_share() -> float:
        result = transfer_radiance(engine, CAMERA, volume, surface, 8, rays, 1000.0)
        bits = np.unpackbits(engine.download(result.free_mask).view(np.uint8), axis=-1, bitorder="little")[..., :count]
        return 1 - float(bits.mean()) / 0.5  # of those above the surface, about

    closed = blocked_share()
    residency = volume._residency
    resident = residency._table.resident()
    behind = resident[~residency._in_view(CAMERA, volume_from_camera, resident)]
    assert len(behind) > len(resident) / 4
    residency._release(behind)
    volume.update_tables()
    away = blocked_share()
    residency.store.forget(behind)
    residency._table.leave(behind, NO_SLOT)
    residency._place(behind)
    volume.update_tables()
    opened = blocked_share()
    assert closed > 0.9
    assert away == pytest.approx(closed, abs=0.01)
    assert opened < closed - 0.1


def test_a_full_host_says_so_and_loses_nothing(engine: Engine) -> None:
    volume = room_volume(engine, TIGHT, host_bricks=100)
    views = walk(120)
    fuse_walk(engine, volume, views[:4])
    assert not volume.is_full
    for view in views[4:]:
        before = contents(volume)
        fuse_walk(engine, volume, [view])
        if volume.is_full:
            break
    assert volume.is_full
    assert volume.released_bricks <= 100
    assert contents(volume).keys() >= before.keys()


# ---- what is not kept --------------------------------------------------------------------------------------------


def test_bricks_that_noise_asked_for_are_given_back(engine: Engine) -> None:
    wall = [plane((3.0, 1.5, 5.0), (0, 0, -1))]
    view = look_at((3.0, 1.5, 1.0), (3.0, 1.5, 5.0))
    exact = look(wall, CAMERA, view).depth_m
    quiet, noisy = room_volume(engine, 10**5), None
    for _ in range(5):
        fuse(engine, quiet, CAMERA, view, exact)
    needed = quiet.allocated_bricks
    rng = np.random.default_rng(0)
    noisy = room_volume(engine, 10**5)
    for _ in range(5):
        flying = rng.random(exact.shape) < 0.02
        fuse(engine, noisy, CAMERA, view, np.where(flying, rng.uniform(0.5, 4, exact.shape), exact))
    grabbed = noisy.allocated_bricks
    assert grabbed > 2 * needed
    for _ in range(120):
        fuse(engine, noisy, CAMERA, view, exact)
    assert noisy.allocated_bricks < needed + 0.25 * (grabbed - needed)  # those beside the wall's stay
    hit, depth, _ = cast(engine, noisy, CAMERA, view)
    assert np.abs(depth - exact)[hit].max() < 0.03 * VOXEL_M  # seen: 0.015
    assert hit.mean() > 0.8  # the room ends within the picture


@pytest.mark.parametrize("offset_m", [0.0, 0.02, 0.16])
def test_no_surface_is_given_back(engine: Engine, offset_m: float) -> None:
    """A floor seen edge-on, whose projective distances are long, on a face between bricks and elsewhere."""
    volume = room_volume(engine, 10**5)
    floor_y = ROOM_BOUNDS[1] + 8 * 0.32 + offset_m  # y is down
    eye = np.array((3.0, floor_y - 0.35, 0.2))
    view, away = look_at(eye, np.add(eye, (0, 0, 1))), look_at(eye, np.subtract(eye, (0, 1, 0.3)))
    depth = look([plane((0, floor_y, 0), (0, -1, 0))], CAMERA, view).depth_m
    fuse(engine, volume, CAMERA, view, np.where(depth < 6, depth, 0))
    above = look_at((3.0, floor_y - 0.6, 1.0), (3.0, floor_y, 3.5))
    before = cast(engine, volume, CAMERA, above)
    assert before[0].mean() > 0.1
    for _ in range(50):
        fuse(engine, volume, CAMERA, away, np.zeros_like(depth))
    for found, wanted in zip(cast(engine, volume, CAMERA, above), before, strict=True):
        np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("far", [(1e4, 0, 0), (0, -1e4, 1e4), (1e7, 1e7, 1e7)])
def test_a_camera_far_away_gets_nothing(engine: Engine, far: tuple[float, float, float]) -> None:
    volume = room_volume(engine, 10**5)
    before = volume.device_bytes
    rng = np.random.default_rng(1)
    for turn in range(4):
        view = look_at(far, np.add(far, (np.cos(turn), 0.1, np.sin(turn))))
        fuse(engine, volume, CAMERA, view, rng.uniform(0.1, 10, (CAMERA.height, CAMERA.width)))
    assert volume.allocated_bricks == 0
    assert volume.device_bytes == before


def test_pure_noise_stays_inside_budget_and_bounds(engine: Engine) -> None:
    volume = room_volume(engine, 500, host_bricks=0)
    rng = np.random.default_rng(1)
    for view in walk(6):
        fuse(engine, volume, CAMERA, view, rng.uniform(0.1, 10, (CAMERA.height, CAMERA.width)))
        assert volume.allocated_bricks <= 500
    assert volume.is_full
    hit, _, _ = cast(engine, volume, CAMERA, walk(6)[-1])
    assert hit.shape == (CAMERA.height, CAMERA.width)


# ---- dense and sparse --------------------------------------------------------------------------------------------

DENSE_BOUNDS = (-1.1, -1.0, -0.4, 1.05, 1.0, 2.3)
DENSE_SCENE = [room((-1.0, -0.9, -0.3), (0.95, 0.9, 2.2)), sphere((0.1, 0.2, 1.2), 0.4)]
ARC = [look_at((0.7 * np.sin(a), -0.3, -0.1 - 0.1 * np.cos(a)), (0, 0.1, 1.4)) for a in np.linspace(-1, 1, 10)]
AROUND = [
    look_at((0.8 * np.sin(a), -0.3, 1.0 - 0.8 * np.cos(a)), (0.1, 0.2, 1.2))
    for a in np.linspace(0, 2 * np.pi, 12, endpoint=False)
]


def depths_of_both(engine: Engine, views: Sequence[Floats], voxel_m: float) -> tuple[Floats, Floats]:
    """[n, h, w] depth in voxels of views of the scene fused into a sparse and a dense volume; the same pixels hit."""
    sparse, other = Volume(engine, DENSE_BOUNDS, voxel_m), Engine(engine.device)
    dense = Volume(other, DENSE_BOUNDS, voxel_m)
    allocate_everywhere(dense)
    for view in views:
        depth = look(DENSE_SCENE, CAMERA, view).depth_m
        fuse(engine, sparse, CAMERA, view, depth)
        fuse(other, dense, CAMERA, view, depth)
    assert sparse.allocated_bricks < 0.7 * dense.allocated_bricks
    found = [(cast(engine, sparse, CAMERA, view), cast(other, dense, CAMERA, view)) for view in views]
    other.close()
    for one, two in found:
        np.testing.assert_array_equal(one[0], two[0])
        assert one[0].mean() > 0.9
    return np.stack([one[1] for one, _ in found]) / voxel_m, np.stack([two[1] for _, two in found]) / voxel_m


@pytest.mark.parametrize("voxel_m", [0.02, 0.035])
@pytest.mark.parametrize("views", [ARC[4:5], ARC], ids=["one view", "an arc"])
def test_dense_and_sparse_are_one_surface(engine: Engine, views: Sequence[Floats], voxel_m: float) -> None:
    """Every pixel: bricks hold all voxels that interpolation reads."""
    sparse, dense = depths_of_both(engine, views, voxel_m)
    assert np.abs(sparse - dense).max() < 5e-4  # seen: 2.4e-4


@pytest.mark.parametrize("voxel_m", [0.02, 0.035])
def test_dense_and_sparse_all_round(engine: Engine, voxel_m: float) -> None:
    """Where a surface is seen edge-on first and its bricks come late, they lack the free space of earlier views.

    That is tsdf 1 among the means of voxels at silhouettes: one pixel in 10 000 sees past an edge in one volume only.
    """
    sparse, dense = depths_of_both(engine, AROUND, voxel_m)
    differs = np.abs(sparse - dense)
    assert np.quantile(differs, 0.99) < 2e-4  # seen: 1e-4, between rays that are walked
    assert np.quantile(differs, 0.999) < 0.005  # seen: 0.0024
    assert (differs > 0.1).mean() < 5e-5  # seen: 9e-6


def test_a_volume_has_what_its_device_gives_one(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine.device, "volume_bytes", 120 * BRICK_BYTES)
    volume = Volume(engine, ROOM_BOUNDS, VOXEL_M)
    allocate_everywhere(volume)
    assert (volume.capacity, volume.allocated_bricks) == (120, 120)
    assert volume.released_bricks == np.prod(volume.bricks) - 120


# ---- a room ------------------------------------------------------------------------------------------------------


def test_a_room_at_a_centimetre_stays_under_600_mb(device: Device) -> None:
    gc.collect()
    figures = room_memory(device, lambda _: None, frames=24)
    assert figures["covered"] > 0.99
    assert figures["median_error_voxels"] < 0.01  # seen: 0.0032
    assert figures["full_frames"] == 0
    assert figures["device_mb"] < 400
    assert not figures["growth_mb"] >= 600  # not a number where the system does not tell
    assert figures["small_full_frames"] == 0
    assert figures["small_most_released_bricks"] > 5000
    assert figures["small_differing_bricks"] == 0
    assert figures["small_greatest_difference_voxels"] < 0.001  # seen: 0


def test_a_table_of_four_million_bricks_works(engine: Engine) -> None:
    """The greatest there is: 12.8 m at 1 cm."""
    volume = Volume(engine, (-6.4, -6.4, -6.4, 6.4, 6.4, 6.4), 0.01)
    assert np.prod(volume.bricks) == 160**3
    view = look_at((5.0, 5.0, 5.0), (6.0, 6.0, 6.0))
    depth = look([plane((5.8, 5.8, 5.8), (-1, -1, -1))], CAMERA, view).depth_m
    fuse(engine, volume, CAMERA, view, depth)
    hit, found, _ = cast(engine, volume, CAMERA, view)
    assert hit[30:90, 40:120].all()
    assert np.abs(found - depth)[hit].max() < 0.01 * volume.voxel_m  # seen: 0.0007
    volume.allocate(CAMERA, volume.volume_from_world() @ view, upload_depth(engine, np.zeros_like(depth)))
    assert not volume.is_full
