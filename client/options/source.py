"""The SOURCE argument of the command line."""

from __future__ import annotations

from pathlib import Path

from client.errors import SourceError
from client.sources.frame_source import GALLERY_PREFIX, Source

SYNTHETIC_PREFIX = "synthetic:"
OAK_PREFIX = "oak?"


def open_source(spec: str) -> Source:
    """Open a data-set folder, another program's capture, `synthetic:NAME[?key=value&...]`, a recording, or
    `oak[?vio=off]`.

    Raises SourceError.
    """
    if spec == "oak" or spec.startswith(OAK_PREFIX):
        from client.sources.oak.source import open_oak

        return open_oak(spec.removeprefix("oak").removeprefix("?"))
    if spec.startswith(GALLERY_PREFIX):
        from client.gallery.source import GallerySource

        return GallerySource(spec.removeprefix(GALLERY_PREFIX))
    if spec.startswith(SYNTHETIC_PREFIX):
        from client.synthetic.source import open_synthetic

        return open_synthetic(spec)
    path = Path(spec).expanduser()
    if path.is_dir():
        from client.sources.datasets import open_folder
        from client.sources.files.ros_bag import is_bag_folder
        from client.sources.files.ros_bag import open_file as open_bag

        return open_bag(path) if is_bag_folder(path) else open_folder(path)
    if path.is_file():
        from client.sources.files import open_file
        from client.sources.recording import open_recording

        return open_file(path) or open_recording(path)
    raise SourceError(f"{spec}: no such folder or file; give a data-set folder, a recording, synthetic:table or oak")
