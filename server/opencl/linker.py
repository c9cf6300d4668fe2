"""Whether PoCL finds what it links kernels with. As a program, it notes what is missing, before anything is installed.

PoCL calls ld with libgcc and libc when a kernel first runs, and ends the process where that fails; compiling succeeds.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

CANNOT_LINK = "PoCL cannot link its kernels"
PROBE_S = 120
"""A linker that takes longer hangs."""
_LIBRARIES = ("usr/lib/*-linux-*", "usr/lib64", "usr/lib", "lib64", "lib")
_OLDEST_GCC = 12


def missing(root: Path = Path("/"), path: str | None = None) -> tuple[str, ...]:
    """Debian packages whose files are not seen below `root` and on `path` (default: $PATH). A guess elsewhere."""
    has_ld = shutil.which("ld", path=path) is not None
    has_libgcc = any(root.glob("usr/lib*/gcc*/*/*/libgcc.a"))
    has_libc = any(list(root.glob(f"{folder}/crti.o")) for folder in _LIBRARIES)
    found = {"binutils": has_ld, f"libgcc-{_gcc_version(root)}-dev": has_libgcc, "libc6-dev": has_libc}
    return tuple(name for name, is_there in found.items() if not is_there)


def advice(packages: tuple[str, ...]) -> str:
    """What is missing and the command that installs it, in one line."""
    return (
        f"{CANNOT_LINK} without {', '.join(packages)}; as root: apt-get install {' '.join(packages)} "
        "(where there is no apt-get: install gcc)"
    )


@cache
def why_not() -> str | None:
    """None if PoCL can link kernels here, else what to install. What only seems to be missing is tried."""
    packages = missing() if sys.platform == "linux" else ()
    return advice(packages) if packages and not _links() else None


def _links() -> bool:
    """Whether a kernel that is in no cache runs, in a process of its own, which PoCL may end."""
    above = str(Path(__file__).resolve().parents[2])
    with tempfile.TemporaryDirectory(prefix="probeless-link-") as folder:
        environment = {
            **os.environ,
            "POCL_CACHE_DIR": folder,
            "PYTHONPATH": os.pathsep.join(filter(None, (above, os.environ.get("PYTHONPATH")))),
        }
        command = [sys.executable, "-m", "server.opencl.link_probe"]
        try:
            done = subprocess.run(command, env=environment, capture_output=True, timeout=PROBE_S, check=False)
        except subprocess.TimeoutExpired:
            return False
    return done.returncode == 0


def _gcc_version(root: Path) -> int:
    """Version of the gcc whose runtime is installed, which every Debian has; 12 where that is not told."""
    names = (path.name for path in root.glob("usr/share/doc/gcc-*-base"))
    versions = [int(found[1]) for name in names if (found := re.fullmatch(r"gcc-(\d+)-base", name))]
    return max(versions, default=_OLDEST_GCC)


if __name__ == "__main__" and sys.platform == "linux" and (_packages := missing()):
    sys.stderr.write(f"note: {advice(_packages)}; a GPU with its own driver does not need them\n")
