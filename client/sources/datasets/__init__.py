"""Readers of data-set folders; the files identify the layout."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from client.errors import SourceError
from client.sources.datasets import ground_truth, redwood, seven_scenes, tum
from client.sources.datasets.folder import FolderSource


class Layout(Protocol):
    """Interface of a module that reads one layout."""

    LOOKED_FOR: str
    """Files that identify the layout, for error messages."""

    def recognises(self, folder: Path) -> bool: ...

    def open_folder(self, folder: Path) -> FolderSource: ...


LAYOUTS: tuple[Layout, ...] = (ground_truth, tum, seven_scenes, redwood)


def open_folder(folder: Path) -> FolderSource:
    """The data set in `folder`. Raises SourceError for an unknown layout or a damaged data set."""
    for layout in LAYOUTS:
        if layout.recognises(folder):
            return layout.open_folder(folder)
    looked_for = "; ".join(layout.LOOKED_FOR for layout in LAYOUTS)
    raise SourceError(f"{folder}: is no data set that is known here; looked for {looked_for}")
