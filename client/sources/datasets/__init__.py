"""Readers of data-set folders; the layout is recognised by its files."""

from __future__ import annotations

from pathlib import Path

from client.errors import SourceError
from client.sources.datasets import ground_truth, redwood, seven_scenes, tum
from client.sources.datasets.folder import FolderSource

LAYOUTS = (ground_truth, tum, seven_scenes, redwood)
"""Each has LOOKED_FOR (words for the user), `recognises(folder)` and `open_folder(folder)`."""


def open_folder(folder: Path) -> FolderSource:
    """The data set in `folder`. Raises SourceError: what was looked for, or what is wrong with what was found."""
    for layout in LAYOUTS:
        if layout.recognises(folder):
            return layout.open_folder(folder)
    looked_for = "; ".join(layout.LOOKED_FOR for layout in LAYOUTS)
    raise SourceError(f"{folder}: is no data set that is known here; looked for {looked_for}")
