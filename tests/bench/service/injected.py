"""Faults that are put into a running server: a disk without room, a device that fails to build or allocate."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from typing import Any

import pyopencl as cl


class Injected:
    """One kind of fault; harmless until it begins."""

    def __init__(self) -> None:
        self.is_on = False
        self.times = 0
        """That it made something fail."""

    def begin(self) -> None:
        """From now on it fails."""
        self.is_on = True

    def end(self) -> None:
        """It works again."""
        self.is_on = False

    def fails(self) -> bool:
        """Whether it does now; counted."""
        self.times += self.is_on
        return self.is_on


class FullDisk(Injected):
    """Whatever of a room is written does not fit."""

    def __init__(self) -> None:
        super().__init__()
        from server.service.saving import checksummed_files as files

        fails = self.fails

        class Disk:
            """Takes the place of `os` there."""

            def __getattr__(self, name: str) -> Any:
                return getattr(os, name)

            def write(self, file: int, data: memoryview) -> int:
                if fails():
                    os.write(file, data[: len(data) // 2])
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                return os.write(file, data)

        files.os = Disk()  # type: ignore[assignment]


class NoBuild(Injected):
    """No kernel compiles: each one that is not there yet, and the device forgets those that are."""

    def __init__(self) -> None:
        super().__init__()
        from server.opencl.program import KernelBuildError, ProgramCache

        get = ProgramCache.get

        def failing(cache: ProgramCache, file: str, defines: Any) -> Any:
            if self.fails():
                raise KernelBuildError(f"cl_kernels/{file}: the compiler has crashed (injected)")
            return get(cache, file, defines)

        ProgramCache.get = failing  # type: ignore[method-assign]


class NoMemory(Injected):
    """The device gives no memory for anything that is not there yet."""

    def __init__(self) -> None:
        super().__init__()
        from server.opencl import buffers

        array = buffers.DeviceBuffer.array
        number = 0

        def failing(buffer: buffers.DeviceBuffer, shape: tuple[int, ...]) -> Any:
            nonlocal number
            number += 1
            # A steady stream allocates nothing: so that frames meet it too, every thousandth use counts as a new one.
            if self.is_on and (buffer.current is None or number % 1000 == 0):
                self.times += 1
                raise cl.MemoryError("clCreateBuffer", cl.status_code.MEM_OBJECT_ALLOCATION_FAILURE, "injected")
            return array(buffer, shape)

        buffers.DeviceBuffer.array = failing  # type: ignore[method-assign]


INJECTED: dict[str, Callable[[], Injected]] = {"disk": FullDisk, "build": NoBuild, "allocation": NoMemory}
