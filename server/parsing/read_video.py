"""What a child that reads one session's video does: its decoder remembers the pictures before."""

from __future__ import annotations

from protocol.video import VideoDecoder
from server.parsing.read_picture import share

_decoder = VideoDecoder()


def read_video(request: bytes) -> bytes:
    """One H.264 picture -> its height and width; [h, w, 3] RGB is in the shared memory. Raises ValueError."""
    return share(_decoder.decode(request))
