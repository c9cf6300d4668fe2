"""Device memory of a session. A stage declares its buffers; each is made on first use and kept."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Mapping
from typing import Any, Generic, TypeVar, cast
from weakref import ref

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
from numpy.typing import DTypeLike, NDArray

from server.opencl.parts import Parts, Shapes, pack, part_alignment_bytes, place
from server.opencl.profile import Profile

Group = TypeVar("Group", bound="StageBuffers")


def new_array(queue: cl.CommandQueue, shape: tuple[int, ...], dtype: DTypeLike) -> cl_array.Array:
    """Device memory whose contents are undefined."""
    return cl_array.empty(queue, shape, dtype)


class DeviceBuffer:
    """One array on the device. While its shape stays it is the same memory, so a steady stream allocates nothing."""

    def __init__(self, workspace: Workspace, dtype: DTypeLike) -> None:
        self._workspace = workspace
        self._dtype: np.dtype[Any] = np.dtype(dtype)
        self.current: cl_array.Array | None = None
        """The array as it is; None before its first use."""
        self._refreshed: bytes | None = None
        """Content of the array, of `refresh`."""
        workspace.add(self)

    def array(self, shape: tuple[int, ...]) -> cl_array.Array:
        """The array of that shape; its contents are kept while the shape stays, and undefined after it changes."""
        if self.current is None or self.current.shape != shape:
            self.current = new_array(self._workspace.queue, shape, self._dtype)
        return self.current

    def upload(self, values: NDArray[Any]) -> cl_array.Array:
        """Copy `values` into the array, after what is queued already; the caller may change them at once.

        Raises TypeError where `values` are of another type than the buffer.
        """
        if values.dtype != self._dtype:
            raise TypeError(f"the buffer holds {self._dtype}, not {values.dtype}")
        array = self.array(values.shape)
        self._workspace.copy(array, values)
        return array

    def refresh(self, values: NDArray[Any]) -> cl_array.Array:
        """As `upload`, but nothing is copied if the array has these values from the last time: no kernel writes it."""
        before, content = self.current, values.tobytes()
        array = self.array(values.shape)
        if array is not before or content != self._refreshed:
            self.upload(values)
            self._refreshed = content
        return array

    def constant(self, values: NDArray[Any]) -> cl_array.Array:
        """The array, copied from `values` only the first time and when the shape changes. `values` must not change."""
        if self.current is not None and self.current.shape == values.shape:
            return self.current
        return self.upload(values)

    def parts(self, shapes: Shapes) -> Parts:
        """Several arrays in this buffer, which must be of uint8; contents are kept as in `array`."""
        starts, size = place(shapes, part_alignment_bytes(self._workspace.queue.device))
        return Parts(self.array((size,)), starts, shapes)

    def upload_parts(self, arrays: Mapping[str, NDArray[Any]]) -> Parts:
        """Copy `arrays` into this buffer, which must be of uint8, at once; the caller may change them."""
        packed, starts, shapes = self._packed(arrays)
        memory = self.array(packed.shape)
        self._workspace.hand_over(memory, packed)
        return Parts(memory, starts, shapes)

    def refresh_parts(self, arrays: Mapping[str, NDArray[Any]]) -> Parts:
        """Copy `arrays` into this buffer, which must be of uint8, as `refresh` does."""
        packed, starts, shapes = self._packed(arrays)
        return Parts(self.refresh(packed), starts, shapes)

    def _packed(self, arrays: Mapping[str, NDArray[Any]]) -> tuple[NDArray[np.uint8], dict[str, int], Shapes]:
        """The bytes of all, where each begins, and their shapes."""
        shapes: Shapes = {part: (values.shape, values.dtype) for part, values in arrays.items()}
        starts, size = place(shapes, part_alignment_bytes(self._workspace.queue.device))
        return pack(arrays, starts, size), starts, shapes


class BufferDescription:
    """Declares a buffer in the body of a `StageBuffers` class."""

    def __init__(self, dtype: DTypeLike) -> None:
        self.dtype: np.dtype[Any] = np.dtype(dtype)

    def __get__(self, stage: StageBuffers, _: type) -> DeviceBuffer:
        buffer: DeviceBuffer = stage.find(self, None, lambda: DeviceBuffer(stage.workspace, self.dtype))
        return buffer


class KeyedBuffers:
    """Buffers of one description, one for each key, for instance for each pyramid level."""

    def __init__(self, stage: StageBuffers, description: KeyedBufferDescription) -> None:
        self._stage, self._description = stage, description

    def __getitem__(self, key: Hashable) -> DeviceBuffer:
        description, stage = self._description, self._stage
        buffer: DeviceBuffer = stage.find(description, key, lambda: DeviceBuffer(stage.workspace, description.dtype))
        return buffer


class KeyedBufferDescription:
    """Declares one buffer for each key that is asked for. There must be a bounded number of keys."""

    def __init__(self, dtype: DTypeLike) -> None:
        self.dtype: np.dtype[Any] = np.dtype(dtype)

    def __get__(self, stage: StageBuffers, _: type) -> KeyedBuffers:
        return KeyedBuffers(stage, self)


class BufferGroup(Generic[Group]):
    """Declares the buffers of another stage that this one calls, so that nobody else writes them."""

    def __init__(self, kind: type[Group]) -> None:
        self._kind = kind

    def __get__(self, stage: StageBuffers, _: type) -> Group:
        group: Group = stage.find(self, None, lambda: self._kind(stage.workspace))
        return group


class StageBuffers:
    """Base of the classes in which stages declare their buffers. `Engine.buffers` gives the engine's instance; who
    needs the same stage twice makes an instance of its own."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace: Workspace = workspace
        self._made: dict[tuple[object, Hashable], Any] = {}

    def find(self, description: object, key: Hashable, make: Callable[[], Any]) -> Any:
        """What belongs to a description and key; made on first use."""
        found = self._made.get((description, key))
        if found is None:
            found = self._made[description, key] = make()
        return found


