"""Decodes one session's colour payloads to arrays: independent images, and video, which needs reference frames."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from protocol.codec import ProtocolError
from protocol.frames import CameraModel
from protocol.h264 import VideoOrder
from protocol.images import Color, decode_color, decode_picture
from protocol.messages import ColorCodec, ColorImage
from protocol.video import IS_POSSIBLE, VideoDecoder

NO_VIDEO = "color.codec is h264, which needs PyAV to be read (make install-video); a client sends jpeg (welcome.codecs)"


def readable_codecs() -> tuple[ColorCodec, ...]:
    """Colour codecs that this installation can decode."""
    return ("jpeg", "png", "raw", "h264") if IS_POSSIBLE else ("jpeg", "png", "raw")


class Video(Protocol):
    """Decodes one session's video."""

    def decode(self, data: bytes) -> NDArray[np.uint8]:
        """[h, w, 3] RGB of a validated picture. Raises ProtocolError; the decoder's state is then lost."""

    def close(self) -> None:
        """Free the decoder."""


class ColorReader:
    """Not thread-safe. Must receive every frame in order."""

    def __init__(
        self,
        camera: CameraModel,
        decompress: Callable[[bytes], NDArray[np.uint8]] = decode_picture,
        open_video: Callable[[], Video] | None = None,
    ) -> None:
        """`decompress` decodes a JPEG or PNG whose header is validated. `open_video` creates the video decoder at the
        first video picture (default: in this process).
        """
        self._camera = camera
        self._decompress = decompress
        self._open_video = open_video or _VideoHere
        self._video: Video | None = None
        self._order = VideoOrder()

    def decode(self, image: ColorImage) -> Color:
        """As protocol.images.decode_color, for any codec. Raises ProtocolError."""
        return decode_color(image, self._camera, decompress=self._decompress, video=self._next_of_video)

    def close(self) -> None:
        """Close the video decoder, if any."""
        if self._video is not None:
            self._video.close()

    def _next_of_video(self, image: ColorImage) -> NDArray[np.uint8]:
        if not IS_POSSIBLE:
            raise ProtocolError(NO_VIDEO)
        self._order.admit(image.data, image.width, image.height)
        if self._video is None:
            self._video = self._open_video()
        try:
            return self._video.decode(image.data)
        except ProtocolError:
            self._order.begin_anew()
            raise


class _VideoHere:
    def __init__(self) -> None:
        self._decoder = VideoDecoder()

    def decode(self, data: bytes) -> NDArray[np.uint8]:
        try:
            return self._decoder.decode(data)
        except ProtocolError:
            self._decoder = VideoDecoder()
            raise

    def close(self) -> None:
        pass
