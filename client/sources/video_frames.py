"""Pictures of a video file by their number."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from client.errors import SourceError


class VideoFrames:
    """Pictures as they are stored, not turned as a player would. Reading in order decodes each picture once.

    A jump backwards starts from the beginning: seeking in H.264 and HEVC by time is not exact to the picture.
    """

    def __init__(self, path: Path) -> None:
        """Raises SourceError if the file is no video."""
        self._path = path
        self._open()
        self.width = int(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        self.height = int(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        self._count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, number: int) -> NDArray[np.uint8]:
        """[height, width, 3] RGB. Raises SourceError."""
        if number < self._next:
            self._open()
        while self._next < number and self._capture.grab():
            self._next += 1
        done, picture = self._capture.read()
        if not done:
            raise SourceError(f"{self._path}: picture {number} of {self._count} cannot be decoded; copy the file again")
        self._next += 1
        return np.ascontiguousarray(picture[..., ::-1], np.uint8)

    def _open(self) -> None:
        self._capture = cv2.VideoCapture(str(self._path))
        self._next = 0
        if not self._capture.isOpened():
            raise SourceError(f"{self._path}: is no video that can be decoded")
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
