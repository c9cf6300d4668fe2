"""Visibility state in world space (thesis 6.1.2): voxels whose surface is known to be open need no rays.

Kernels: visibility_state.cl. A voxel is open if at least LEAST_OPEN of the directions of its samples were visible when
they were last traced. Cache validation cameras observe the volume: one from above, and one that sees the current volume
from the user's previous pose. Where their view has changed, voxels within the length of a visibility ray are
invalidated and traced again when next seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.rigid import inverse_rigid
from server.opencl.buffers import BufferDescription, BufferGroup, StageBuffers
from server.opencl.engine import Engine, float16, int4
from server.opencl.transfer import fill_bytes
from server.volume.raycast import Surface, SurfaceBuffers, raycast
from server.volume.volume import BRICK, Volume

LEAST_OPEN = 0.99
"""Surface counts as open if at least this share of its cosine-weighted sky is free. The rest bounds its error."""
CHANGE_VOXELS = 2.0
"""A surface that moved by fewer voxels has not changed: all surfaces move slightly while they are refined."""
MOST_VOXELS = 1 << 28
_FOLLOWING_PX = 160
_ABOVE_PX = 128
_ABOVE_TANGENT = 1.2  # half the field of view of the camera above
_ABOVE_HEIGHT = 0.95  # of the volume's height


class _WatchBuffers(StageBuffers):
    surface = BufferGroup(SurfaceBuffers)
    seen = BufferDescription(cl_types.float4)
    """[h, w] the surface's positions, kept from the last time."""


class _Buffers(StageBuffers):
    bits = BufferDescription(np.uint32)
    following = BufferGroup(_WatchBuffers)
    above = BufferGroup(_WatchBuffers)
    before = BufferDescription(cl_types.float4)
    """[h, w] what a camera saw the time before."""
    changed_bricks = BufferDescription(np.uint8)
    """[z, y, x] 1 where a camera sees another surface than before."""
    stale_bricks = BufferDescription(np.uint8)
    """[z, y, x] 1 for bricks near a changed one."""


@dataclass
class _Watch:
    """A validation camera and its last view."""

    buffers: _WatchBuffers
    camera: CameraModel
    volume_from_camera: NDArray[np.float64]
    seen: cl_array.Array | None = None


