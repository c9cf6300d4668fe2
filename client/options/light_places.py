"""Places at which the arriving light is asked for: `--light-at` and `--panorama-out`."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

from client.errors import OptionError
from protocol.limits import MAX_LIGHT_PLACES
from protocol.messages import PanoramaFormat, Vector3


@dataclass(frozen=True)
class PanoramaOut:
    """A lat-long picture to write after the last frame."""

    path: Path
    format: PanoramaFormat
    position_m: Vector3 | None
    """World; None: at the first object, else at the middle of what the last frame sees."""


def parse_light_at(texts: list[str] | None) -> tuple[Vector3, ...]:
    """Each `x,y,z` in world metres. Raises OptionError, also for too many."""
    places = tuple(_place(f"--light-at {text}", text) for text in texts or ())
    if len(places) > MAX_LIGHT_PLACES:
        raise OptionError(f"--light-at: {len(places)} places were named, at most {MAX_LIGHT_PLACES} are told")
    return places


def parse_panorama_out(text: str | None) -> PanoramaOut | None:
    """`FILE.hdr|.exr[@x,y,z]`; FILE may contain an @. Raises OptionError, also if the file cannot be written."""
    if text is None:
        return None
    name, at, place = text.rpartition("@")
    if not at or _format(name) is None:
        name, place = text, ""
    format_ = _format(name)
    if format_ is None:
        raise OptionError(f"--panorama-out {text}: expected FILE.hdr or FILE.exr, and @x,y,z behind it for a place")
    position_m = _place(f"--panorama-out {text}", place) if place or name != text else None
    path = Path(name)
    _check_writable(path)
    return PanoramaOut(path, format_, position_m)


def write_panorama(path: Path, data: bytes) -> None:
    """Raises OptionError if the disk refuses."""
    try:
        path.write_bytes(data)
    except OSError as error:
        raise _unwritable(path, error.strerror) from error


def _format(name: str) -> PanoramaFormat | None:
    suffix = Path(name).suffix.lower()
    return "hdr" if suffix == ".hdr" else "exr" if suffix == ".exr" else None


def _place(option: str, text: str) -> Vector3:
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        raise OptionError(f"{option}: expected x,y,z, finite numbers in metres")
    return x, y, z


def _check_writable(path: Path) -> None:
    """A file that cannot be written is an error before the frames, not after."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(path, error.strerror) from error
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise _unwritable(path, "it is a folder" if path.is_dir() else "permission denied")


def _unwritable(path: Path, reason: str | None) -> OptionError:
    return OptionError(f"--panorama-out {path}: cannot be written ({reason}); name another file")
