"""Lets PoCL compile for processors newer than the LLVM it was built with.

PoCL asks LLVM for the host processor's name and hands it to clang. LLVM answers "generic" for an x86 processor it does
not know (an AMD Zen 5 with the LLVM 14 of PoCL 3.0), clang refuses that name, and no kernel compiles; no option of PoCL
overrides it. The name is a C string that the device structure points to: it is replaced in place by the x86-64 feature
level (psABI: v2 or v3; v4 measured no faster) that this processor has.
"""

from __future__ import annotations

import ctypes
import platform
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pyopencl as cl

_UNKNOWN = b"generic\0"
_DEVICE_STRUCT_BYTES = 4096
_LEVELS = (
    (b"x86-64-v3", {"avx2", "bmi1", "bmi2", "fma", "f16c", "movbe"}),
    (b"x86-64-v2", {"sse4_1", "sse4_2", "ssse3", "popcnt"}),
)


def feature_level(cpuinfo: str) -> bytes:
    """The highest x86-64 feature level whose flags /proc/cpuinfo lists."""
    flags: set[str] = set()
    for line in cpuinfo.splitlines():
        if line.startswith("flags"):
            flags = set(line.partition(":")[2].split())
            break
    level = b"x86-64"
    for name, needed in reversed(_LEVELS):
        if not needed <= flags:
            break
        level = name
    return level


def name_unknown_cpu(device: cl.Device) -> str | None:
    """If `device` is PoCL's CPU under the name "generic", give it one clang knows; return the name, else None."""
    if "pthread" not in device.name or platform.machine() != "x86_64" or not Path("/proc/self/mem").exists():
        return None
    level = feature_level(Path("/proc/cpuinfo").read_text())
    structure = ctypes.string_at(device.int_ptr, _DEVICE_STRUCT_BYTES)
    with Path("/proc/self/mem").open("rb", buffering=0) as memory:
        for offset in range(0, _DEVICE_STRUCT_BYTES, 8):
            address = int.from_bytes(structure[offset : offset + 8], "little")
            if _reads(memory, address, len(_UNKNOWN)) == _UNKNOWN:
                ctypes.memmove(address, level + b"\0", len(level) + 1)  # malloc gives 24 bytes or more
                return level.decode()
    return None


def _reads(memory: object, address: int, count: int) -> bytes:
    """Bytes at `address`, or b"" where nothing is mapped; the kernel checks the address, so a wrong one is safe."""
    if not 4096 <= address < 1 << 47:
        return b""
    try:
        memory.seek(address)  # type: ignore[attr-defined]
        return memory.read(count)  # type: ignore[attr-defined, no-any-return]
    except OSError:
        return b""
