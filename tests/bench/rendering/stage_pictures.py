"""Pictures of the stage set under two lights in all textures, and with its guests.

`python -m tests.bench.rendering.stage_pictures FILE` writes them.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from client.synthetic.source import open_synthetic, to_srgb8

TEXTURES = ("paper", "brick", "market", "checker", "town")
WIDTH, HEIGHT = 320, 240
SHOWN_ROWS = slice(36, 228)
_VIEW = 24


def stage_view(texture: str, light: int, frame: int, guests: str = "none") -> NDArray[np.uint8]:
    """[rows, WIDTH, 3] sRGB of one view, from four exact samples a pixel."""
    spec = f"synthetic:stage?size={2 * WIDTH}x{2 * HEIGHT}&texture={texture}&light={light}&frames=360&with={guests}"
    radiance = open_synthetic(spec).truth(frame).radiance
    return to_srgb8(radiance.reshape(HEIGHT, 2, WIDTH, 2, 3).mean((1, 3)))[SHOWN_ROWS]


def draw_stage(path: Path) -> None:
    """The contact sheet."""
    sheet = [[stage_view(texture, light, _VIEW) for texture in TEXTURES] for light in (7, 3)]
    more = [
        ("town", 7, 345, "none"),
        ("town", 7, 345, "both"),
        ("paper", 2, 120),
        ("market", 0, 215),
        ("brick", 5, 272),
    ]
    sheet.append([stage_view(*view) for view in more])
    picture = np.vstack([np.hstack(row) for row in sheet])
    cv2.imwrite(str(path), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 86])


if __name__ == "__main__":
    draw_stage(Path(sys.argv[1]))
