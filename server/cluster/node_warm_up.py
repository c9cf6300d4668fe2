"""Warms up a node once: the first host compiles the kernels and runs the self-check, later hosts skip both.

This saves several seconds when a room moves to another node.
"""

from __future__ import annotations

import hashlib
import socket
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from platformdirs import user_cache_path

if TYPE_CHECKING:
    from server.opencl.device import Device

GOOD_FOR_S = 3600.0
"""After this time the next host runs the self-check again."""


def warm_up_node(device: Device, warm_up: Callable[[Device], object], folder: Path | None = None) -> bool:
    """Warm up unless this node has done so recently with this device and version. Returns whether it ran.

    Raises what `warm_up` raises; the next host then tries again.
    """
    stamp = (folder or user_cache_path("probeless") / "warm") / _name(device)
    if _age_s(stamp) < GOOD_FOR_S:
        return False
    warm_up(device)
    stamp.parent.mkdir(parents=True, exist_ok=True)
    stamp.touch()
    return True


def _age_s(stamp: Path) -> float:
    try:
        return abs(time.time() - stamp.stat().st_mtime)
    except FileNotFoundError:
        return float("inf")


def _name(device: Device) -> str:
    said = "\n".join((socket.gethostname(), device.name, version("probeless"), version("pyopencl")))
    return hashlib.sha256(said.encode()).hexdigest()[:32]
