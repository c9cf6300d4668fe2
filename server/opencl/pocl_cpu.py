"""Lets PoCL compile for processors newer than the LLVM it was built with.

PoCL asks LLVM for the host processor's name and hands it to clang. LLVM answers "generic" for an x86 processor it does
not know (an AMD Zen 5 with the LLVM 14 of PoCL 3.0), clang refuses that name, and no kernel compiles; and it takes a
Zen 4 for a Zen 3, which has no AVX-512, while PoCL takes the built-in functions that have it. No option of PoCL
overrides the name. It is a C string that the device structure points to: it is replaced in place.

Which name matters: PoCL's own library of built-in functions comes compiled for `skylake-avx512` or `haswell`, and LLVM
inlines a function only into code for a processor that has all of its features, those too that no compiler uses (CLWB,
which a Rocket Lake lacks; INVPCID, which a Zen 2 lacks). Else each `fmin`, `dot` or `vload8` stays a call, and kernels
take up to twice as long. So the name is that of the library, whatever LLVM takes the processor for.
"""

from __future__ import annotations

import ctypes
import platform
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pyopencl as cl

_UNKNOWN = "generic"
_DEVICE_STRUCT_BYTES = 4096
_V2 = frozenset({"sse4_1", "sse4_2", "ssse3", "popcnt"})
_V3 = _V2 | {"avx2", "bmi1", "bmi2", "fma", "f16c", "movbe"}
_AVX512, _AVX2 = "skylake-avx512", "haswell"
"""What PoCL's library is compiled for."""
_NAMES = (  # with the features that compilers use unasked; what else the name stands for, programs must ask for
    (_AVX512.encode(), _V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}),
    (_AVX2.encode(), _V3),
    (b"x86-64-v2", _V2),
)


def processor_name(cpuinfo: str) -> bytes:
    """The best processor that LLVM 14 knows whose features /proc/cpuinfo lists."""
    flags: set[str] = set()
    for line in cpuinfo.splitlines():
        if line.startswith("flags"):
            flags = set(line.partition(":")[2].split())
            break
    return next((name for name, needed in _NAMES if needed <= flags), b"x86-64")


def is_pocl(platform: cl.Platform) -> bool:
    """Whether a platform is PoCL."""
    return "portable computing language" in str(platform.name).lower()


def name_unknown_cpu(device: cl.Device) -> str | None:
    """If `device` is PoCL's CPU under a name that is none or hinders it, give it a better one; that one, else None."""
    known = known_name(device)
    if known is None or platform.machine() != "x86_64" or not Path("/proc/self/mem").exists():
        return None
    better = better_name(known, Path("/proc/cpuinfo").read_text())
    return better if better is not None and rename(device, known, better.encode()) else None


def better_name(known: str, cpuinfo: str) -> str | None:
    """The name to compile for where PoCL compiles for `known`; None: that one."""
    best = processor_name(cpuinfo).decode()
    is_better = known == _UNKNOWN or (best in (_AVX512, _AVX2) and best != known)
    return best if is_better else None


def known_name(device: cl.Device) -> str | None:
    """The processor's name that PoCL had from LLVM; None where this is another device.

    The version says it behind the triple: `OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-znver3`.
    """
    _, found, rest = str(device.version).partition("HSTR: pthread-x86_64-")
    return rest.split("-gnu-")[-1].strip() if found else None


def rename(device: cl.Device, known: str, better: bytes) -> bool:
    """Write `better`, of at most 23 bytes, over the name `known` that the structure points to; whether it was found."""
    wanted = known.encode() + b"\0"
    structure = ctypes.string_at(device.int_ptr, _DEVICE_STRUCT_BYTES)
    with Path("/proc/self/mem").open("rb", buffering=0) as memory:
        for offset in range(0, _DEVICE_STRUCT_BYTES, 8):
            address = int.from_bytes(structure[offset : offset + 8], "little")
            if _reads(memory, address, len(wanted)) == wanted:
                ctypes.memmove(address, better + b"\0", len(better) + 1)  # malloc gives 24 bytes or more
                return True
    return False


def _reads(memory: object, address: int, count: int) -> bytes:
    """Bytes at `address`, or b"" where nothing is mapped; the kernel checks the address, so a wrong one is safe."""
    if not 4096 <= address < 1 << 47:
        return b""
    try:
        memory.seek(address)  # type: ignore[attr-defined]
        return memory.read(count)  # type: ignore[attr-defined, no-any-return]
    except OSError:
        return b""
