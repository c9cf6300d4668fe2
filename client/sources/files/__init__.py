"""Captures that are one file, or a folder that a program treats as one; the first bytes identify the format."""

from __future__ import annotations

from pathlib import Path

from client.errors import SourceError
from client.sources.files import record3d, ros_bag, scannet
from client.sources.frame_source import Source

_FORMATS = (record3d, scannet, ros_bag)
_HEAD_BYTES = 64
_MATROSKA = b"\x1aE\xdf\xa3"


def open_file(path: Path) -> Source | None:
    """The capture in a file; None: it is in none of these formats. Raises SourceError."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from error
    if head.startswith(_MATROSKA):
        raise SourceError(
            f"{path}: Matroska, as an Azure Kinect records, is not read: the SDK that reads it is no longer kept; "
            "convert it to a plain folder (docs/sources.md)"
        )
    return next((format_.open_file(path) for format_ in _FORMATS if format_.recognises(path, head)), None)


def looked_for() -> str:
    """What identifies each format, for error messages."""
    return "; ".join(format_.LOOKED_FOR for format_ in _FORMATS)
