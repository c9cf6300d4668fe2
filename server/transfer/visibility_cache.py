"""Visibility cache from earlier frames (thesis 6.1.1, steps 2 and 3). Device side: include/visibility_cache.clh.

The directions are divided into k subsets, and a frame traces one of them, so k frames contain all. Each frame stores
its visibility in a layer with its camera pose; a later frame projects its samples into the k - 1 layers before it. If
no layer contains a subset, because the point was occluded, has moved or is new, it is traced at once, so that all
samples have the same number of directions.
"""

from __future__ import annotations

import numpy as np
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.input.measure import intrinsics
from server.maths.rigid import inverse_rigid
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine, KernelArgument
from server.opencl.parts import Parts


class _Buffers(StageBuffers):
    cameras = BufferDescription(cl_types.float16)
    """[k] camera_from_volume of each layer."""
    surface = BufferDescription(np.uint8)
    """Points and normals of all layers."""
    traced = BufferDescription(np.uint16)
    """[k, rows, cols] which directions a layer's sample traced."""
    blocked = BufferDescription(np.uint32)
    """[k, rows, cols, words] which of them met surface."""


class VisibilityCaches:
    """The layers of one session's last frames, on the device."""

    def __init__(self, engine: Engine, interleave: int) -> None:
        self._buffers = _Buffers(engine.workspace)
        self._interleave = interleave
        self._cameras = np.zeros((interleave, 4, 4), np.float32)
        self._asked: tuple[object, ...] = ()
        self._known = 0
        self._frame = -1
        self._lens: np.generic | None = None

    def forget(self) -> None:
        """Forget earlier frames."""
        self._known = 0

    def begin_frame(
        self,
        camera: CameraModel,
        volume_from_camera: NDArray[np.float64],
        stride: int,
        count: int,
        ray_length_m: float,
    ) -> None:
        """Open a layer for a frame seen from `volume_from_camera` [4, 4], in place of the oldest layer.

        Layers of another camera, stride, number of directions or ray length are forgotten.
        """
        asked = (camera.width, camera.height, stride, count, ray_length_m)
        known = min(self._known + 1, self._interleave) if asked == self._asked else 1
        self._asked, self._known, self._frame = asked, known, self._frame + 1
        self._shape = (camera.height // stride, camera.width // stride, -(-count // 32))
        self._lens = intrinsics(camera)
        self._cameras[self._frame % self._interleave] = inverse_rigid(volume_from_camera)

    def parameters(self) -> dict[str, object]:
        """Fields of TransferParameters."""
        k = self._interleave
        return {
            "phase": self._frame % k,
            "intrinsics": self._lens,
            "layers": self._known - 1,
            "newest": (self._frame - 1) % k,
            "cached_normals_at": self.surface.starts["normals"],
        }

    @property
    def surface(self) -> Parts:
        """`points` and `normals` of all layers, [k, rows, cols] float4."""
        shape = ((self._interleave, *self._shape[:2]), cl_types.float4)
        return self._buffers.surface.parts({"points": shape, "normals": shape})

    def buffers(self) -> tuple[KernelArgument, ...]:
        """The buffers for transfer_radiance of radiance_transfer.cl, in its order."""
        k, (rows, cols, words) = self._interleave, self._shape
        return (
            self._buffers.cameras.upload(self._cameras.reshape(k, 16).view(cl_types.float16)),
            self.surface.memory,
            self._buffers.traced.array((k, rows, cols)),
            self._buffers.blocked.array((k, rows, cols, words)),
        )


def no_caches(engine: Engine) -> tuple[KernelArgument, ...]:
    """The buffers where every frame traces every direction."""
    return engine.unused, engine.unused, engine.unused, engine.unused


NO_CACHES: dict[str, object] = {
    "phase": 0,
    "intrinsics": np.zeros(1, cl_types.float4)[0],
    "layers": 0,
    "newest": 0,
    "cached_normals_at": 0,
}
"""Fields of TransferParameters where every frame traces every direction."""
