"""What a stage launches kernels with: one session's queue, kernels, memory and times."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from server.opencl.buffers import Workspace
from server.opencl.device import Device
from server.opencl.profile import Profile
from server.opencl.program import Define, define_options

KernelArgument = cl_array.Array | np.generic | int | float | None


class Engine:
    """One command queue with everything that belongs to it. Owned by one thread."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.queue = cl.CommandQueue(device.context, properties=cl.command_queue_properties.PROFILING_ENABLE)
        self.workspace = Workspace(self.queue)
        self.profile = Profile()
        self._kernels: dict[tuple[object, ...], cl.Kernel] = {}

    @property
    def lanes(self) -> int:
        """Neighbours that a work-item of a vectorised kernel does at once (include/lanes.clh)."""
        return 1 if self.device.is_gpu else 8

    def kernel(self, file: str, name: str, **defines: Define) -> cl.Kernel:
        """Kernel `name` of `cl_kernels/<file>`; retrieved once, because a kernel object carries its arguments."""
        key = (file, name, define_options(defines))  # as text: 1, 1.0 and True are equal in Python
        if key not in self._kernels:
            self._kernels[key] = cl.Kernel(self.device.programs.get(file, defines), name)
        return self._kernels[key]

    def launch(
        self,
        kernel: cl.Kernel,
        size: tuple[int, ...],
        *arguments: KernelArgument,
        local: tuple[int, ...] | None = None,
    ) -> None:
        """Enqueue `kernel` over at least `size` work-items: rounded up to `local`, so kernels guard their range.

        Python ints become int32, floats float32; numpy scalars and vector types pass as they are.
        """
        if 0 in size:
            return
        local = local or ((64,) if len(size) == 1 else (16, 4) if len(size) == 2 else (8, 8, 1))
        rounded = tuple(-(-count // group) * group for count, group in zip(size, local, strict=True))
        event = kernel(self.queue, rounded, local, *(_argument(a) for a in arguments))
        self.profile.add_event(kernel.function_name, event)

    def download(self, array: cl_array.Array) -> NDArray[Any]:
        """Copy to the host; waits for everything queued before."""
        result: NDArray[Any] = array.get()
        return result

    def close(self) -> None:
        """Wait for the device and give its memory back."""
        self.queue.finish()
        self.workspace.release()


def _argument(value: KernelArgument) -> Any:
    if isinstance(value, cl_array.Array):
        return value.data
    if isinstance(value, bool | int):
        return np.int32(value)
    if isinstance(value, float):
        return np.float32(value)
    return value


def _vector(name: str, values: Iterable[float]) -> np.generic:
    vector: np.generic = getattr(cl_types, f"make_{name}")(*values)
    return vector


def float4(*values: float) -> np.generic:
    """A float4 kernel argument."""
    return _vector("float4", values)


def float16(matrix: NDArray[np.float64]) -> np.generic:
    """A row-major 4x4 as a float16 kernel argument."""
    return _vector("float16", np.asarray(matrix, np.float32).ravel())


def int2(*values: int) -> np.generic:
    """An int2 kernel argument."""
    return _vector("int2", values)


def int4(*values: int) -> np.generic:
    """An int4 kernel argument."""
    return _vector("int4", values)
