"""What a stage launches kernels with: a queue, kernels, memory and times."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable
from typing import Any, TypeVar, cast

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import DTypeLike, NDArray

from server.opencl.buffers import BufferDescription, Group, StageBuffers, Workspace
from server.opencl.compiling import SMALL_GRID, Launch
from server.opencl.device import Device
from server.opencl.pacing import Pacer, Size
from server.opencl.pending_read import PendingRead
from server.opencl.profile import Profile
from server.opencl.program import Define
from server.opencl.read_page import ReadPage

State = TypeVar("State")
_FLOATS, _INTS, _TWO_INTS = (struct.Struct(of) for of in ("<4f", "<4i", "<2i"))
KernelArgument = cl_array.Array | np.generic | int | float | None


class _UnusedBuffers(StageBuffers):
    one = BufferDescription(cl_types.float4)


class Engine:
    """One command queue with everything that belongs to it. Owned by one thread at a time."""

    def __init__(self, device: Device, beside: Engine | None = None, *, has_own_queue: bool = False) -> None:
        """`beside`: another engine, whose queue, kernels and times this one shares; its memory is its own, but for
        `array_to_read`. What either does, it does after all that both were asked for before; `has_own_queue`: it waits
        for the other only where `wait_for` says so."""
        self.device = device
        self.queue: cl.CommandQueue = beside.queue if beside and not has_own_queue else _make_queue(device)
        self.profile: Profile = beside.profile if beside else Profile()
        self.workspace = Workspace(self.queue, self.profile)
        device.memory.add(self.workspace)
        self._read_page: ReadPage = (
            beside._read_page if beside and not has_own_queue else ReadPage(self.workspace, self.profile)
        )
        self.pacer: Pacer = beside.pacer if beside else Pacer(times=device.step_times)
        self._kernels: dict[tuple[object, ...], cl.Kernel] = beside._kernels if beside else {}
        self._typed: dict[int, tuple[cl.Kernel, str]] = beside._typed if beside else {}
        self._made_from: dict[int, tuple[str, dict[str, Define]]] = beside._made_from if beside else {}
        """File and defines of each kernel."""
        self._launched: set[tuple[object, ...]] = beside._launched if beside else set()
        self._states: dict[type[Any], Any] = {}
        self._buffers: dict[type[StageBuffers], StageBuffers] = {}
        self._concurrent: Engine | None = None

    def finish(self) -> None:
        """Wait until all that was asked for is done."""
        self.queue.finish()
        if self._concurrent is not None:
            self._concurrent.finish()
        self.pacer.settle()

    @property
    def concurrent(self) -> Engine:
        """For work that need not wait for what this engine was asked for: it runs while this one's goes on."""
        if self._concurrent is None:
            self._concurrent = type(self)(self.device, beside=self, has_own_queue=True)
        return self._concurrent

    def mark(self) -> cl.Event:
        """An event that completes with all that was asked for so far; another queue can wait for it."""
        event = cl.enqueue_marker(self.queue)
        self.queue.flush()
        return event

    def wait_for(self, event: cl.Event) -> None:
        """What is asked for from now on begins after `event`. The host does not wait."""
        if event.command_execution_status != cl.command_execution_status.COMPLETE:
            cl.enqueue_barrier(self.queue, [event])

    @property
    def bytes_held(self) -> int:
        """Device memory of all buffers."""
        return self.workspace.bytes_held + (self._concurrent.bytes_held if self._concurrent else 0)

    @property
    def lanes(self) -> int:
        """Neighbours that a work-item of a vectorised kernel does at once (include/lanes.clh)."""
        return 1 if self.device.is_gpu else 8

    @property
    def sharers(self) -> int:
        """Work-items that share the directions of a sample, where it has many (include/sharers.clh)."""
        return 32 if self.device.is_gpu else 1

    def kernel(self, file: str, name: str, **defines: Define) -> cl.Kernel:
        """Kernel `name` of the kernel file `file`; retrieved once, because a kernel object carries its arguments."""
        key = (file, name, *defines.items(), *map(type, defines.values()))  # 1, 1.0 and True are equal in Python
        kernel = self._kernels.get(key)
        if kernel is None:
            in_order = dict(sorted(defines.items()))
            if list(in_order) != list(defines):
                kernel = self.kernel(file, name, **in_order)
            else:
                kernel = cl.Kernel(self._program(file, defines), name)
                self._made_from[id(kernel)] = file, defines
            self._kernels[key] = kernel
        return kernel

    def _program(self, file: str, defines: dict[str, Define]) -> cl.Program:
        if self.device.programs.has(file, defines):
            return self.device.programs.get(file, defines)
        with self.pacer.aside():
            if self.device.compiler is not None:
                self.device.compiler.compile(file, defines)
            return self.device.programs.get(file, defines)

    def launch(
        self,
        kernel: cl.Kernel,
        size: tuple[int, ...],
        *arguments: KernelArgument,
        local: tuple[int, ...] | None = None,
        steps: int = 1,
    ) -> None:
        """Enqueue `kernel` over at least `size` work-items: rounded up to `local`, so kernels guard their range.

        Python ints become int32, floats float32; numpy scalars and vector types pass as they are. `steps`: what a
        work-item does at most, such as the number of its rays: a long launch is cut by it (pacing.py).
        """
        if 0 in size:
            return
        local = local or ((64,) if len(size) == 1 else (16, 4) if len(size) == 2 else (8, 8, 1))
        rounded = tuple(-(-count // group) * group for count, group in zip(size, local, strict=True))
        if id(kernel) not in self._typed:  # without types each number takes pyopencl as long as a launch
            kernel.set_arg_types([_type_of(value) for value in arguments])
            self._typed[id(kernel)] = kernel, kernel.function_name
        passed: list[Any] = [a.data if isinstance(a, cl_array.Array) else a for a in arguments]
        _, name = self._typed[id(kernel)]
        self.profile.launches += 1
        for offset, part in self.pacer.slices(name, rounded, local, steps):
            shift = offset if any(offset) else None
            variant = (id(kernel), local, shift is None, max(part) < SMALL_GRID)
            if variant in self._launched:
                event = kernel(self.queue, part, local, *passed, global_offset=shift)
            else:
                event = self._first_launch(kernel, part, local, passed, shift)
                self._launched.add(variant)
            self.pacer.enqueued(name, math.prod(part), steps, event)
            self.profile.add_event(name, event)

    def _first_launch(
        self, kernel: cl.Kernel, part: Size, local: Size, passed: list[Any], shift: Size | None
    ) -> cl.Event:
        """The first launch of its kind. A driver may compile for it: others have the device meanwhile."""
        compiler, made_from = self.device.compiler, self._made_from.get(id(kernel))
        if compiler is None or made_from is None:
            with self.pacer.aside():
                return kernel(self.queue, part, local, *passed, global_offset=shift)
        launch = Launch(self._typed[id(kernel)][1], part, local, shift, tuple(map(_described, passed)))
        if not compiler.knows(*made_from, launch):
            with self.pacer.aside():
                compiler.compile(*made_from, launch)
        return kernel(self.queue, part, local, *passed, global_offset=shift)

    def state(self, kind: type[State]) -> State:
        """The one instance of `kind` that belongs to this engine, made on first use: what a stage keeps of the frame
        before, beside its buffers."""
        if kind not in self._states:
            self._states[kind] = kind()
        return cast(State, self._states[kind])

    def buffers(self, kind: type[Group]) -> Group:
        """The buffers of a stage that belong to this engine, made on first use."""
        if kind not in self._buffers:
            self._buffers[kind] = kind(self.workspace)
        return cast(Group, self._buffers[kind])

    @property
    def unused(self) -> cl_array.Array:
        """For a kernel argument that the kernel, as it is compiled, does not read."""
        return self.buffers(_UnusedBuffers).one.array((1,))

    def fill(self, array: cl_array.Array, value: float) -> None:
        """Set all elements of `array`. Not a kernel, as `array.fill` is: a tenth of the host's time."""
        if array.size:
            assert isinstance(array.base_data, cl.MemoryObjectHolder)
            pattern = array.dtype.type(value)
            cl.enqueue_fill_buffer(self.queue, array.base_data, pattern, array.offset, array.nbytes)

    def download(self, array: cl_array.Array) -> NDArray[Any]:
        """Copy to the host; waits for everything queued before."""
        result: NDArray[Any] = self.begin_download(array).result(is_counted=True)
        return result

    def begin_download(self, array: cl_array.Array) -> PendingRead:
        """The same without waiting: the host goes on while the device works. What is in an `array_to_read` is copied
        with others, when the first of them is needed or `send_reads` is called."""
        return self._read_page.begin(array) or PendingRead(self.queue, array, self.profile)

    def array_to_read(self, shape: tuple[int, ...], dtype: DTypeLike) -> cl_array.Array:
        """Memory for what the host will read of this frame; its contents are undefined. The next frame writes it
        again (`Profile.begin`)."""
        return self._read_page.array(shape, dtype)

    def send_reads(self) -> None:
        """Begin to copy all downloads that were begun, before more work is asked for that they need not wait for."""
        self._read_page.send()

    def copy_into(self, whole: cl_array.Array, start: int, part: cl_array.Array) -> None:
        """Copy all of `part` into `whole`, from its byte `start` on. Not a kernel, as that of pyopencl's arrays."""
        if part.nbytes:
            self.profile.copies += 1
            target, source = cast(Any, whole.data), cast(Any, part.data)
            cl.enqueue_copy(self.queue, target, source, byte_count=part.nbytes, dst_offset=start)

    def close(self) -> None:
        """Wait for the device and give its memory back."""
        self.finish()
        if self._concurrent is not None:
            self._concurrent.close()
            self._concurrent = None
        self.workspace.release()
        self._states.clear()
        self._buffers.clear()


def _make_queue(device: Device) -> cl.CommandQueue:
    return cl.CommandQueue(device.context, properties=cl.command_queue_properties.PROFILING_ENABLE)


def _type_of(value: KernelArgument) -> Any:
    """None for memory and structs."""
    if isinstance(value, bool | int):
        return np.int32
    if isinstance(value, float):
        return np.float32
    if isinstance(value, np.void) and value.dtype not in cl_types.vec_type_to_scalar_and_count:
        return None  # a struct: pyopencl's cache on disk takes those of one size for the same type
    return value.dtype if isinstance(value, np.generic) else None


def _described(argument: Any) -> int | str | None:
    """As in `Launch.arguments`."""
    if argument is None:
        return None
    if isinstance(argument, cl.MemoryObjectHolder):
        return int(argument.size)
    number = _type_of(argument)(argument) if isinstance(argument, bool | int | float) else argument
    return str(number.tobytes().hex())


def _vector(packing: struct.Struct, dtype: np.dtype[Any], values: Iterable[float]) -> np.generic:
    """As pyopencl's make_... functions, but thirty times as fast: a frame makes a hundred vectors."""
    vector: np.generic = np.frombuffer(packing.pack(*values), dtype)[0]
    return vector


def float4(*values: float) -> np.generic:
    """A float4 kernel argument."""
    return _vector(_FLOATS, cl_types.float4, values)


def float16(matrix: NDArray[np.float64]) -> np.generic:
    """A row-major 4x4 as a float16 kernel argument."""
    vector: np.generic = np.array(matrix, np.float32).ravel().view(cl_types.float16)[0]
    return vector


def int2(*values: int) -> np.generic:
    """An int2 kernel argument."""
    return _vector(_TWO_INTS, cl_types.int2, values)


def int4(*values: int) -> np.generic:
    """An int4 kernel argument."""
    return _vector(_INTS, cl_types.int4, values)
