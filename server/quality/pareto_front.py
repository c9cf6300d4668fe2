"""Accuracy against time on one device: measured operating points, kept in the user's cache directory (U1).

A device that was not measured begins with the front that comes with the program, of another machine: errors are of
sampling and hold everywhere; times are learnt row by row while frames run.
"""

from __future__ import annotations

import hashlib
import os
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import msgspec
from msgspec import Struct
from platformdirs import user_cache_path

from server.quality.sampling_settings import SamplingSettings

SAME_ERROR_DEG = 0.1
"""Light errors that differ by less count as equal: frames vary by more."""
SAME_PICTURE_ERROR = 0.02
"""Picture errors with a smaller relative difference count as equal."""


class ParetoPoint(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One measured operating point."""

    point: SamplingSettings
    ms: dict[str, float]
    """Median milliseconds of a frame by row of `Timings`, without `total`, and `other`."""
    light_error_deg: float
    """Error of the dominant direction, median over frames."""
    picture_error: float
    """Mean difference from the true composite where virtual objects change it, in display units (1 is 1/255)."""

    @property
    def total_ms(self) -> float:
        """Median time of a frame."""
        return sum(self.ms.values())


class ParetoFront(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """All measurements of one device."""

    device: str
    version: str
    measured: str
    """Date, ISO."""
    scene: str
    points: tuple[ParetoPoint, ...]
    """All measured points, dominated ones too."""

    def best(self) -> tuple[ParetoPoint, ...]:
        """The Pareto front: points more accurate than all faster ones, fastest first."""
        found: list[ParetoPoint] = []
        for point in sorted(self.points, key=lambda p: (p.total_ms, p.light_error_deg)):
            if not found or _is_better(point, found[-1]):
                found.append(point)
        return tuple(found)


class FrontError(ValueError):
    """A front cannot be read; the message says what to do."""


SHIPPED = Path(__file__).with_name("shipped_front.json")
"""Written by `probeless tune` on the machine that it names."""


def _is_better(a: ParetoPoint, b: ParetoPoint) -> bool:
    if abs(a.light_error_deg - b.light_error_deg) > SAME_ERROR_DEG:
        return a.light_error_deg < b.light_error_deg
    return a.picture_error < (1 - SAME_PICTURE_ERROR) * b.picture_error


def own_version() -> str:
    """Version of the program; fronts of other versions are not used."""
    try:
        return version("probeless")
    except PackageNotFoundError:
        return "unknown"


def front_path(device: str) -> Path:
    """File of a device's front, in the user's cache directory or in the folder PROBELESS_FRONTS."""
    folder = os.environ.get("PROBELESS_FRONTS")
    base = Path(folder) if folder else user_cache_path("probeless") / "fronts"
    key = hashlib.sha256(f"{device}\n{own_version()}".encode()).hexdigest()[:16]
    return base / f"{key}.json"


def write_front(front: ParetoFront) -> Path:
    """Write a front atomically. Raises OSError."""
    path = front_path(front.device)
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(f".{os.getpid()}")
    beside.write_bytes(msgspec.json.format(msgspec.json.encode(front), indent=1))
    beside.replace(path)
    return path


def read_front(device: str) -> ParetoFront:
    """The front of the device, else the one that comes with the program. Raises FrontError if it is unreadable."""
    own = front_path(device)
    path = own if own.exists() else SHIPPED
    advice = "run `probeless tune`, or choose a --preset"
    try:
        front = msgspec.json.decode(path.read_bytes(), type=ParetoFront)
    except (OSError, msgspec.MsgspecError) as error:
        raise FrontError(f"{path} cannot be read ({error}): {advice}") from error
    if not front.points:
        raise FrontError(f"{path} has no points: {advice}")
    return front
