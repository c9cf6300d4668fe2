"""The processor's name that PoCL is told for a processor it does not know."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pyopencl as cl
import pytest

from server.opencl.device import list_devices
from server.opencl.pocl_cpu import better_name, known_name, processor_name

BASE = "fpu vme de pse tsc msr pae mce cx8 apic sse sse2 ht syscall nx lm"
V2 = f"{BASE} pni ssse3 cx16 sse4_1 sse4_2 popcnt lahf_lm"
V3 = f"{V2} avx avx2 bmi1 bmi2 fma f16c movbe abm"
V4 = f"{V3} avx512f avx512bw avx512cd avx512dq avx512vl"


def cpuinfo(flags: str, cores: int = 2) -> str:
    core = f"processor\t: 0\nvendor_id\t: AuthenticAMD\nmodel name\t: AMD EPYC\nflags\t\t: {flags}\nbugs\t\t: none\n"
    return "\n".join([f"{core}vmx flags\t: vnmi invvpid\n"] * cores)


@pytest.mark.parametrize(
    ("flags", "name"),
    [
        (BASE, b"x86-64"),
        (V2, b"x86-64-v2"),
        (V3, b"haswell"),
        (V4, b"skylake-avx512"),
        (V4.replace(" avx512vl", ""), b"haswell"),
        (" ".join(reversed(V3.split())), b"haswell"),
        (V3.replace(" movbe", ""), b"x86-64-v2"),
        (V3.replace(" fma ", " "), b"x86-64-v2"),
        (V3.replace(" fma ", " fma4 "), b"x86-64-v2"),  # names are whole words
        (V3.replace(" popcnt", ""), b"x86-64"),
        ("", b"x86-64"),
    ],
)
def test_the_best_whose_flags_are_all_there(flags: str, name: bytes) -> None:
    assert processor_name(cpuinfo(flags)) == name


@pytest.mark.parametrize(
    ("known", "flags", "name"),
    [
        ("rocketlake", V4, "skylake-avx512"),  # lacks CLWB: the library's functions would stay calls
        ("znver3", V4, "skylake-avx512"),  # a Zen 4
        ("znver2", V3, "haswell"),  # lacks INVPCID
        ("skylake-avx512", V4, None),
        ("haswell", V3, None),
        ("generic", V4, "skylake-avx512"),
        ("generic", BASE, "x86-64"),
        ("core2", BASE, None),
        ("nehalem", V2, None),
    ],
)
def test_the_name_of_the_library_is_preferred(known: str, flags: str, name: str | None) -> None:
    assert better_name(known, cpuinfo(flags)) == name


@pytest.mark.parametrize("text", ["", "processor : 0\nFeatures : fp asimd\n", "garbage", "flags"])
def test_other_files_give_the_base_name(text: str) -> None:
    assert processor_name(text) == b"x86-64"


def test_the_first_core_decides() -> None:
    assert processor_name(cpuinfo(V2) + cpuinfo(V4)) == b"x86-64-v2"


def test_name_fits_in_the_place_of_the_name_it_replaces() -> None:
    """The name is written over the C string "generic": malloc gives at least 24 bytes."""
    for flags in (BASE, V2, V3, V4):
        assert len(processor_name(cpuinfo(flags))) + 1 <= 24


def test_pocl_compiles_here() -> None:
    processors = [d for d in list_devices() if "pthread" in d.name]
    if not processors or not Path("/proc/cpuinfo").exists():
        pytest.skip("PoCL's CPU device is not installed")
    assert [d.usable for d in processors] == [None] * len(processors)


@pytest.mark.parametrize(
    ("version", "name"),
    [
        ("OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-znver3", "znver3"),
        ("OpenCL 3.0 PoCL HSTR: pthread-x86_64-pc-linux-gnu-skylake-avx512", "skylake-avx512"),
        ("OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-generic ", "generic"),
        ("OpenCL 3.0 CUDA 12.4.131", None),
        ("OpenCL 3.0 PoCL HSTR: CUDA-sm_90", None),
    ],
)
def test_the_name_that_pocl_has(version: str, name: str | None) -> None:
    assert known_name(SimpleNamespace(version=version)) == name  # type: ignore[arg-type]


OF_ANOTHER = """
import os
import pyopencl as cl
from server.opencl import pocl_cpu
devices = [d for p in cl.get_platforms() for d in p.get_devices() if pocl_cpu.known_name(d)]
assert pocl_cpu.rename(devices[0], pocl_cpu.known_name(devices[0]), b"haswell")
pocl_cpu.name_unknown_cpu = lambda device: None
from server.opencl import device
device.name_unknown_cpu = pocl_cpu.name_unknown_cpu
opened = device.open_device("pthread")
opened.programs.get("brick_pool.cl", {})
print("compiled", flush=True)
os._exit(0)  # under a name that its built-in functions are not of, PoCL does not end well
"""


def test_kernels_compile_where_a_float16_fits_no_register() -> None:
    """Most processors of laptops: no AVX-512. The name decides what clang compiles for, so any processor will do."""
    if not any(known_name(d) for p in cl.get_platforms() for d in p.get_devices()):
        pytest.skip("PoCL's CPU device is not installed")
    run = subprocess.run([sys.executable, "-c", OF_ANOTHER], capture_output=True, text=True, check=False, timeout=300)
    assert run.stdout.strip() == "compiled", run.stderr[-2000:]
