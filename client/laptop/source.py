"""Where frames come from: one interface over data-set folders, synthetic scenes, recordings and cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from client.laptop.errors import SourceError
from protocol.frames import CameraModel, RgbdFrame

__all__ = ["Source", "SourceError", "open_source"]

SYNTHETIC_PREFIX = "synthetic:"
GALLERY_PREFIX = "synthetic:gallery/"
OAK_PREFIX = "oak?"
ENDLESS = 2**31
"""Length of a source that goes on until it is stopped: a camera."""


class Source(Protocol):
    """A sequence of RGB-D frames of one camera. Indexing may raise SourceError naming the damaged file."""

    @property
    def name(self) -> str: ...

    @property
    def camera(self) -> CameraModel: ...

    @property
    def fps(self) -> float: ...

    @property
    def has_poses(self) -> bool:
        """Every frame has its `world_from_camera`."""

    @property
    def up(self) -> tuple[float, float, float] | None:
        """World direction, where the source knows it."""

    def __len__(self) -> int:
        """`ENDLESS` of a camera."""

    def __getitem__(self, index: int) -> RgbdFrame:
        """The frame of that number; of a camera, its newest, given that number."""


def is_live(source: Source) -> bool:
    """True of a camera: frames come when they come, and go on."""
    return len(source) == ENDLESS


def open_source(spec: str) -> Source:
    """The source that `spec` names: a folder, `synthetic:NAME[?key=value&...]`, a recording's file, `oak[?vio=off]`.

    Raises SourceError.
    """
    if spec == "oak" or spec.startswith(OAK_PREFIX):
        from client.laptop.oak import open_oak

        return open_oak(spec.removeprefix("oak").removeprefix("?"))
    if spec.startswith(GALLERY_PREFIX):
        from client.laptop.gallery.source import GallerySource

        return GallerySource(spec.removeprefix(GALLERY_PREFIX))
    if spec.startswith(SYNTHETIC_PREFIX):
        from client.laptop.synthetic.source import open_synthetic

        return open_synthetic(spec)
    path = Path(spec).expanduser()
    if path.is_dir():
        from client.laptop.datasets import open_folder

        return open_folder(path)
    if path.is_file():
        from client.laptop.recorded import open_recording

        return open_recording(path)
    raise SourceError(f"{spec}: no such folder or file; give a data-set folder, a recording, synthetic:table or oak")
