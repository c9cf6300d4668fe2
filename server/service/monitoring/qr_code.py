"""A QR code for a terminal."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

BLACK_ON_WHITE, END = "\x1b[30;107m", "\x1b[0m"
"""Colours are set: a code with black and white exchanged is not read by every phone."""
QUIET = 2
"""Light modules around OpenCV's own border of two; four are prescribed (ISO/IEC 18004)."""
BLOCKS = {(False, False): " ", (True, False): "\u2580", (False, True): "\u2584", (True, True): "\u2588"}
"""Upper and lower module of a character: whether they are dark."""


def terminal_code(text: str) -> list[str]:
    """Lines that draw `text` as a QR code, two modules high each."""
    dark = dark_modules(text)
    dark = np.pad(dark, ((0, dark.shape[0] % 2), (0, 0)))
    rows = zip(dark[0::2].tolist(), dark[1::2].tolist(), strict=True)
    return [BLACK_ON_WHITE + "".join(BLOCKS[pair] for pair in zip(*row, strict=True)) + END for row in rows]


def dark_modules(text: str) -> NDArray[np.bool_]:
    """[n, n] modules with their quiet zone; True: dark."""
    picture = cv2.QRCodeEncoder.create().encode(text)
    return np.pad(np.asarray(picture) == 0, QUIET)
