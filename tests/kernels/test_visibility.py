"""All visibility rays of a point at once: the boxes of what may block them, and the rays, against their twins."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.opencl.program import with_headers
from server.opencl.structs import struct_text
from server.transfer.radiance_transfer import direction_sets
from server.transfer.visibility import trace_visibility
from server.volume.brick_table import AWAY_SLOT
from server.volume.volume import Volume
from tests.reference import visibility as twin
from tests.reference.radiance_transfer import direction_set
from tests.scenes.lanes import KINDS
from tests.scenes.lights import random_directions
from tests.scenes.own_kernel import own_kernel
from tests.scenes.solids import SCENES, SIDE_M, fill_volume, float4, points_on, scattered, solid_voxels, upload_surface
from tests.scenes.volumes import vectors

VOXEL_M = 0.01
ROOM_M = 1000.0
MOST_BOXES = 16
"""As in blockers.clh."""
BOXES = """
#include "blockers.clh"
kernel void boxes(VOLUME_PARAMETERS, const int count, global const float4 *origins,
                  global const float4 *normals, const float reach, global float4 *low, global float4 *high) {
    const int i = get_global_id(0);
    if (i >= count) return;
    const Volume volume = VOLUME_OF_PARAMETERS;
    Blockers boxes;
    find_blockers(volume, origins[i].xyz, normals[i].xyz, reach, &boxes);
    for (int k = 0; k < MOST_BOXES; k++) {
        low[i * MOST_BOXES + k] = k < boxes.count ? (float4)(origins[i].xyz + boxes.low[k], 1.0f) : (float4)(0.0f);
        high[i * MOST_BOXES + k] = k < boxes.count ? (float4)(origins[i].xyz + boxes.high[k], 1.0f) : (float4)(0.0f);
    }
}
"""

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def boxes_of(
    device: Device, engine: Engine, volume: Volume, origins: Floats, normals: Floats, reach: float
) -> list[tuple[Floats, Floats]]:
    """Lower and upper corners [boxes, 3] of each point's boxes; voxels."""
    kernel = own_kernel(device, struct_text() + with_headers(BOXES, "boxes.cl"), "boxes")
    space, count = engine.workspace, len(origins)
    inputs = [space.upload(f"box_{k}", float4(a)) for k, a in enumerate((origins, normals))]
    outputs = [space.upload(f"box_{name}", float4(np.zeros((count, MOST_BOXES, 3)))) for name in ("low", "high")]
    engine.launch(kernel, (count,), *volume.arguments(), count, *inputs, reach, *outputs)
    low, high = (vectors(engine.download(a)).astype(np.float64) for a in outputs)
    used = low[..., 3] > 0
    return [(low[i, used[i], :3], high[i, used[i], :3]) for i in range(count)]


def assert_boxes(
    solid: Bools, found: list[tuple[Floats, Floats]], origins: Floats, normals: Floats, reach: float
) -> None:
    """The twin's, a brick each, the last ones joined; but for voxels that touch the plane."""
    for (low, high), origin, normal in zip(found, origins, normals, strict=True):
        fewer, more = (twin.find_blockers(solid, origin, normal, reach, margin) for margin in (-2e-3, 2e-3))
        assert min(len(fewer), MOST_BOXES) <= len(low) <= min(len(more), MOST_BOXES)
        for box in fewer:
            assert ((low <= box[0] + 1e-4) & (high >= box[1] - 1e-4)).all(1).any()
        for corner, other in zip(low[: MOST_BOXES - 1], high, strict=False):
            assert any((box[0] <= corner + 1e-4).all() and (box[1] >= other - 1e-4).all() for box in more)
        if len(low) == MOST_BOXES:
            rest = np.array(more)
            assert (low[-1] >= rest[:, 0].min(0) - 1e-4).all()
            assert (high[-1] <= rest[:, 1].max(0) + 1e-4).all()