class Workspace:
    """All buffers of one engine: counts them, copies to them and releases them."""

    def __init__(self, queue: cl.CommandQueue, profile: Profile) -> None:
        self.queue: cl.CommandQueue = queue
        self._profile = profile
        self._buffers: list[ref[DeviceBuffer]] = []
        self._named: dict[tuple[str, np.dtype[Any]], DeviceBuffer] = {}
        self._copying: deque[tuple[cl.Event, NDArray[Any]]] = deque()

    def add(self, buffer: DeviceBuffer) -> None:
        """Count `buffer` from now on, as long as it exists."""
        self._buffers = [*(held for held in self._buffers if held() is not None), ref(buffer)]

    def copy(self, array: cl_array.Array, values: NDArray[Any]) -> None:
        """Copy `values` over the beginning of an array. Waits for nothing: a copy of them is kept until it is done."""
        if values.nbytes:
            self.hand_over(array, np.array(values, order="C"))

    def hand_over(self, array: cl_array.Array, values: NDArray[Any]) -> None:
        """As `copy`, of contiguous values that nobody changes from now on: no copy of them is made."""
        self._profile.copies += 1
        memory = cast(Any, array.data)
        self._copying.append((cl.enqueue_copy(self.queue, memory, values, is_blocking=False), values))
        while self._copying and self._copying[0][0].command_execution_status == cl.command_execution_status.COMPLETE:
            self._copying.popleft()

    def array(self, name: str, shape: tuple[int, ...], dtype: DTypeLike) -> cl_array.Array:
        """As `DeviceBuffer.array`, for the buffer of that name and type. For the light's estimation and tests; other
        stages declare their buffers."""
        return self._by_name(name, dtype).array(shape)

    def upload(self, name: str, values: NDArray[Any]) -> cl_array.Array:
        """As `DeviceBuffer.upload`, for the buffer of that name."""
        return self._by_name(name, values.dtype).upload(values)

    def constant(self, name: str, values: NDArray[Any]) -> cl_array.Array:
        """As `DeviceBuffer.constant`, for the buffer of that name."""
        return self._by_name(name, values.dtype).constant(values)

    def _by_name(self, name: str, dtype: DTypeLike) -> DeviceBuffer:
        key = (name, np.dtype(dtype))
        if key not in self._named:
            self._named[key] = DeviceBuffer(self, dtype)
        return self._named[key]

    @property
    def bytes_held(self) -> int:
        """Device memory of all buffers. Any thread may ask."""
        return sum(array.nbytes for array in self.arrays())

    def arrays(self) -> list[cl_array.Array]:
        """The arrays of all buffers."""
        held = [buffer() for buffer in self._buffers]
        arrays = [buffer.current for buffer in held if buffer is not None]
        return [array for array in arrays if array is not None]

    def release(self) -> None:
        """Give all device memory back."""
        self._copying.clear()
        for held in self._buffers:
            buffer = held()
            if buffer is None or buffer.current is None:
                continue
            if isinstance(buffer.current.base_data, cl.MemoryObject):
                buffer.current.base_data.release()
            buffer.current = None
