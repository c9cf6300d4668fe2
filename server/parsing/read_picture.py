"""Job of image children."""

from __future__ import annotations

import struct

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.images import decode_picture
from server.children.child import shared_memory

SIZE = struct.Struct("<II")

cv2.setNumThreads(1)  # children must not start threads


def read_picture(request: bytes) -> bytes:
    """A JPEG or PNG -> its height and width; [h, w, 3] RGB is in the shared memory. Raises ValueError."""
    return share(decode_picture(request))


def share(rgb: NDArray[np.uint8]) -> bytes:
    """Copy [h, w, 3] to the shared memory and return height and width. Raises ValueError if it is too large."""
    memory = shared_memory()
    if rgb.nbytes > len(memory):
        raise ValueError("color.data: the picture is too large")
    memory[: rgb.nbytes] = rgb.data.cast("B") if rgb.flags.c_contiguous else rgb.tobytes()
    return SIZE.pack(*rgb.shape[:2])
