"""Kernels that a process beside compiles: what it leaves in PoCL's cache, what it survives, when it is asked."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
import pytest

from server.opencl.compiler_process import zeros
from server.opencl.compiling import SMALL_GRID, KernelCompiler, Launch
from server.opencl.device import Device, list_devices
from server.opencl.engine import Engine

LAUNCH = Launch("kernel", (64,), (64,), None, ("01000000", 256))
LAUNCHES = """
import sys
from pathlib import Path
import numpy as np
from server.opencl.device import open_device
from server.opencl.engine import Engine

def compiled():
    return {str(path.relative_to(sys.argv[1])): path.stat().st_mtime_ns for path in Path(sys.argv[1]).rglob("*.so")}

device = open_device("portable")
engine = Engine(device)
kernel = lambda: engine.kernel("voxelize.cl", "clear_cells", SLAB=8)
if sys.argv[2] == "beside":
    device.compile_beside()
    launch_there = device.compiler.compile
    seen = []
    def compile(*asked):
        launch_there(*asked)
        seen.append(compiled())
    device.compiler.compile = compile
cells = engine.workspace.upload("cells", np.ones(1000, np.int32))
near = engine.workspace.upload("near", np.ones(1000, np.int32))
engine.launch(kernel(), (1000,), 1000, cells, near)
assert (engine.download(cells) == 0).all()
after = {path for path in compiled() if "clear_cells" in path}
if sys.argv[2] == "beside":
    assert after <= set(seen[-1]), (after, seen[-1])
    assert all(seen[-1][path] == compiled()[path] for path in after), "compiled again"
    assert not any("clear_cells" in path for path in seen[0]), "building alone compiles for no launch"
    device.end_children()
