"""Fixtures: the OpenCL devices that kernel tests run on."""

import os
from collections.abc import Iterator

import pytest

from server.opencl.device import Device, list_devices, open_device
from server.opencl.engine import Engine


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run every test that takes `device` on every usable device, or on those that PROBELESS_TEST_DEVICE names."""
    if "device" in metafunc.fixturenames:
        wanted = os.environ.get("PROBELESS_TEST_DEVICE", "").lower()
        names = [f"{d.platform} / {d.name}" for d in list_devices() if d.usable is None]
        metafunc.parametrize("device", [n for n in names if wanted in n.lower()], indirect=True, scope="session")


@pytest.fixture(scope="session")
def device(request: pytest.FixtureRequest) -> Device:
    """An opened OpenCL device."""
    return open_device(request.param)


@pytest.fixture
def engine(device: Device) -> Iterator[Engine]:
    """A fresh queue and memory on the device."""
    engine = Engine(device)
    yield engine
    engine.close()
