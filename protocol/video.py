"""Decodes H.264 pictures to RGB with PyAV (FFmpeg), if installed. They are validated by protocol.h264 before."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.codec import ProtocolError

IS_POSSIBLE = find_spec("av") is not None
"""Whether PyAV is installed."""
OPTIONS = {"flags": "low_delay", "err_detect": "explode"}
"""Output each picture at once; report damaged pictures as errors instead of concealing them."""


class VideoDecoder:
    """Decoder of one stream. Not thread-safe."""

    def __init__(self) -> None:
        """Raises ImportError if PyAV is missing."""
        import av
        from av.video.reformatter import ColorRange, Colorspace

        self._av = av
        self._decoder = av.CodecContext.create("h264", "r")
        self._decoder.options = dict(OPTIONS)
        self._decoder.thread_count = 1
        self._unsaid = {"src_colorspace": Colorspace.ITU601, "src_color_range": ColorRange.JPEG}
        self._matrices = {1: Colorspace.ITU709, 7: Colorspace.SMPTE240M}
        self._limited = ColorRange.MPEG

    def decode(self, data: bytes) -> NDArray[np.uint8]:
        """One picture -> [h, w, 3] sRGB. Raises ProtocolError; the next one must then be a key picture."""
        try:
            pictures = self._decoder.decode(self._av.Packet(data))
        except self._av.FFmpegError as error:
            raise ProtocolError(f"color.data cannot be decoded as h264: {error.strerror}") from error
        if len(pictures) != 1 or pictures[0].format.name not in ("yuv420p", "yuvj420p"):
            raise ProtocolError("color.data cannot be decoded as h264: it is not one picture of 4:2:0")
        # One thread, as of the decoder: the server's readers may start none.
        converted = pictures[0].reformat(format="rgb24", threads=1, **self._color_of(pictures[0]))
        return np.asarray(converted.to_ndarray(), np.uint8)

    def _color_of(self, picture: Any) -> dict[str, Any]:
        """Set colour matrix and range to those of the stream; the default is that of JPEG."""
        said = dict(self._unsaid)
        if picture.colorspace in self._matrices:
            said["src_colorspace"] = self._matrices[picture.colorspace]
        if picture.color_range == self._limited:
            said["src_color_range"] = self._limited
        return said
