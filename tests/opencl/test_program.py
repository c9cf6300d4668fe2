"""The program loader: real files and includes, defines that mean what they say, errors that name what failed."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest

from server.opencl import program
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.opencl.program import KernelBuildError, ProgramCache, define_options, with_places

HALVE = """
kernel void halve(global float *result) { result[get_global_id(0)] = VALUE / 2; }
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of kernels in place of the real one."""
    (tmp_path / "include").mkdir()
    monkeypatch.setattr(program, "KERNEL_FOLDER", tmp_path)
    return tmp_path


@pytest.fixture
def cache(device: Device) -> ProgramCache:
    """An empty cache on the device."""
    return ProgramCache(device.context)


def run(engine: Engine, built: cl.Program, name: str) -> float:
    result = engine.workspace.upload("result", np.full(1, -7, np.float32))
    engine.launch(cl.Kernel(built, name), (1,), result, local=(1,))
    return float(engine.download(result)[0])


@pytest.mark.parametrize(
    ("defines", "options"),
    [
        ({}, ()),
        ({"B": 2, "A": 1}, ("-DA=1", "-DB=2")),
        ({"X": 1.5, "Y": 2.0, "Z": 1e-9, "W": -0.25}, ("-DW=-0.25f", "-DX=1.5f", "-DY=2.0f", "-DZ=1e-09f")),
        ({"HAS_A": True, "HAS_B": False, "HAS_C": True}, ("-DHAS_A=1", "-DHAS_C=1")),
        ({"TYPE": "ushort", "COUNT": 0}, ("-DCOUNT=0", "-DTYPE=ushort")),
        ({"X": np.float64(1.5), "N": np.int64(3)}, ("-DN=3", "-DX=1.5f")),
    ],
)
def test_defines_are_sorted_and_typed(defines: dict[str, program.Define], options: tuple[str, ...]) -> None:
    assert define_options(defines) == options


def test_a_float_define_divides_as_a_float(engine: Engine, cache: ProgramCache, folder: Path) -> None:
    (folder / "halve.cl").write_text(HALVE)
    for value, expected in ((3, 1.0), (3.0, 1.5), (1e-3, 5e-4), (True, 0.0)):
        assert run(engine, cache.get("halve.cl", {"VALUE": value}), "halve") == pytest.approx(expected, rel=1e-6)


def test_an_engines_kernels_differ_by_the_type_of_a_define(engine: Engine, folder: Path) -> None:
    """1, 1.0 and True are equal in Python, and not in OpenCL C."""
    (folder / "types_of_one.cl").write_text(HALVE)
    result = engine.workspace.upload("result", np.zeros(1, np.float32))
    for value, expected in ((1, 0.0), (1.0, 0.5), (True, 0.0)):
        engine.launch(engine.kernel("types_of_one.cl", "halve", VALUE=value), (1,), result, local=(1,))
        assert engine.download(result)[0] == expected


def test_includes_resolve(engine: Engine, cache: ProgramCache, folder: Path) -> None:
    (folder / "include" / "inner.clh").write_text("#pragma once\n#define INNER 20\n")
    (folder / "include" / "outer.clh").write_text('#pragma once\n#include "inner.clh"\n#define OUTER (INNER + 1)\n')
    source = '#include "inner.clh"\n#include "outer.clh"\nkernel void get(global float *r) { r[0] = INNER + OUTER; }\n'
    (folder / "get.cl").write_text(source)
    assert run(engine, cache.get("get.cl", {}), "get") == 41


def test_a_header_in_a_branch_that_is_not_taken_counts_not(engine: Engine, cache: ProgramCache, folder: Path) -> None:
    (folder / "include" / "five.clh").write_text("#pragma once\n#define FIVE 5\n")
    source = '#ifdef NEVER\n#include "five.clh"\n#endif\n#include "five.clh"\n#include "five.clh"\n'
    (folder / "get.cl").write_text(source + "kernel void get(global float *r) { r[0] = FIVE + __LINE__; }\n")
    assert run(engine, cache.get("get.cl", {}), "get") == 5 + 6


def test_nothing_that_is_compiled_holds_the_path_of_the_kernels(
    cache: ProgramCache, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """PoCL keeps compiled kernels by source and options: those of one checkout serve every other."""
    (folder / "include" / "inner.clh").write_text("#pragma once\n#define INNER 20\n")
    (folder / "get.cl").write_text('#include "inner.clh"\nkernel void get(global float *r) { r[0] = INNER; }\n')
    compiled: list[str] = []

    class Program:
        def __init__(self, _context: cl.Context, source: str) -> None:
            compiled.append(source)

        def build(self, options: list[str]) -> None:
            compiled.extend(options)

    monkeypatch.setattr(cl, "Program", Program)
    cache.get("get.cl", {"VALUE": 2})
    assert "-DVALUE=2" in compiled
    assert str(folder) not in "".join(compiled)


def test_lines_that_are_counted_through_are_named() -> None:
    """As NVIDIA's compiler counts them; what names files already stays."""
    source = 'int a;\n#line 1 "some.cl"\nint b;\n#line 1 "some.clh"\nint c;\nint d;\n#line 3 "some.cl"\nint e;\n'
    for told, named in {
        "<kernel>:3:5: error: b": "some.cl:1:5: error: b",
        "<kernel>:6:1: error: d\n<kernel>:8:2: error: e": "some.clh:2:1: error: d\nsome.cl:3:2: error: e",
        "other.cl:7:1: error": "other.cl:7:1: error",
        "<kernel>:1:1: before any file": "<kernel>:1:1: before any file",
        "<kernel>:99:1: nowhere": "<kernel>:99:1: nowhere",
    }.items():
        assert with_places(told, source) == named


