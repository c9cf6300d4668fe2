"""What accuracy costs in time on one device: its measured operating points, kept in the user's cache directory (U1)."""

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
"""Light errors that differ by less are the same: frames scatter by more."""
SAME_PICTURE_ERROR = 0.02
"""Relative, likewise."""


class ParetoPoint(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One operating point as it was measured."""

    point: SamplingSettings
    ms: dict[str, float]
    """Median milliseconds of a frame, under the rows of `Timings` without `total`, and `other`."""
    light_error_deg: float
    """Of the dominant direction, median over frames."""
    picture_error: float
    """Mean difference from the true composite where virtual objects change it, in display units (1 is 1/255)."""

    @property
    def total_ms(self) -> float:
        """Of a frame."""
        return sum(self.ms.values())


class ParetoFront(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What was measured on one device."""

    device: str
    version: str
    measured: str
    """Date, ISO."""
    scene: str
    points: tuple[ParetoPoint, ...]
    """All that were measured."""

    def best(self) -> tuple[ParetoPoint, ...]:
        """Those that no faster one is as good as, fastest first: each next one errs less."""
        found: list[ParetoPoint] = []
        for point in sorted(self.points, key=lambda p: (p.total_ms, p.light_error_deg)):
            if not found or _is_better(point, found[-1]):
                found.append(point)
        return tuple(found)


class NoFrontError(ValueError):
    """The device was not measured; one line that says what to do."""


def _is_better(a: ParetoPoint, b: ParetoPoint) -> bool:
    if abs(a.light_error_deg - b.light_error_deg) > SAME_ERROR_DEG:
        return a.light_error_deg < b.light_error_deg
    return a.picture_error < (1 - SAME_PICTURE_ERROR) * b.picture_error


def own_version() -> str:
    """Of the program: a front of another one is none."""
    try:
        return version("probeless")
    except PackageNotFoundError:
        return "unknown"


def front_path(device: str) -> Path:
    """Where a device's front is kept; PROBELESS_FRONTS names another folder than the user's cache directory."""
    folder = os.environ.get("PROBELESS_FRONTS")
    base = Path(folder) if folder else user_cache_path("probeless") / "fronts"
    key = hashlib.sha256(f"{device}\n{own_version()}".encode()).hexdigest()[:16]
    return base / f"{key}.json"


def write_front(front: ParetoFront) -> Path:
    """Keep a front, whole or not at all. Raises OSError."""
    path = front_path(front.device)
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(f".{os.getpid()}")
    beside.write_bytes(msgspec.json.format(msgspec.json.encode(front), indent=1))
    beside.replace(path)
    return path


def read_front(device: str) -> ParetoFront:
    """The device's front. Raises NoFrontError where there is none, or none that can be read."""
    path = front_path(device)
    advice = "run `probeless tune`, or choose a --preset"
    try:
        front = msgspec.json.decode(path.read_bytes(), type=ParetoFront)
    except FileNotFoundError:
        raise NoFrontError(f"what accuracy costs on {device} was not measured yet: {advice}") from None
    except (OSError, msgspec.MsgspecError) as error:
        raise NoFrontError(f"{path} cannot be read ({error}): {advice}") from error
    if not front.points:
        raise NoFrontError(f"{path} has no points: {advice}")
    return front
