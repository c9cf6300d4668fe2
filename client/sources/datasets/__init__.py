"""Readers of data-set folders; the files identify the layout."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from client.errors import SourceError
from client.sources.datasets import arkit_scenes, ground_truth, plain, redwood, seven_scenes, stray, tum
from client.sources.frame_source import Source


class Layout(Protocol):
    """Interface of a module that reads one layout."""

    LOOKED_FOR: str
    """Files that identify the layout, for error messages."""

    def recognises(self, folder: Path) -> bool: ...

    def open_folder(self, folder: Path) -> Source: ...


LAYOUTS: tuple[Layout, ...] = (ground_truth, plain, tum, seven_scenes, stray, arkit_scenes, redwood)


def open_folder(folder: Path) -> Source:
    """The data set in `folder`. Raises SourceError for an unknown layout or a damaged data set."""
    for layout in LAYOUTS:
        if layout.recognises(folder):
            return layout.open_folder(folder)
    looked_for = "; ".join(layout.LOOKED_FOR for layout in LAYOUTS)
    raise SourceError(f"{folder}: is no data set that is known here; looked for {looked_for}")