class VisibilityState:
    """One bit a voxel of one volume, on the device."""

    def __init__(self, engine: Engine, volume: Volume, camera: CameraModel, up: NDArray[np.float64]) -> None:
        """`up`: unit, world axes. Raises ValueError for a volume of more than MOST_VOXELS."""
        voxels = int(np.prod(volume.bricks)) * BRICK**3
        if voxels > MOST_VOXELS:
            raise ValueError(f"a visibility state of {voxels} voxels is too large: give a larger --voxel")
        self._engine, self._volume, self._buffers = engine, volume, _Buffers(engine.workspace)
        self.bits = self._buffers.bits.array((voxels // 32,))
        """[voxels / 32] bit (z ny + y) nx + x: surface in that voxel is open."""
        self._following = _Watch(self._buffers.following, _smaller(camera), np.eye(4))
        self._above = _Watch(self._buffers.above, *_camera_above(volume, up))
        self.forget()

    def forget(self) -> None:
        """Forget all open voxels."""
        fill_bytes(self._engine.queue, self.bits, 0)

    def validate(self, volume_from_camera: NDArray[np.float64], ray_length_m: float) -> NDArray[np.bool_]:
        """Forget what lies within `ray_length_m` of where the volume has changed since the last call.

        `volume_from_camera`: of the user's camera now. Returns [z, y, x] the bricks that were forgotten.
        """
        changed = self._buffers.changed_bricks.array(self._volume.bricks[::-1])
        fill_bytes(self._engine.queue, changed, 0)
        for watch in (self._above, self._following):
            self._compare(watch, changed)
        self._following.volume_from_camera = volume_from_camera
        self._look(self._following)
        stale = _grown(self._engine.download(changed) > 0, ray_length_m / (BRICK * self._volume.voxel_m))
        if stale.any():
            x, y, z = self._volume.bricks
            self._engine.launch(
                self._engine.kernel("visibility_state.cl", "clear_bricks"),
                (x, BRICK * y, BRICK * z),
                int4(x, y, z, 0),
                self._buffers.stale_bricks.upload(stale.astype(np.uint8)),
                self.bits,
            )
        return stale

    def learn(self, surface: Surface, camera: CameraModel, stride: int, openness: cl_array.Array) -> None:
        """Update the voxels from the openness [rows, cols] of a transfer's samples."""
        rows, cols = openness.shape
        for value in (1, 0):
            self._engine.launch(
                self._engine.kernel("visibility_state.cl", "mark_samples"),
                (cols, rows),
                cols,
                rows,
                stride,
                camera.width,
                surface.positions,
                surface.labels,
                openness,
                LEAST_OPEN,
                int4(*self._volume.bricks, 0),
                self._volume.voxel_m,
                value,
                self.bits,
            )

    def _look(self, watch: _Watch) -> cl_array.Array:
        """[h, w] float4 the current view of `watch`, which becomes its last view."""
        view = raycast(self._engine, watch.camera, watch.volume_from_camera, self._volume, watch.buffers.surface)
        shape = (watch.camera.height, watch.camera.width)
        watch.seen = watch.buffers.seen.array(shape)
        self._engine.copy_into(watch.seen, 0, view.positions)
        return watch.seen

    def _compare(self, watch: _Watch, changed: cl_array.Array) -> None:
        if watch.seen is None:
            if watch is self._above:
                self._look(watch)
            return
        before = self._buffers.before.array(watch.seen.shape)
        self._engine.copy_into(before, 0, watch.seen)
        self._engine.launch(
            self._engine.kernel("visibility_state.cl", "compare_views"),
            (watch.camera.width, watch.camera.height),
            watch.camera.width,
            watch.camera.height,
            before,
            self._look(watch),
            float16(inverse_rigid(watch.volume_from_camera)),
            CHANGE_VOXELS * self._volume.voxel_m,
            int4(*self._volume.bricks, 0),
            self._volume.voxel_m,
            changed,
        )


def _smaller(camera: CameraModel) -> CameraModel:
    """The same view in at most _FOLLOWING_PX columns."""
    step = max(1, -(-camera.width // _FOLLOWING_PX))
    center = (step - 1) / 2
    return CameraModel(
        width=max(8, camera.width // step),
        height=max(8, camera.height // step),
        fx=camera.fx / step,
        fy=camera.fy / step,
        cx=(camera.cx - center) / step,
        cy=(camera.cy - center) / step,
    )


def _camera_above(volume: Volume, up: NDArray[np.float64]) -> tuple[CameraModel, NDArray[np.float64]]:
    """A wide camera near the top of the volume that looks down; and its volume_from_camera."""
    size = np.array(volume.bricks) * BRICK * volume.voxel_m
    height = np.abs(up) @ size
    down = -up / np.linalg.norm(up)
    side = np.cross(down, np.eye(3)[np.argmin(np.abs(down))])
    side /= np.linalg.norm(side)
    volume_from_camera = np.eye(4)
    volume_from_camera[:3, :3] = np.stack([side, np.cross(down, side), down], axis=1)
    volume_from_camera[:3, 3] = size / 2 - down * (_ABOVE_HEIGHT - 0.5) * height
    focal, center = _ABOVE_PX / 2 / _ABOVE_TANGENT, (_ABOVE_PX - 1) / 2
    camera = CameraModel(width=_ABOVE_PX, height=_ABOVE_PX, fx=focal, fy=focal, cx=center, cy=center)
    return camera, volume_from_camera


def _grown(bricks: NDArray[np.bool_], reach: float) -> NDArray[np.bool_]:
    """[z, y, x] all bricks within a ray of `reach` bricks of one of `bricks`."""
    if not bricks.any():
        return bricks
    steps = int(np.ceil(reach))
    grown = bricks
    for axis in range(3):
        places = np.cumsum(np.insert(grown, 0, False, axis=axis), axis=axis, dtype=np.int32)
        index = np.arange(bricks.shape[axis])
        last = np.take(places, np.minimum(index + steps + 1, len(index)), axis=axis)
        grown = last > np.take(places, np.maximum(index - steps, 0), axis=axis)
    return grown
