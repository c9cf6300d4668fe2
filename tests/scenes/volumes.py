"""Device volumes as dense host arrays and back, for comparison with twins."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import ArrayLike, NDArray

from protocol.frames import CameraModel, RgbdFrame
from server.geometry.merge import merge_depth
from server.input.measure import Measurement, measure
from server.opencl.engine import Engine
from server.volume.brick_pool import BRICK_VOXELS
from server.volume.brick_table import AWAY_SLOT, BRICK
from server.volume.integrate import integrate
from server.volume.raycast import LABEL_NONE, LABEL_STATIC, Surface, raycast
from server.volume.volume import Volume
from tests.scenes.analytic import Floats


def vectors(array: NDArray[Any]) -> NDArray[np.float32]:
    """[..., n] float32 components of an array of OpenCL float vectors."""
    return array.view(np.float32).reshape(*array.shape, -1)


def dense_voxels(engine: Engine, volume: Volume) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """tsdf, weight and whether allocated, each [z, y, x] over the whole volume; never seen voxels are (1, 0)."""
    slots = engine.download(volume.slots_device)
    pool = vectors(engine.download(volume.voxels)).reshape(-1, BRICK, BRICK, BRICK, 2)
    bricks = pool[np.maximum(slots, AWAY_SLOT)]  # of which no voxel was ever seen
    dense = bricks.transpose(0, 3, 1, 4, 2, 5, 6).reshape(*(np.array(slots.shape) * BRICK), 2)
    allocated = np.kron(slots > AWAY_SLOT, np.ones((BRICK,) * 3, bool)).astype(bool)
    return np.where(dense[..., 1] > 0, dense[..., 0], 1), dense[..., 1], allocated


def dense_colors(volume: Volume) -> tuple[Floats, Floats]:
    """Linear RGB [z, y, x, 3] and colour weight [z, y, x], 0 where no brick is."""
    x, y, z = (8 * count for count in volume.bricks)
    colors, count = np.zeros((z, y, x, 3)), np.zeros((z, y, x))
    bricks = volume.download_bricks()
    for (bx, by, bz), color, weight in zip(bricks.indices * 8, bricks.colors, bricks.color_weight, strict=True):
        colors[bz : bz + 8, by : by + 8, bx : bx + 8] = color
        count[bz : bz + 8, by : by + 8, bx : bx + 8] = weight
    return colors, count


def in_bricks(dense: NDArray[Any]) -> NDArray[Any]:
    """[bricks, 512] of an array [z, y, x], bricks in table order."""
    z, y, x = (size // BRICK for size in dense.shape)
    return dense.reshape(z, BRICK, y, BRICK, x, BRICK).transpose(0, 2, 4, 1, 3, 5).reshape(-1, BRICK_VOXELS)


def allocate_everywhere(volume: Volume) -> None:
    """Allocate every brick, as far as the budget has room; new ones were never seen."""
    missing = np.setdiff1d(np.arange(np.prod(volume.bricks), dtype=np.int32), volume.places())
    shape = len(missing), BRICK_VOXELS
    volume.fill([(missing, np.zeros(shape, cl_types.float2), np.zeros(shape, np.uint32))], volume.frames)


def renew_tables(volume: Volume) -> None:
    """After voxels were written by hand: every brick counts as changed, and the tables for rays are computed anew."""
    residency = volume._residency
    residency._note_change(residency._table.resident())
    volume._tables.find_solid(volume.allocated_device, volume.allocated_bricks, volume.slots_device, residency.pool)
    volume.update_tables()


def fill(engine: Engine, volume: Volume, tsdf: Floats, weight: Floats) -> None:
    """Put tsdf and weight [z, y, x] into the volume, every brick allocated."""
    allocate_everywhere(volume)
    slots = engine.download(volume.slots_device).ravel()
    pool = engine.download(volume.voxels)
    pairs = np.stack([in_bricks(tsdf), in_bricks(weight)], axis=-1).astype(np.float32)
    pool[slots] = np.ascontiguousarray(pairs).view(cl_types.float2)[..., 0]
    volume.voxels.set(pool, engine.queue)
    renew_tables(volume)


def upload_depth(engine: Engine, depth_m: NDArray[Any]) -> cl_array.Array:
    """A depth picture [h, w] in metres on the device."""
    return engine.workspace.upload("test_depth", depth_m.astype(np.float32))


def upload_measurement(engine: Engine, depth_m: NDArray[Any], radiance: NDArray[Any] | None = None) -> Measurement:
    """A rectified picture on the device: depth [h, w] metres and linear RGB [h, w, 3], mid grey without one."""
    color = np.full((*depth_m.shape, 3), 0.5) if radiance is None else radiance
    usable = np.concatenate([color, np.ones((*depth_m.shape, 1))], axis=-1).astype(np.float32)
    device_radiance = engine.workspace.upload("test_radiance", usable.view(cl_types.float4)[..., 0])
    return Measurement(device_radiance, upload_depth(engine, depth_m))


def fuse(
    engine: Engine,
    volume: Volume,
    camera: CameraModel,
    world_from_camera: Floats,
    depth_m: NDArray[Any],
    radiance: NDArray[Any] | None = None,
) -> None:
    """Allocate and integrate one picture: depth [h, w] metres and linear RGB [h, w, 3], mid grey without one."""
    pose = volume.volume_from_world() @ world_from_camera
    measurement = upload_measurement(engine, depth_m, radiance)
    volume.allocate(camera, pose, measurement.depth_m)
    integrate(engine, volume, camera, pose, measurement)


def fuse_frame(engine: Engine, volume: Volume, camera: CameraModel, frame: RgbdFrame) -> tuple[Floats, Measurement]:
    """Allocate and integrate a frame where it says that it was taken; its volume_from_camera and rectified picture."""
    assert frame.world_from_camera is not None
    pose = volume.volume_from_world() @ frame.world_from_camera
    measurement = measure(engine, camera, frame)
    volume.allocate(camera, pose, measurement.depth_m)
    integrate(engine, volume, camera, pose, measurement)
    return pose, measurement


def seen_surface(
    engine: Engine, volume: Volume, camera: CameraModel, pose: Floats, labels: ArrayLike | None = None
) -> Surface:
    """The geometry buffer of a camera that sees the volume alone: all of it is static, unless labels are given."""
    model = raycast(engine, camera, pose, volume)
    if labels is None:
        labels = np.where(vectors(engine.download(model.positions))[..., 3] > 0, LABEL_STATIC, LABEL_NONE)
    whole = np.ascontiguousarray(np.broadcast_to(np.asarray(labels, np.uint8), (camera.height, camera.width)))
    return Surface(model.positions, model.normals, engine.workspace.upload("test_labels", whole))


def merged_surface(
    engine: Engine, volume: Volume, camera: CameraModel, pose: Floats, measurement: Measurement
) -> Surface:
    """The geometry buffer of a frame that was fused: what the volume shows, and what the sensor alone knows."""
    return merge_depth(engine, camera, pose, measurement, raycast(engine, camera, pose, volume), volume)


def cast(
    engine: Engine, volume: Volume, camera: CameraModel, world_from_camera: Floats
) -> tuple[NDArray[np.bool_], Floats, Floats]:
    """Hits [h, w], their depth along the optical axis [h, w] and normals [h, w, 3], of the volume alone."""
    pose = volume.volume_from_world() @ world_from_camera
    surface = raycast(engine, camera, pose, volume)
    position = vectors(engine.download(surface.positions)).astype(np.float64)
    normal = vectors(engine.download(surface.normals)).astype(np.float64)
    assert np.isfinite(position).all()
    assert np.isfinite(normal).all()
    np.testing.assert_array_equal(position[..., 3], normal[..., 3])
    hit = position[..., 3] == 1
    assert not position[~hit].any()
    depth = (position[..., :3] - pose[:3, 3]) @ pose[:3, 2]
    return hit, np.where(hit, depth, 0), normal[..., :3]
