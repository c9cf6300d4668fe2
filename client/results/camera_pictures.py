"""The camera's own pictures beside the composites, for the page's before and after."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from client.errors import OutputError

LONGEST_SIDE_PX = 1280
"""Larger pictures are reduced: a page shows no more."""
QUALITY = 90
"""Of JPEG; with full colour resolution, so that only what is virtual differs visibly from the composite."""
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)


def encode_camera_picture(color: NDArray[np.uint8]) -> bytes:
    """JPEG bytes of [height, width, 3] sRGB, at most LONGEST_SIDE_PX long; deterministic. Raises OutputError."""
    height, width = color.shape[:2]
    scale = LONGEST_SIDE_PX / max(height, width)
    if scale < 1:
        size = max(1, round(width * scale)), max(1, round(height * scale))
        color = np.asarray(cv2.resize(color, size, interpolation=cv2.INTER_AREA), np.uint8)
    done, data = cv2.imencode(".jpg", cv2.cvtColor(color, cv2.COLOR_RGB2BGR), _JPEG)
    if not done:
        raise OutputError(f"a camera's picture of shape {color.shape} could not be encoded as JPEG")
    return data.tobytes()
