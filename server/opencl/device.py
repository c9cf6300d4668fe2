"""Finding and opening an OpenCL device: the one place that decides which is used."""

from __future__ import annotations

from dataclasses import dataclass
from threading import Lock

import pyopencl as cl

from server.opencl import linker
from server.opencl.compiling import CAN_COMPILE_BESIDE, KernelCompiler
from server.opencl.device_memory import DeviceMemory
from server.opencl.pacing import StepTimes
from server.opencl.pocl_cpu import is_pocl, name_unknown_cpu
from server.opencl.program import KernelBuildError, ProgramCache

_INSTALL = "install a vendor driver, or PoCL for the processor: pip install 'pyopencl[pocl]'"
VOLUME_BYTES = 512 << 20
_named: set[int] = set()
_naming = Lock()


class DeviceError(RuntimeError):
    """No usable OpenCL device; the message is one line that says what to do."""


@dataclass(frozen=True)
class DeviceInfo:
    """One OpenCL device as `probeless devices` lists it."""

    platform: str
    name: str
    kind: str
    compute_units: int
    memory_bytes: int
    usable: str | None
    """None if it can be used, else why not."""


class Device:
    """An opened OpenCL device: its context and its compiled programs, shared by all sessions."""

    def __init__(self, cl_device: cl.Device) -> None:
        self.cl_device = cl_device
        self.name = f"{cl_device.platform.name} / {cl_device.name}".strip()
        self.is_gpu = bool(cl_device.type & cl.device_type.GPU)
        self.context = cl.Context([cl_device])
        self.programs = ProgramCache(self.context)
        self.memory = DeviceMemory()
        self.step_times = StepTimes()
        self.compiler = KernelCompiler(self.name) if CAN_COMPILE_BESIDE and is_pocl(cl_device.platform) else None
        """None: a driver that compiles kernels when they are built."""
        self.volume_bytes = VOLUME_BYTES
        """The share of its memory that one volume may use; the rest of the volume is moved to the host."""

    def compile_beside(self) -> None:
        """Compile kernels in another process from now on, if all wait for a kernel that the driver compiles here."""
        if self.compiler is not None:
            self.compiler.is_used = True

    def end_children(self) -> None:
        """End what works for it beside this process. It may be used afterwards."""
        if self.compiler is not None:
            self.compiler.close()


def _all_devices() -> list[cl.Device]:
    """Every device of every platform, GPUs first, otherwise in the order the loader names them."""
    try:
        platforms = cl.get_platforms()
    except cl.LogicError:  # the loader found no platform
        return []
    devices: list[cl.Device] = []
    for platform in platforms:
        try:
            devices += platform.get_devices()
        except cl.LogicError:  # a platform without a device
            continue
    with _naming:
        for device in devices:
            if device.int_ptr not in _named:
                name_unknown_cpu(device)
                _named.add(device.int_ptr)
    return sorted(devices, key=lambda device: not device.type & cl.device_type.GPU)


def _kind(bits: int) -> str:
    names = {"GPU": cl.device_type.GPU, "CPU": cl.device_type.CPU, "accelerator": cl.device_type.ACCELERATOR}
    return " + ".join(name for name, bit in names.items() if bits & bit) or "other"


def _why_unusable(device: cl.Device) -> str | None:
    """None if a trivial kernel compiles for the device, else the first line of the reason."""
    if not device.available or not device.compiler_available:
        return "the driver says it is not available or has no compiler"
    try:
        cl.Program(cl.Context([device]), "kernel void probe(global int *x) { x[0] = 1; }").build("-cl-std=CL1.2")
    except cl.Error as error:
        lines = [line for line in str(error).splitlines() if "error" in line] or [str(error).splitlines()[0]]
        return f"cannot compile: {lines[0].strip()}"
    return linker.why_not() if is_pocl(device.platform) else None


def list_devices() -> list[DeviceInfo]:
    """Every OpenCL device here, in the order of preference."""
    return [
        DeviceInfo(
            platform=device.platform.name.strip(),
            name=device.name.strip(),
            kind=_kind(device.type),
            compute_units=device.max_compute_units,
            memory_bytes=device.global_mem_size,
            usable=_why_unusable(device),
        )
        for device in _all_devices()
    ]


def open_device(name: str | None = None, number: int = 0) -> Device:
    """Open the first usable device whose "platform / device" contains `name` (any case); GPUs are preferred.

    `number`: of several GPUs that are called alike on one platform, which one; they are counted round.

    Raises DeviceError with one line that says what is there and what to do.
    """
    devices = _all_devices()
    if not devices:
        raise DeviceError(f"no OpenCL device found: {_INSTALL}")
    wanted = [d for d in devices if name is None or name.lower() in f"{d.platform.name} / {d.name}".lower()]
    if not wanted:
        known = "; ".join(f"{d.platform.name} / {d.name}".strip() for d in devices)
        raise DeviceError(f"no OpenCL device is called {name!r}: there are {known}")
    reasons = []
    for device in wanted:
        reason = _why_unusable(device)
        if reason is None:
            alike = [d for d in wanted if (d.platform, d.name, d.type) == (device.platform, device.name, device.type)]
            return Device(alike[number % len(alike)])
        reasons.append(f"{device.name.strip()}: {reason}")
    hint = "" if any(linker.CANNOT_LINK in reason for reason in reasons) else f": {_INSTALL}"
    raise DeviceError(f"no usable OpenCL device ({'; '.join(reasons)}){hint}")


__all__ = ["Device", "DeviceError", "DeviceInfo", "KernelBuildError", "list_devices", "open_device"]