print(sorted(path.split("/")[-2] for path in after))
"""


def run_launches(cache: Path, where: str) -> str:
    """In a process of its own, whose PoCL keeps compiled kernels in `cache`."""
    environment = os.environ | {"POCL_CACHE_DIR": str(cache), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run(
        [sys.executable, "-c", LAUNCHES, str(cache), where],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_what_was_compiled_beside_is_only_loaded_here(tmp_path: Path) -> None:
    if not any("portable" in device.platform.lower() for device in list_devices()):
        pytest.skip("PoCL's CPU device is not installed")
    caches = {where: tmp_path / where for where in ("here", "beside")}
    for cache in caches.values():
        cache.mkdir()
    assert run_launches(caches["beside"], "beside") == run_launches(caches["here"], "here") != "[]\n"


@pytest.fixture
def stand_in(tmp_path: Path) -> Iterator[Callable[[str], KernelCompiler]]:
    """Makes a compiler whose process runs some lines of Python instead, and notes each of its starts."""
    made: list[KernelCompiler] = []

    def make(lines: str) -> KernelCompiler:
        compiler = KernelCompiler("none")
        note = f"import sys, os; open({str(tmp_path / 'starts')!r}, 'a').write('x')\n"
        compiler._command = [sys.executable, "-c", note + lines]
        compiler.is_used = True
        made.append(compiler)
        return compiler

    yield make
    for compiler in made:
        compiler.close()


def starts(tmp_path: Path) -> int:
    return len((tmp_path / "starts").read_text())


def test_one_process_compiles_all_and_nothing_twice(stand_in: Callable[[str], KernelCompiler], tmp_path: Path) -> None:
    compiler = stand_in(f"requests = open({str(tmp_path / 'asked')!r}, 'w', 1)\n"
                        "for line in sys.stdin: requests.write(line); print('done', flush=True)")  # fmt: skip
    for _ in range(2):
        compiler.compile("a.cl", {"N": 1, "X": 0.5})
        compiler.compile("a.cl", {"N": 1, "X": 0.5}, LAUNCH)
    asked = [json.loads(line) for line in (tmp_path / "asked").read_text().splitlines()]
    assert [(each["file"], each["defines"], each["launch"] is None) for each in asked] == [
        ("a.cl", {"N": 1, "X": 0.5}, True),
        ("a.cl", {"N": 1, "X": 0.5}, False),
    ]
    assert starts(tmp_path) == 1


def test_a_kernel_that_crashes_is_not_tried_again_and_the_next_has_a_new_process(
    stand_in: Callable[[str], KernelCompiler], tmp_path: Path
) -> None:
    asked = tmp_path / "asked"
    compiler = stand_in(f"line = sys.stdin.readline(); open({str(asked)!r}, 'a').write(line); os.abort()")
    for _ in range(2):
        compiler.compile("a.cl", {}, LAUNCH)
    assert compiler.knows("a.cl", {}, LAUNCH)
    compiler.compile("b.cl", {}, LAUNCH)
    assert [json.loads(line)["file"] for line in asked.read_text().splitlines()] == ["a.cl", "b.cl"]
    assert starts(tmp_path) in (2, 3)  # one for each, and one that waits for what comes next and may not have begun


def test_a_process_that_has_ended_with_nothing_to_do_is_started_again(
    stand_in: Callable[[str], KernelCompiler], tmp_path: Path
) -> None:
    compiler = stand_in("sys.stdin.readline(); print('done', flush=True)")
    compiler.compile("a.cl", {})
    assert compiler._process is not None
    compiler._process.wait()
    compiler.compile("b.cl", {})
    assert starts(tmp_path) == 2


def test_before_the_device_is_shared_no_process_is_started() -> None:
    compiler = KernelCompiler("none")
    compiler.compile("a.cl", {}, LAUNCH)
    assert compiler.knows("a.cl", {}, LAUNCH)
    assert compiler._process is None


@pytest.mark.parametrize(
    ("other", "is_same"),
    [
        (Launch("kernel", (640,), (64,), None, ("01000000", 256)), True),
        (Launch("another", (64,), (64,), None, ("01000000", 256)), False),
        (Launch("kernel", (64,), (32,), None, ("01000000", 256)), False),
        (Launch("kernel", (64,), (64,), (64,), ("01000000", 256)), False),
        (Launch("kernel", (SMALL_GRID + 1,), (64,), None, ("01000000", 256)), False),
    ],
)
def test_what_pocl_compiles_anew_for(other: Launch, is_same: bool) -> None:
    assert (other.variant == LAUNCH.variant) is is_same


class Recorder:
    """In place of a compiler: what it is asked for, and whether others had the device."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, str | None, bool]] = []
        self.is_released = False

    def knows(self, file: str, _defines: dict[str, Any], launch: Launch | None = None) -> bool:
        return (file, launch and launch.kernel, True) in self.asked

    def compile(self, file: str, _defines: dict[str, Any], launch: Launch | None = None) -> None:
        self.asked.append((file, launch and launch.kernel, self.is_released))

    def is_due(self) -> bool:
        return False

    def give_way(self) -> None:
        raise AssertionError("nobody is due")

    @contextmanager
    def released(self) -> Iterator[None]:
        self.is_released = True
        yield
        self.is_released = False


def test_an_engine_has_programs_and_first_launches_compiled_while_others_have_the_device(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = Recorder()
    monkeypatch.setattr(engine.device, "compiler", recorder)
    engine.pacer.yielding = recorder
    arrays = [engine.workspace.upload(name, np.ones(100, np.int32)) for name in ("cells", "near")]
    for _ in range(2):
        engine.launch(engine.kernel("voxelize.cl", "clear_cells", SLAB=7), (100,), 100, *arrays)
    assert recorder.asked == [("voxelize.cl", None, True), ("voxelize.cl", "clear_cells", True)]
    engine.pacer.yielding = None


def test_memory_of_the_compiling_process_is_aligned_and_zero(device: Device) -> None:
    queue = cl.CommandQueue(device.context)
    for size in (1, 16, 100, 1000, 4096, 76_800, 100_000, 1_000_000):
        memory = zeros(device.context, size)
        assert memory is not None
        host, _ = cl.enqueue_map_buffer(queue, memory, cl.map_flags.READ, 0, (size,), np.uint8)
        assert host.ctypes.data % 128 == 0, size
        assert not host.any(), size
        host.base.release(queue)
    assert zeros(device.context, None) is None
