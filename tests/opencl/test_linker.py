"""What PoCL links kernels with is looked for before the first kernel, which would end the process."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from server.opencl import linker
from tests.data import ROOT


def made(root: Path, *names: str) -> None:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch(mode=0o755)


def test_all_is_named_on_a_bare_machine(tmp_path: Path) -> None:
    made(tmp_path, "usr/share/doc/gcc-14-base/copyright", "usr/lib/x86_64-linux-gnu/libc.so.6")
    assert linker.missing(tmp_path, str(tmp_path / "bin")) == ("binutils", "libgcc-14-dev", "libc6-dev")
    assert linker.missing(tmp_path / "none", "")[1] == "libgcc-12-dev"


@pytest.mark.parametrize(
    ("libgcc", "libc"),
    [
        ("usr/lib/gcc/x86_64-linux-gnu/12/libgcc.a", "usr/lib/x86_64-linux-gnu/crti.o"),
        ("usr/lib/gcc/x86_64-redhat-linux/14/libgcc.a", "usr/lib64/crti.o"),
        ("usr/lib/gcc/aarch64-linux-gnu/13/libgcc.a", "usr/lib/aarch64-linux-gnu/crti.o"),
    ],
)
def test_nothing_is_missing_where_gcc_is(tmp_path: Path, libgcc: str, libc: str) -> None:
    made(tmp_path, "bin/ld", libgcc, libc)
    assert linker.missing(tmp_path, str(tmp_path / "bin")) == ()
    (tmp_path / libc).unlink()
    assert linker.missing(tmp_path, str(tmp_path / "bin")) == ("libc6-dev",)


def test_what_only_seems_to_be_missing_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(linker, "missing", lambda: ("libc6-dev",))
    linker.why_not.cache_clear()
    try:
        assert linker.why_not() is None
    finally:
        linker.why_not.cache_clear()


def without_ld(tmp_path: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Python in a process that finds no program, with an empty cache of kernels."""
    environment = {
        **os.environ,
        "PATH": str(tmp_path / "bin"),
        "POCL_CACHE_DIR": str(tmp_path / "pocl"),
        "PYTHONPATH": str(ROOT),
    }
    command = [sys.executable, *words]
    return subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300, check=False
    )


@pytest.mark.skipif(not (Path("/etc/debian_version").exists()), reason="this machine's hardware: not a Debian")
def test_a_server_without_ld_says_what_to_install(tmp_path: Path) -> None:
    code = "from server.opencl.device import open_device; open_device('portable')"
    done = without_ld(tmp_path, "-c", code)
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert "PoCL cannot link its kernels without binutils; as root: apt-get install binutils " in last
    assert "vendor driver" not in last


def test_make_notes_it_before_it_installs(tmp_path: Path) -> None:
    done = without_ld(tmp_path, str(ROOT / "server" / "opencl" / "linker.py"))
    assert done.returncode == 0
    assert done.stderr.startswith("note: PoCL cannot link its kernels without binutils")
    assert done.stderr.count("\n") == 1
