"""Colour as H.264 video through PyAV (x264): no delay between pictures, key pictures only where needed."""

from __future__ import annotations

import threading
from fractions import Fraction
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.messages import ColorImage

IS_POSSIBLE = find_spec("av") is not None
"""Whether PyAV is installed."""
PRESET = "superfast"
RATE_FACTORS = ((50, 25.0), (65, 22.0), (75, 20.0), (80, 19.0), (90, 17.0), (100, 10.0))
"""(JPEG quality, x264 rate factor) with about the same error, up to quality 80 (`probeless bench client`)."""
_ENDLESS = 1 << 30


class VideoEncoder:
    """Encoder of one session. Call `encode` from one thread at a time, in the order of sending."""

    def __init__(self) -> None:
        """Raises ImportError without PyAV."""
        import av
        from av.video.frame import PictureType
        from av.video.reformatter import ColorRange, Colorspace

        self._av = av
        self._key, self._by_itself = PictureType.I, PictureType.NONE
        self._color = {"dst_colorspace": Colorspace.ITU601, "dst_color_range": ColorRange.JPEG}
        self._encoder: Any = None
        self._setting: tuple[int, int, float] | None = None
        self._count = 0
        self._needs_key = threading.Event()

    def need_key(self) -> None:
        """Make the next picture a key picture, because an earlier one was lost. Thread-safe."""
        self._needs_key.set()

    def can_encode(self, width: int, height: int) -> bool:
        """4:2:0 requires even sides."""
        return width % 2 == 0 and height % 2 == 0

    def encode(self, rgb: NDArray[np.uint8], quality: int) -> ColorImage:
        """Encode [h, w, 3] sRGB; `quality` as for JPEG. A new size or quality starts with a key picture."""
        height, width = rgb.shape[:2]
        setting = (width, height, rate_factor(quality))
        if setting != self._setting:
            self._encoder, self._setting = self._opened(*setting), setting
        picture = self._av.VideoFrame.from_ndarray(rgb, "rgb24").reformat(format="yuv420p", **self._color)
        picture.pts = self._count
        picture.pict_type = self._by_itself
        if self._needs_key.is_set():
            self._needs_key.clear()
            picture.pict_type = self._key
        self._count += 1
        data = b"".join(bytes(packet) for packet in self._encoder.encode(picture))
        return ColorImage(width=width, height=height, data=data, codec="h264")

    def _opened(self, width: int, height: int, factor: float) -> Any:
        encoder = self._av.CodecContext.create("libx264", "w")
        encoder.width, encoder.height, encoder.pix_fmt = width, height, "yuv420p"
        encoder.time_base, encoder.framerate = Fraction(1, 30), Fraction(30)
        encoder.color_range, encoder.colorspace = 2, 6  # full range, BT.601, as JPEG; written into the stream
        encoder.gop_size = _ENDLESS
        encoder.thread_count = 1
        encoder.options = {"preset": PRESET, "tune": "zerolatency", "crf": f"{factor:g}", "forced-idr": "1"}
        return encoder


def rate_factor(quality: int) -> float:
    """Rate factor of x264 for a JPEG quality."""
    qualities, factors = zip(*RATE_FACTORS, strict=True)
    return round(float(np.interp(quality, qualities, factors)), 1)
