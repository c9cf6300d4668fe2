"""Job of video children: decodes one session's video. The decoder keeps reference frames between requests."""

from __future__ import annotations

from protocol.video import VideoDecoder
from server.parsing.read_picture import share

_decoder = VideoDecoder()


def read_video(request: bytes) -> bytes:
    """One H.264 picture -> its height and width; [h, w, 3] RGB is in the shared memory. Raises ValueError."""
    return share(_decoder.decode(request))
