"""The processor's name that PoCL is told for a processor it does not know."""

from __future__ import annotations

from pathlib import Path

import pytest

from server.opencl.device import list_devices
from server.opencl.pocl_cpu import processor_name

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