def test_a_build_error_names_file_options_and_line(cache: ProgramCache, folder: Path) -> None:
    (folder / "wrong.cl").write_text("kernel void wrong(global int *x) {\n    x[0] = undeclared_name;\n}\n")
    with pytest.raises(KernelBuildError) as caught:
        cache.get("wrong.cl", {"SIZE": 4, "ALPHA": 0.5})
    text = str(caught.value)
    assert text.startswith("cl_kernels/wrong.cl with -DALPHA=0.5f -DSIZE=4: ")
    assert "undeclared_name" in text
    assert "wrong.cl:2" in text
    assert isinstance(caught.value.__cause__, cl.RuntimeError)


def test_a_build_error_names_the_include(cache: ProgramCache, folder: Path) -> None:
    (folder / "include" / "broken.clh").write_text("int f(int x) { return x + }\n")
    (folder / "good.cl").write_text('#include "broken.clh"\nkernel void good(global int *x) { x[0] = f(1); }\n')
    with pytest.raises(KernelBuildError, match=r"cl_kernels/good\.cl with no defines: (?s:.)*broken\.clh:1"):
        cache.get("good.cl", {})


def test_a_warning_is_an_error(cache: ProgramCache, folder: Path) -> None:
    (folder / "warns.cl").write_text('#warning "look here"\nkernel void warns(global int *x) { x[0] = 1; }\n')
    with pytest.raises(KernelBuildError, match="look here"):
        cache.get("warns.cl", {})


def test_a_missing_define_is_an_error(device: Device) -> None:
    with pytest.raises(KernelBuildError, match="MASK_WORDS must be defined"):
        device.programs.get("radiance_transfer.cl", {"BANDS": 4})


def test_a_failed_build_can_be_mended(engine: Engine, cache: ProgramCache, folder: Path) -> None:
    path = folder / "mended.cl"
    path.write_text("kernel void halve(")
    with pytest.raises(KernelBuildError):
        cache.get("mended.cl", {"VALUE": 4})
    path.write_text(HALVE)
    assert run(engine, cache.get("mended.cl", {"VALUE": 4}), "halve") == 2


def test_programs_are_built_once(cache: ProgramCache, folder: Path) -> None:
    (folder / "halve.cl").write_text(HALVE)
    first = cache.get("halve.cl", {"VALUE": 2, "OTHER": 3})
    assert cache.get("halve.cl", {"OTHER": 3, "VALUE": 2}) is first
    assert cache.get("halve.cl", {"VALUE": 2}) is not first
    assert cache.get("halve.cl", {"VALUE": 2.0}) is not cache.get("halve.cl", {"VALUE": 2})


def test_threads_share_one_program(cache: ProgramCache, folder: Path) -> None:
    (folder / "halve.cl").write_text(HALVE)
    with ThreadPoolExecutor(4) as pool:
        programs = list(pool.map(lambda _: cache.get("halve.cl", {"VALUE": 6}), range(8)))
    assert all(built is programs[0] for built in programs)
