"""`video.mp4`: the composites of a run as H.264 that browsers play, at the times at which they were taken."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.errors import OutputError

TICKS_PER_S = 90_000
"""Time base of MPEG; every usual frame rate is a whole number of ticks."""
RATE_FACTOR, PRESET = 18, "veryfast"
"""Settings of x264: a video of rate factor 18 is hardly distinguishable from its source."""
KEY_PICTURE_EVERY = 30
"""Number of pictures from one key picture to the next: few enough that a player finds any place quickly."""
LONGEST_PAUSE_S = 5.0
"""A longer time between two frames is shortened to this."""


class VideoFile:
    """Writes one MP4 file while frames arrive."""

    def __init__(self, path: Path, fps: float) -> None:
        """`fps`: frame rate where timestamps do not tell it. Raises ImportError without PyAV."""
        import av
        from av.video.reformatter import ColorRange, Colorspace

        self._av, self._path = av, path
        self._color = {"dst_colorspace": Colorspace.ITU709, "dst_color_range": ColorRange.MPEG}
        self._step = max(1, round(TICKS_PER_S / fps)) if fps > 0 else TICKS_PER_S // 30
        self._container: Any = None
        self._stream: Any = None
        self._ticks = 0
        self._last_s: float | None = None

    def add(self, color: NDArray[np.uint8], timestamp_s: float) -> None:
        """Add [h, w, 3] sRGB; all of the first one's size. Raises OutputError."""
        color = _even(color)
        if self._last_s is not None:
            self._ticks += self._ticks_since(self._last_s, timestamp_s)
        self._last_s = timestamp_s
        try:
            if self._container is None:
                self._open(color)
            picture = self._av.VideoFrame.from_ndarray(color, "rgb24").reformat(format="yuv420p", **self._color)
            picture.pts, picture.time_base = self._ticks, Fraction(1, TICKS_PER_S)
            self._container.mux(self._stream.encode(picture))
        except (self._av.FFmpegError, OSError) as error:
            raise OutputError(f"{self._path}: cannot be written ({error.strerror})") from error

    def close(self) -> bool:
        """Finish the file; False: there was no picture, and there is no file. Raises OutputError."""
        if self._container is None:
            return False
        try:
            self._container.mux(self._stream.encode())
            self._container.close()
        except (self._av.FFmpegError, OSError) as error:
            raise OutputError(f"{self._path}: cannot be finished ({error.strerror})") from error
        self._container = None
        return True

    def _ticks_since(self, last_s: float, now_s: float) -> int:
        """Duration of the frame before; of the source's rate where time stands still or goes back."""
        passed_s = now_s - last_s
        return round(min(passed_s, LONGEST_PAUSE_S) * TICKS_PER_S) or 1 if passed_s > 0 else self._step

    def _open(self, color: NDArray[np.uint8]) -> None:
        self._container = self._av.open(str(self._path), "w", options={"movflags": "+faststart"})
        stream = self._container.add_stream("libx264", rate=Fraction(TICKS_PER_S, self._step))
        stream.height, stream.width = color.shape[:2]
        stream.pix_fmt = "yuv420p"
        context = stream.codec_context
        context.time_base = stream.time_base = Fraction(1, TICKS_PER_S)
        context.gop_size = KEY_PICTURE_EVERY
        context.color_primaries, context.color_trc, context.colorspace, context.color_range = 1, 13, 1, 1
        stream.options = {"preset": PRESET, "crf": str(RATE_FACTOR)}
        self._stream = stream


def _even(color: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """With its last row and column twice where their number is odd: 4:2:0 needs even sides."""
    height, width = color.shape[:2]
    if height % 2 == 0 and width % 2 == 0:
        return color
    return np.pad(color, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
