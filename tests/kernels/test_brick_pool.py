"""The pool of bricks: its kernels only copy, so results are exact."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyopencl.cltypes as cl_types
import pytest
from numpy.typing import NDArray

from server.opencl.engine import Engine, KernelArgument
from server.volume.brick_pool import BRICK_VOXELS, BrickPool
from server.volume.brick_table import AWAY_SLOT, NO_SLOT
from server.volume.bricks import less_weight
from tests.reference import brick_pool as twin
from tests.scenes.volumes import vectors

SLOTS = 70


def random_pool(rng: np.random.Generator, rows: int = SLOTS) -> tuple[NDArray[Any], NDArray[Any]]:
    """tsdf and weight [rows, 512, 2] and colours [rows, 512]."""
    voxels = rng.uniform(-1, 1, (rows, BRICK_VOXELS, 2)).astype(np.float32)
    return voxels, rng.integers(0, 2**32, (rows, BRICK_VOXELS), np.uint32)


def as_pairs(voxels: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(voxels).view(cl_types.float2)[..., 0]


def launch(engine: Engine, name: str, items: int, count: int, *arguments: KernelArgument) -> None:
    engine.launch(engine.kernel("brick_pool.cl", name), (items * count,), count, *arguments)


@pytest.mark.parametrize("count", [1, 3, 64])
def test_kernels_match_their_twins(engine: Engine, count: int) -> None:
    rng, upload = np.random.default_rng(count), engine.workspace.upload
    voxels, colors = random_pool(rng)
    slots = rng.permutation(SLOTS)[:count].astype(np.int32)
    device = {"voxels": upload("v", as_pairs(voxels)), "colors": upload("c", colors), "slots": upload("s", slots)}

    other_voxels, other_colors = random_pool(rng)
    places = rng.permutation(SLOTS)[:count].astype(np.int32)
    target = upload("tv", as_pairs(other_voxels)), upload("tc", other_colors)
    source = device["slots"], device["voxels"], device["colors"]
    launch(engine, "copy_bricks", 64, count, *source, upload("places", places), *target)
    np.testing.assert_array_equal(
        vectors(engine.download(target[0])), twin.copy_bricks(voxels, slots, other_voxels, places)
    )
    np.testing.assert_array_equal(engine.download(target[1]), twin.copy_bricks(colors, slots, other_colors, places))


@pytest.mark.parametrize("share", [0.0, 1 / 3, 1.0])
def test_forgetting_colors_matches_its_twin(engine: Engine, share: float) -> None:
    """On the device and on the host; at 1 colours stay, of no weight."""
    pool = BrickPool(engine)
    pool.grow(SLOTS)
    _, colors = random_pool(np.random.default_rng(4), SLOTS + 1)
    colors[:, ::5] = 0
    pool.colors.set(colors)
    pool.forget_colors(share)
    wanted = twin.forget_colors(colors, share)
    np.testing.assert_array_equal(engine.download(pool.colors), wanted)
    np.testing.assert_array_equal(less_weight(colors, share), wanted)
    assert (wanted >> 6 == colors >> 6).all()
    assert share < 1 or set(np.unique(wanted & 63)) == {0, 1}


@pytest.mark.parametrize("clears", [False, True])
def test_placing_matches_its_twin(engine: Engine, clears: bool) -> None:
    rng, upload = np.random.default_rng(1), engine.workspace.upload
    table, solid = rng.integers(-1, 50, 300).astype(np.int32), rng.integers(0, 2**63, 300, np.uint64)
    voxels, colors = random_pool(rng)
    bricks = rng.permutation(300)[:130].astype(np.int32)
    least = AWAY_SLOT + 1 if clears else NO_SLOT
    slots = rng.choice(np.arange(least, least + SLOTS), 130).astype(np.int32) % SLOTS
    if not clears:
        slots[::3] = NO_SLOT
    listed = upload("listed", np.concatenate([np.full(7, -9, np.int32), bricks, slots]))
    device = upload("table", table), upload("solid", solid), upload("v", as_pairs(voxels)), upload("c", colors)
    launch(engine, "place_bricks", 64, 130, clears, 7, listed, *device)
    if clears:
        voxels, colors = twin.clear_slots(slots, voxels, colors)
    for found, wanted in zip(device[:2], twin.place_bricks(bricks, slots, table, solid), strict=True):
        np.testing.assert_array_equal(engine.download(found), wanted)
    np.testing.assert_array_equal(vectors(engine.download(device[2])), voxels)
    np.testing.assert_array_equal(engine.download(device[3]), colors)


def test_bricks_survive_growth_and_the_way_to_the_host_and_back(engine: Engine) -> None:
    rng = np.random.default_rng(2)
    pool = BrickPool(engine)
    pool.grow(40)
    voxels, colors = random_pool(rng, 40)
    first = np.arange(1, 41, dtype=np.int32)
    pool.upload(first, as_pairs(voxels), colors)
    pool.grow(3000)
    assert pool.capacity == 3000
    slots = rng.permutation(np.arange(41, 3001, dtype=np.int32))[:1500]  # more than one batch
    more_voxels, more_colors = random_pool(rng, 1500)
    pool.upload(slots, as_pairs(more_voxels), more_colors)
    everything = np.concatenate([slots, first])
    found = list(pool.download(everything))
    assert len(found) > 1
    assert np.array_equal(np.concatenate([everything[batch] for batch, _, _ in found]), everything)
    found_voxels = np.concatenate([batch for _, batch, _ in found]).view(np.float32).reshape(-1, BRICK_VOXELS, 2)
    np.testing.assert_array_equal(found_voxels, np.concatenate([more_voxels, voxels]))
    np.testing.assert_array_equal(np.concatenate([batch for _, _, batch in found]), [*more_colors, *colors])
    assert not vectors(engine.download(pool.voxels)[AWAY_SLOT]).any()
    assert (engine.download(pool.octets)[AWAY_SLOT] == 255).all()