@pytest.mark.parametrize("share", [0.0, 0.0003, 0.01])
@pytest.mark.parametrize("reach", [0.5, 3.7, 12.8, 16.0])
def test_boxes_of_scattered_voxels_are_the_twins(device: Device, engine: Engine, share: float, reach: float) -> None:
    volume, solid = scattered(engine, share, VOXEL_M, np.random.default_rng(15))
    normals = random_directions(60, 4)
    normals[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    normals[6:12] = normals[:6] - 1e-10  # as good as along an axis, and falling along the others
    origins = np.random.default_rng(2).uniform(-3, SIDE_M / VOXEL_M + 3, (60, 3)).astype(np.float32).astype(np.float64)
    found = boxes_of(device, engine, volume, origins, normals.astype(np.float32).astype(np.float64), reach)
    assert_boxes(solid, found, origins, normals, reach)
    counts = np.array([len(low) for low, _ in found])
    assert (counts == 0).any() or (share == 0.01 and reach > 3)
    assert (counts > 0).any() or share == 0.0 or reach < 10
    assert (counts == MOST_BOXES).any() or share < 0.01 or reach < 10


def released(engine: Engine) -> tuple[Volume, Bools]:
    """Scattered voxels whose bricks are all away, and what is known of them: cells of 2x2x2 voxels, [z, y, x]."""
    volume, solid = scattered(engine, 0.0003, VOXEL_M, np.random.default_rng(15))
    volume.slots_device.set(np.full_like(engine.download(volume.slots_device), AWAY_SLOT), engine.queue)
    cells = solid.reshape(*(n for size in solid.shape for n in (size // 2, 2))).any((1, 3, 5))
    return volume, cells.repeat(2, 0).repeat(2, 1).repeat(2, 2)


def test_boxes_of_released_bricks_are_those_of_cells(device: Device, engine: Engine) -> None:
    """Their octets are the common slot's, all solid: only their cells count."""
    volume, whole = released(engine)
    normals = random_directions(60, 5).astype(np.float32).astype(np.float64)
    origins = np.random.default_rng(3).uniform(0, SIDE_M / VOXEL_M, (60, 3)).astype(np.float32).astype(np.float64)
    assert_boxes(whole, boxes_of(device, engine, volume, origins, normals, 12.0), origins, normals, 12.0)


def visibility_of(
    engine: Engine, volume: Volume, points: Floats, normals: Floats, rays: int, ray_length_m: float
) -> tuple[Bools, Bools, Floats, Floats]:
    """Of points, 8 in a row: free and blocked [rows, 8, rays], origins and directions [rows, 8, rays, 3]."""
    points, normals = (a.reshape(-1, 8, 3).astype(np.float32).astype(np.float64) for a in (points, normals))
    camera = CameraModel(width=8, height=len(points), fx=10.0, fy=10.0, cx=0.0, cy=0.0)
    surface = upload_surface(engine, points, normals, np.ones(points.shape[:2], bool))
    sets = direction_sets(rays, 2)
    found = trace_visibility(engine, camera, volume, surface, 1, sets, ray_length_m)
    free, blocked = (
        np.unpackbits(engine.download(a).view(np.uint8), axis=-1, bitorder="little")
        for a in (found.free, found.blocked)
    )
    assert not free[..., rays:].any()
    assert not blocked[..., rays:].any()
    directions = sets.directions.astype(np.float64)[direction_set(*np.indices(points.shape[:2])), :, :3]
    origins = np.broadcast_to((points + VOXEL_M * normals)[:, :, None], directions.shape)
    return free[..., :rays].astype(bool), blocked[..., :rays].astype(bool), origins, directions


@KINDS
@pytest.mark.parametrize("name", [*SCENES, "scattered"])
@pytest.mark.parametrize(("rays", "ray_length_m"), [(81, ROOM_M), (81, 0.25), (81, 0.1), (30, ROOM_M)])
def test_rays_are_the_twins(device: Device, kind: type[Engine], name: str, ray_length_m: float, rays: int) -> None:
    engine = kind(device)
    if name == "scattered":
        volume, solid = scattered(engine, 0.0005, VOXEL_M, np.random.default_rng(15))
        points, normals = np.random.default_rng(6).uniform(-0.1, 1.06, (512, 3)), random_directions(512, 16)
    else:
        volume = fill_volume(engine, SCENES[name], VOXEL_M)
        points, normals = points_on(SCENES[name], 256, 2)
        solid = solid_voxels(SCENES[name], volume)
    free, blocked, origins, directions = visibility_of(engine, volume, points, normals, rays, ray_length_m)
    assert not (free & blocked).any()
    height = (directions * (origins - points.reshape(-1, 8, 1, 3)) / VOXEL_M).sum(-1)
    assert (free | blocked)[height > 1e-4].all()
    assert not (free | blocked)[height < -1e-4].any()
    traced = free | blocked
    exact = twin.trace_volume(solid, VOXEL_M, origins[traced], directions[traced], ray_length_m)
    # Steps go a hundredth of a voxel beyond what is empty and miss clipped corners; what they find, is there.
    assert (free[traced] & ~exact).mean() < 0.001  # seen: 0.0003
    assert name != "scattered" or (free[traced] & ~exact).sum() < 0.04 * (~exact).sum()
    assert (blocked[traced] & exact).mean() < 1e-3  # origins in float32, and the last sample at `ray_length_m`
    assert ray_length_m == 0.1 or (~exact).mean() > 0.01
    engine.close()


@KINDS
def test_rays_meet_cells_of_released_bricks(device: Device, kind: type[Engine]) -> None:
    engine = kind(device)
    volume, whole = released(engine)
    points = np.random.default_rng(9).uniform(0, SIDE_M, (256, 3))
    free, blocked, origins, directions = visibility_of(engine, volume, points, random_directions(256, 10), 81, 0.25)
    traced = free | blocked
    exact = twin.trace_volume(whole, VOXEL_M, origins[traced], directions[traced], 0.25)
    assert (~exact).mean() > 0.01
    assert (free[traced] & ~exact).sum() < 0.04 * (~exact).sum()  # clipped corners, as above
    assert (blocked[traced] & exact).mean() < 1e-3
    engine.close()


def test_rays_without_length_are_free(engine: Engine) -> None:
    """Even where they begin in a solid voxel."""
    volume, _ = scattered(engine, 0.5, VOXEL_M, np.random.default_rng(15))
    points = np.random.default_rng(7).uniform(0, SIDE_M, (64, 3))
    free, blocked, _, _ = visibility_of(engine, volume, points, random_directions(64, 8), 81, 0.0)
    assert not blocked.any()
    assert 0.45 < free.mean() < 0.55


def test_nothing_is_traced_where_there_is_no_surface(engine: Engine) -> None:
    volume = fill_volume(engine, SCENES["ball above a floor"], VOXEL_M)
    surface = upload_surface(
        engine, np.full((8, 8, 3), 0.5), np.tile([0.0, 1.0, 0.0], (8, 8, 1)), np.zeros((8, 8), bool)
    )
    camera = CameraModel(width=8, height=8, fx=10.0, fy=10.0, cx=0.0, cy=0.0)
    found = trace_visibility(engine, camera, volume, surface, 1, direction_sets(81, 2), 0.1)
    assert not engine.download(found.free).any()
    assert not engine.download(found.blocked).any()
