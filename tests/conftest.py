"""Which tests are slow, what may be skipped, and the OpenCL devices that kernel tests run on."""

import asyncio
import gc
import os
from collections.abc import Generator, Iterator
from functools import cache
from typing import Any

import pytest

from server.opencl.device import Device, list_devices, open_device
from server.opencl.engine import Engine
from tests import guards
from tests.absent import fail_unexpected_skip
from tests.slow import function_of, read_list, stale_lines, without_device

COLLECTED = pytest.StashKey[list[str]]()
"""Names of all tests that were found, before any is deselected; without their device."""


@cache
def _usable_devices() -> list[str]:
    """Names of the devices that compile; asked once, since a test of each compiles for 35 ms."""
    return [f"{d.platform} / {d.name}" for d in list_devices() if d.usable is None]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run every test that takes `device` on every usable device, or on those that PROBELESS_TEST_DEVICE names."""
    if "device" in metafunc.fixturenames:
        wanted = os.environ.get("PROBELESS_TEST_DEVICE", "").lower()
        usable = _usable_devices()
        names = [name for name in usable if wanted in name.lower()]
        if not names:
            raise pytest.UsageError(f"no usable OpenCL device is called {wanted!r}: there are {usable}")
        metafunc.parametrize("device", names, indirect=True, scope="session")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Half a million objects that stay are made here: the garbage collector need not look at them, now or later."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.freeze()


def _name_of(item: pytest.Item) -> str:
    parameters = getattr(item, "callspec", None)
    device = parameters.params.get("device") if parameters else None
    return without_device(item.nodeid, device) if device else item.nodeid


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark slow tests by tests/slow.txt, and tests that take a device."""
    slow = set(read_list())
    config.stash[COLLECTED] = []
    for item in items:
        name = _name_of(item)
        config.stash[COLLECTED].append(name)
        if name in slow or function_of(name) in slow:
            item.add_marker("slow")
        if "device" in getattr(item, "fixturenames", ()):
            item.add_marker("device")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, Any, Any]:
    """A test that is skipped where nothing may be has failed."""
    report = yield
    fail_unexpected_skip(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, Any, Any]:
    """So has a file."""
    report = yield
    fail_unexpected_skip(report)
    return report


@pytest.fixture
def stale_slow_lines(pytestconfig: pytest.Config) -> list[str]:
    """Lines of tests/slow.txt that name no test, of the files that were collected as a whole."""
    parts = [argument.partition("::")[0] for argument in pytestconfig.args if "::" in argument]
    lines = [line for line in read_list() if not line.startswith(tuple(parts))] if parts else read_list()
    return stale_lines(lines, pytestconfig.stash[COLLECTED])


@pytest.fixture(scope="session")
def device(request: pytest.FixtureRequest) -> Device:
    """An opened OpenCL device."""
    return open_device(request.param)


@pytest.fixture(autouse=True)
def suspended_browser(request: pytest.FixtureRequest) -> Iterator[None]:
    """Suspend the event loop of the session's browser, which runs in the main thread, while a test without a browser
    may run a loop of its own."""
    loop = asyncio._get_running_loop()
    if loop is None or "browser" in request.fixturenames:
        yield
        return
    asyncio._set_running_loop(None)
    yield
    asyncio._set_running_loop(loop)


@pytest.fixture(scope="session", autouse=True)
def guarded_buffers() -> Iterator[None]:
    """Bytes behind every device buffer of this process that no kernel may write."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        guards.install(monkeypatch)
        yield


@pytest.fixture
def engine(device: Device) -> Iterator[Engine]:
    """A fresh queue and memory on the device."""
    engine = Engine(device)
    yield engine
    engine.close()
