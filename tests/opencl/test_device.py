"""Finding a device: which one is taken, and one clear line where there is none."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pyopencl as cl
import pytest

from server.opencl import device as module
from server.opencl.device import Device, DeviceError, list_devices, open_device

GPU, CPU = cl.device_type.GPU, cl.device_type.CPU


@dataclass
class FakeDevice:
    """What the code looks at before it opens a device."""

    name: str
    type: int
    platform: Any = field(default_factory=lambda: SimpleNamespace(name="Fake Platform"))
    available: bool = True
    compiler_available: bool = True
    max_compute_units: int = 2
    global_mem_size: int = 1 << 30
    version: str = "OpenCL 3.0 Fake"

    @property
    def int_ptr(self) -> int:
        return id(self)


def use(monkeypatch: pytest.MonkeyPatch, *platforms: list[FakeDevice]) -> None:
    """Let the loader find these platforms."""
    fakes = [SimpleNamespace(get_devices=lambda devices=devices: devices) for devices in platforms]
    monkeypatch.setattr(cl, "get_platforms", lambda: fakes)


def message(name: str | None = None) -> str:
    with pytest.raises(DeviceError) as caught:
        open_device(name)
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_a_device_opens_by_any_part_of_its_name(device: Device) -> None:
    assert open_device(device.name).name == device.name
    platform, name = device.name.split(" / ")
    assert open_device(platform[:6].upper()).name.startswith(platform[:6])
    assert name in open_device(name.lower()).name
    assert open_device().name


def test_listed_devices_are_those_that_open(device: Device) -> None:
    listed = list_devices()
    assert device.name in [f"{d.platform} / {d.name}" for d in listed]
    for info in listed:
        assert info.compute_units > 0
        assert info.memory_bytes > 0
        assert info.kind in ("CPU", "GPU", "accelerator", "other")


def test_an_unknown_name_lists_what_is_there(device: Device) -> None:
    text = message("no such device")
    assert text.startswith("no OpenCL device is called 'no such device': there are ")
    assert device.name in text


def test_no_platform_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_platform() -> list[Any]:
        raise cl.LogicError("clGetPlatformIDs failed: PLATFORM_NOT_FOUND_KHR")

    monkeypatch.setattr(cl, "get_platforms", no_platform)
    assert message().startswith("no OpenCL device found: install ")
    assert message("pocl") == message()
    assert list_devices() == []


def test_a_platform_without_devices_is_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_devices() -> list[Any]:
        raise cl.LogicError("clGetDeviceIDs failed: DEVICE_NOT_FOUND")

    use(monkeypatch, [FakeDevice("cpu", CPU, available=False)])
    empty = SimpleNamespace(get_devices=no_devices)
    monkeypatch.setattr(cl, "get_platforms", lambda found=cl.get_platforms: [empty, *found()])
    assert [d.name for d in list_devices()] == ["cpu"]


def test_gpus_come_first(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = FakeDevice("cpu a", CPU, available=False), FakeDevice("gpu a", GPU, available=False)
    use(monkeypatch, [first, second], [FakeDevice("gpu b", GPU, available=False)])
    assert [d.name for d in list_devices()] == ["gpu a", "gpu b", "cpu a"]
    assert [d.kind for d in list_devices()] == ["GPU", "GPU", "CPU"]


def test_unusable_devices_are_refused_with_their_reasons(monkeypatch: pytest.MonkeyPatch) -> None:
    use(monkeypatch, [FakeDevice("gpu a", GPU, available=False), FakeDevice("cpu a", CPU, compiler_available=False)])
    text = message()
    assert text.startswith("no usable OpenCL device (gpu a: the driver says ")
    assert "cpu a: the driver says " in text
    assert "install" in text
    assert "gpu a" not in message("cpu")
    assert all(d.usable for d in list_devices())


def test_a_device_that_cannot_compile_is_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = FakeDevice("gpu", GPU)
    found = [d for platform in cl.get_platforms() for d in platform.get_devices()]
    use(monkeypatch, [broken, *found])

    def compiles(devices: list[Any], create: Any = cl.Context) -> Any:
        if broken in devices:
            raise cl.RuntimeError("clBuildProgram failed: BUILD_PROGRAM_FAILURE\nsome\nerror: unknown target CPU\nmore")
        return create(devices)

    monkeypatch.setattr(cl, "Context", compiles)
    assert open_device().name != "Fake Platform / gpu"
    assert module._why_unusable(broken) == "cannot compile: error: unknown target CPU"


def test_the_number_chooses_among_gpus_that_are_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    def fake(platform: str, name: str) -> SimpleNamespace:
        return SimpleNamespace(platform=SimpleNamespace(name=platform), name=name, type=1)

    vendor = SimpleNamespace(name="vendor")
    same = [SimpleNamespace(platform=vendor, name="big", type=1, bus=number) for number in range(3)]
    devices = [same[0], fake("other", "big"), same[1], fake("vendor", "small"), same[2]]
    monkeypatch.setattr("server.opencl.device._all_devices", lambda: devices)
    monkeypatch.setattr("server.opencl.device._why_unusable", lambda _device: None)
    monkeypatch.setattr("server.opencl.device.Device", lambda device: device)
    assert [open_device(None, number).bus for number in range(5)] == [0, 1, 2, 0, 1]
    assert open_device("small", 2).name == "small"
