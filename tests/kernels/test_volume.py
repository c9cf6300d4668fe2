"""The brick table: every measured surface has its bricks, and the tables for empty-space skipping are exact."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.rigid import inverse_rigid
from server.opencl.engine import Engine, int4
from server.volume.brick_pool import BRICK_BYTES
from server.volume.volume import BRICK, TRUNCATION_VOXELS, Volume, VolumeSizeError
from tests.reference import integrate as integrate_twin
from tests.reference import volume as twin
from tests.scenes.analytic import Shape, look, look_at, plane, room, sphere
from tests.scenes.volumes import cast, dense_voxels, fill, fuse, in_bricks, upload_depth

CAMERA = CameraModel(width=97, height=71, fx=80.0, fy=78.0, cx=47.3, cy=36.1)
BOUNDS = {0.04: (-1.0, -1.0, 0.0, 1.0, 1.0, 2.4), 0.015: (-0.5, -0.5, 0.6, 0.5, 0.5, 1.8)}
"""By voxel size. At 15 mm a pixel at 1.5 m is wider than a voxel."""
VOXEL_M = 0.04
LIMIT = 15


def volume_of(engine: Engine, voxel_m: float = VOXEL_M, bricks: int = 10**6) -> Volume:
    """A volume with this budget of bricks, and none on the host."""
    return Volume(engine, BOUNDS[voxel_m], voxel_m, budget_bytes=bricks * BRICK_BYTES, host_budget_bytes=0)


# ---- allocation --------------------------------------------------------------------------------------------------

WALL: list[Shape] = [plane((0, 0, 1.5), (0, 0, -1))]
SCENES: dict[str, list[Shape]] = {
    "wall": WALL,
    "tilted wall": [plane((0, 0, 1.5), (0.6, 0.4, -0.7))],
    "ball in a room": [room((-0.9, -0.9, -0.3), (0.95, 0.9, 2.2)), sphere((0.1, 0.2, 1.2), 0.4)],
    "floor seen edge-on": [plane((0, 0.3, 0), (0, -1, 0.02))],
}
VIEWS = {
    "straight": np.eye(4),
    "turned": look_at((0.4, -0.3, -0.2), (-0.2, 0.2, 1.4)),
    "from outside": look_at((1.6, -0.9, 0.1), (-0.1, 0.2, 1.3)),
}


def assert_enough_bricks(engine: Engine, volume: Volume, view: NDArray[np.float64], depth: NDArray[np.float64]) -> None:
    """Every voxel within truncation of the measured surface has a brick, and few bricks are unused."""
    pose = volume.volume_from_world() @ view
    volume.allocate(CAMERA, pose, upload_depth(engine, depth))
    allocated = engine.download(volume.slots_device) >= 0
    needed = twin.mark_bricks(CAMERA, pose, depth, volume.bricks, volume.voxel_m, volume.truncation_m)
    assert needed.any()
    assert not (needed & ~allocated).any()
    within = twin.mark_bricks(CAMERA, pose, depth, volume.bricks, volume.voxel_m, 2 * BRICK * volume.voxel_m)
    assert allocated.sum() <= max(2 * within.sum(), 27)


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("voxel_m", BOUNDS)
def test_measured_surface_has_its_bricks(engine: Engine, scene: str, view: str, voxel_m: float) -> None:
    depth = look(SCENES[scene], CAMERA, VIEWS[view]).depth_m
    assert_enough_bricks(engine, volume_of(engine, voxel_m), VIEWS[view], np.where(depth < 10, depth, 0))


@pytest.mark.parametrize("column", [40, 41])
def test_a_thing_one_pixel_wide_has_its_bricks(engine: Engine, column: int) -> None:
    depth = np.full((CAMERA.height, CAMERA.width), 2.2)
    depth[:, column] = 0.8
    assert_enough_bricks(engine, volume_of(engine), np.eye(4), depth)


@pytest.mark.parametrize("row", [40, 41, 42, 43])
def test_a_thing_one_pixel_high_has_its_bricks(engine: Engine, row: int) -> None:
    """In front of a wall: a tile of pixels holds both."""
    depth = np.full((CAMERA.height, CAMERA.width), 1.6)
    depth[row] = 0.8
    assert_enough_bricks(engine, volume_of(engine), np.eye(4), depth)


@pytest.mark.parametrize("pixel", [(30, 40), (31, 40), (30, 41), (31, 41)])
def test_one_valid_pixel_has_its_bricks(engine: Engine, pixel: tuple[int, int]) -> None:
    depth = np.zeros((CAMERA.height, CAMERA.width))
    depth[pixel] = 1.1
    assert_enough_bricks(engine, volume_of(engine, 0.015), np.eye(4), depth)


@pytest.mark.parametrize("seed", range(8))
def test_scattered_pixels_have_their_bricks(engine: Engine, seed: int) -> None:
    """Each alone, from a camera whose pixels are narrower than voxels: nothing but its own slices marks for it."""
    fine = CameraModel(width=291, height=213, fx=240.0, fy=234.0, cx=142.0, cy=108.0)
    rng = np.random.default_rng(seed)
    depth = np.zeros((fine.height, fine.width))
    alone = rng.random(depth[3::16, 5::16].shape) < 0.2
    depth[3::16, 5::16] = np.where(alone, rng.uniform(0.7, 1.7, alone.shape), 0)
    volume = volume_of(engine, 0.015)
    pose = volume.volume_from_world() @ VIEWS["turned"]
    volume.allocate(fine, pose, upload_depth(engine, depth))
    needed = twin.mark_bricks(fine, pose, depth, volume.bricks, volume.voxel_m, volume.truncation_m + volume.voxel_m)
    assert needed.any()
    assert not (needed & (engine.download(volume.slots_device) < 0)).any()


def test_unmeasured_pixels_need_no_bricks(engine: Engine) -> None:
    volume = volume_of(engine)
    pose = volume.volume_from_world()
    volume.allocate(CAMERA, pose, upload_depth(engine, np.zeros((CAMERA.height, CAMERA.width))))
    assert volume.allocated_bricks == 0
    behind = look_at((0, 0, -0.5), (0, 0, -2))
    volume.allocate(CAMERA, pose @ behind, upload_depth(engine, np.full((CAMERA.height, CAMERA.width), 1.0)))
    assert volume.allocated_bricks == 0
    assert not volume.is_full


def test_bricks_keep_their_slots(engine: Engine) -> None:
    volume = volume_of(engine)
    before = np.full(engine.download(volume.slots_device).shape, -1)
    for view in VIEWS.values():
        depth = look(SCENES["ball in a room"], CAMERA, view).depth_m
        fuse(engine, volume, CAMERA, view, depth)
        slots = engine.download(volume.slots_device)
        np.testing.assert_array_equal(slots[before >= 0], before[before >= 0])
        used = np.sort(slots[slots >= 0])
        np.testing.assert_array_equal(used, 1 + np.arange(volume.allocated_bricks))
        listed = engine.download(volume.allocated_device)[: volume.allocated_bricks]
        np.testing.assert_array_equal(slots.ravel()[listed], used)
        before = slots


@pytest.mark.parametrize("bricks", [0, 1, 60])
def test_exhausted_budget_says_so_and_harms_nothing(engine: Engine, bricks: int) -> None:
    volume = volume_of(engine, bricks=bricks)
    wall = look(WALL, CAMERA, np.eye(4)).depth_m
    fuse(engine, volume, CAMERA, np.eye(4), wall)
    assert volume.is_full
    assert volume.allocated_bricks == bricks
    before = cast(engine, volume, CAMERA, np.eye(4))
    assert before[0].any() == (bricks > 0)
    other = look_at((0, 0, 1.2), (0.1, 0.2, 0))
    fuse(engine, volume, CAMERA, other, np.full(wall.shape, 0.9))
    assert volume.is_full
    assert volume.allocated_bricks == bricks
    for array, was in zip(cast(engine, volume, CAMERA, np.eye(4)), before, strict=True):
        np.testing.assert_array_equal(array, was)


def test_a_volume_that_fits_is_not_full(engine: Engine) -> None:
    volume = volume_of(engine)
    wall = look(WALL, CAMERA, np.eye(4)).depth_m
    fuse(engine, volume, CAMERA, np.eye(4), wall)
    exact = volume_of(engine, bricks=volume.allocated_bricks)
    fuse(engine, exact, CAMERA, np.eye(4), wall)
    assert not exact.is_full


def test_volume_covers_its_bounds(engine: Engine) -> None:
    volume = Volume(engine, (-0.1, 0.2, 1e4, 0.51, 0.6, 1e4 + 0.3), 0.01)
    assert volume.bricks == (8, 5, 4)
    np.testing.assert_allclose(inverse_rigid(volume.volume_from_world())[:3, 3], (-0.1, 0.2, 1e4))
    assert volume.truncation_m == pytest.approx(TRUNCATION_VOXELS * 0.01)


@pytest.mark.parametrize(
    ("bounds", "voxel_m"),
    [
        ((0, 0, 0, 10, 10, 10), 0.001),
        ((0, 0, 0, 1, 1, 1), 1e-9),
        ((0, 0, 0, 2**25, 2**25, 2**25), 1.0),  # 2^66 bricks: more than an int64 holds
        ((0, 0, 0, 1, 0, 1), 0.01),
        ((0, 0, 0, 1, 1, -1), 0.01),
    ],
)
def test_impossible_volumes_are_refused(engine: Engine, bounds: tuple[float, ...], voxel_m: float) -> None:
    with pytest.raises(VolumeSizeError, match=r"a volume of .* m at .* mm a voxel"):
        Volume(engine, bounds, voxel_m)  # type: ignore[arg-type]


def test_a_side_that_is_not_there_is_no_matter_of_voxels(engine: Engine) -> None:
    with pytest.raises(VolumeSizeError, match="a side that is not above 0"):
        Volume(engine, (0, 0, 0, 1, 1, -1), 0.01)


# ---- tables for rays ---------------------------------------------------------------------------------------------


class Gaps:
    """The tables' kernels and their buffers; every step is compared with its twin."""

    def __init__(self, engine: Engine, shape: tuple[int, int, int], limit: int, items: int = 64) -> None:
        self._engine, self._shape, self._limit, self._items = engine, shape, limit, items
        space, count = engine.workspace, int(np.prod(shape))
        self._occupied = space.upload("occupied", np.full(count, 255, np.uint8))
        self._gaps = [space.array(f"gap_{axis}", ((2 << axis) * count + 16,), np.uint8) for axis in range(3)]
        for gap in self._gaps:
            gap.fill(np.uint8(77))
        self._known = np.full(shape, 2)

    def update(self, solid: NDArray[np.uint64]) -> NDArray[np.uint8]:
        """[octant, z, y, x]"""
        engine, (z, y, x), bricks = self._engine, self._shape, int4(*self._shape[::-1], 0)
        changed = engine.workspace.upload("changed", np.full(6, -(1 << 30), np.int32))
        listed, kernel = engine.workspace.upload("solid", solid), engine.kernel("volume.cl", "gaps_in_slices")
        tables = (listed, self._limit, self._occupied, changed, *self._gaps[:2])
        engine.launch(kernel, (self._items * z,), bricks, *tables, local=(self._items,))
        expected = twin.changed_box(self._known, solid != 0)
        low, high = engine.download(changed).reshape(2, 3)
        np.testing.assert_array_equal((-low, high), expected)
        self._known = solid != 0
        inner = self._compared(1, self._compared(0, twin.start_gaps(solid, self._limit)[None]))
        kernel, rest = engine.kernel("volume.cl", "gaps_along_z"), (self._limit, changed, self._gaps[2])
        engine.launch(kernel, (-(-x // 16), y, 8 * z), bricks, self._gaps[1], *rest)
        return self._compared(2, inner)

    def _compared(self, axis: int, inner: NDArray[np.uint8]) -> NDArray[np.uint8]:
        expected = twin.gap_along_axis(inner, axis, self._limit)
        found = self._engine.download(self._gaps[axis])
        np.testing.assert_array_equal(found[:-16].reshape(expected.shape), expected)
        assert (found[-16:] == 77).all()
        return expected


@pytest.mark.parametrize("shape", [(7, 5, 9), (1, 1, 20), (3, 19, 2), (8, 8, 8), (2, 3, 37)])
@pytest.mark.parametrize("share", [0.0, 0.004, 0.05, 0.5, 1.0])
def test_gaps_match_brute_force(engine: Engine, shape: tuple[int, int, int], share: float) -> None:
    occupied = np.random.default_rng(sum(shape)).random(shape) < share
    solid = np.where(occupied, np.uint64(1) << np.uint64(41), np.uint64(0))
    expected = twin.octant_gaps(occupied, LIMIT)
    for items in (64, 4):  # of a group: more and fewer than a slice has rows
        np.testing.assert_array_equal(Gaps(engine, shape, LIMIT, items).update(solid), expected)


def test_gaps_stop_at_their_limit(engine: Engine) -> None:
    occupied = np.zeros((1, 1, 40), bool)
    occupied[..., 35] = True
    gaps = Gaps(engine, occupied.shape, LIMIT).update(occupied.astype(np.uint64))
    np.testing.assert_array_equal(gaps[1, 0, 0], np.minimum(np.maximum(35 - np.arange(40), -1) % 41, LIMIT))
    np.testing.assert_array_equal(gaps[0, 0, 0, :35], LIMIT)


@pytest.mark.parametrize("shape", [(20, 18, 40), (5, 40, 7)])
def test_gaps_follow_single_changes(engine: Engine, shape: tuple[int, int, int]) -> None:
    """Recomputing only near a change gives the same tables as computing all."""
    rng = np.random.default_rng(7)
    gaps, solid = Gaps(engine, shape, LIMIT), np.zeros(shape, np.uint64)
    solid.ravel()[rng.integers(0, solid.size, 6)] = 1 << 41
    for _ in range(12):
        np.testing.assert_array_equal(gaps.update(solid), twin.octant_gaps(solid != 0, LIMIT))
        place = tuple(rng.integers(0, shape))
        solid[place] = 0 if solid[place] else 1
        if rng.random() < 0.3:
            solid[solid != 0] = 3  # still solid: no change
            solid[tuple(np.argwhere(solid)[0])] = 0


@pytest.mark.parametrize("share", [0.0, 0.001, 0.05, 1.0])
def test_solid_cells_match_brute_force(engine: Engine, share: float) -> None:
    """A voxel is solid if it was seen and is negative; also if only some bricks have slots, in any order."""
    rng = np.random.default_rng(3)
    shape = (3 * BRICK, 2 * BRICK, 4 * BRICK)
    solid = rng.random(shape) < share
    tsdf = np.where(solid, -rng.random(shape), rng.random(shape) * rng.integers(0, 2, shape))
    weight = np.where(solid | (rng.random(shape) < 0.5), 1.0, 0.0)
    tsdf[weight == 0] = -0.5  # never seen: not solid whatever is written there
    masks, octets = twin.find_solid(tsdf, weight)
    count = masks.size
    chosen = rng.permutation(count)[: count - 5].astype(np.int32)
    slots = np.full(count, -1, np.int32)
    slots[chosen] = rng.permutation(len(chosen))
    pool = np.zeros((count, BRICK**3, 2), np.float32)
    pool[slots[chosen]] = np.stack([in_bricks(tsdf), in_bricks(weight)], -1)[chosen]
    space = engine.workspace
    device_masks = space.upload("masks", np.zeros(masks.shape, np.uint64))
    device_octets = space.upload("octets", np.full((count, 64), 77, np.uint8))
    arguments = (space.upload("chosen", chosen), space.upload("slots", slots), space.upload("pool", pool))
    kernel = engine.kernel("volume.cl", "find_solid")
    engine.launch(kernel, (16 * len(chosen),), len(chosen), *arguments, device_masks, device_octets)
    has_slot = slots.reshape(masks.shape) >= 0
    np.testing.assert_array_equal(engine.download(device_masks), np.where(has_slot, masks, 0))
    found = engine.download(device_octets)
    np.testing.assert_array_equal(found[slots[chosen]], octets.reshape(count, 64)[chosen])
    assert (found[len(chosen) :] == 77).all()


@pytest.mark.parametrize("share", [0.0, 0.05, 0.3])
def test_bricks_near_solid_match_their_twin(engine: Engine, share: float) -> None:
    rng, shape = np.random.default_rng(2), (5, 7, 6)
    cell = np.uint64(1) << rng.integers(0, 64, shape, np.uint64)
    solid = np.where(rng.random(shape) < share, cell, np.uint64(0))
    listed = rng.permutation(solid.size)[:150].astype(np.int32)
    near = engine.workspace.upload("near", np.full(len(listed) + 1, 77, np.uint8))
    arguments = (
        engine.workspace.upload("listed", listed),
        int4(*shape[::-1], 0),
        engine.workspace.upload("solid", solid),
    )
    kernel = engine.kernel("volume.cl", "find_near_solid")
    engine.launch(kernel, (len(listed),), len(listed), *arguments, near)
    np.testing.assert_array_equal(engine.download(near), [*twin.near_solid(solid).ravel()[listed], 77])


def test_summary_follows_the_voxels(engine: Engine) -> None:
    """A brick that is no longer solid leaves no trace in the tables."""
    volume = volume_of(engine)
    shape = tuple(BRICK * count for count in reversed(volume.bricks))
    rng = np.random.default_rng(5)
    for share in (0.01, 0.0005, 0.0):
        tsdf = np.where(rng.random(shape) < share, -0.5, 0.5)
        fill(engine, volume, tsdf, np.ones(shape))
        masks, octets = twin.find_solid(tsdf, np.ones(shape))
        np.testing.assert_array_equal(engine.download(volume.solid), masks)
        np.testing.assert_array_equal(engine.download(volume.octets)[1:], octets.reshape(-1, 64))
        tables = engine.download(volume.arguments()[2])  # type: ignore[arg-type]
        gaps = tables[int(volume.shape["gaps_at"]) :]
        np.testing.assert_array_equal(gaps, twin.octant_gaps(masks != 0, LIMIT).ravel())


def test_a_volume_remade_in_the_same_memory_is_empty(engine: Engine) -> None:
    first = volume_of(engine)
    fuse(engine, first, CAMERA, np.eye(4), look(WALL, CAMERA, np.eye(4)).depth_m)
    again = volume_of(engine)
    _, weight, allocated = dense_voxels(engine, again)
    assert not weight.any()
    assert not allocated.any()
    assert not cast(engine, again, CAMERA, np.eye(4))[0].any()


def test_fused_wall_is_where_it_is(engine: Engine) -> None:
    """The dense view of the bricks, as the other tests use it: voxels at their places."""
    volume = volume_of(engine)
    fuse(engine, volume, CAMERA, np.eye(4), look(WALL, CAMERA, np.eye(4)).depth_m)
    tsdf, weight, _ = dense_voxels(engine, volume)
    z = integrate_twin.voxel_centers(tsdf.shape, VOXEL_M)[..., 2]
    near = (weight > 0) & (np.abs(tsdf) < 1)
    assert near.sum() > 1000
    np.testing.assert_array_equal(tsdf[near] > 0, z[near] < 1.5)
