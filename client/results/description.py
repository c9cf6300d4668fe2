"""Description of a run, for its page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from client.objects.object_file import ObjectFile
from client.sources.frame_source import Source
from protocol.frames import CameraModel


@dataclass(frozen=True)
class RunDescription:
    """Source and content of a run."""

    source: str
    """Name of the source."""
    camera: CameraModel
    fps: float
    """Frame rate of the source, 1/s: used where timestamps do not tell it."""
    total: int | None
    """Frames asked for; None: until it was stopped."""
    objects: tuple[str, ...] = ()
    """File names of the virtual objects, in their order."""


def describe(source: Source, total: int | None, objects: Sequence[ObjectFile]) -> RunDescription:
    """The description of a run over `total` frames of a source."""
    names = tuple(item.path.name for item in objects)
    return RunDescription(source.name, source.camera, source.fps, total, names)
