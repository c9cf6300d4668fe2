"""Pictures of a benchmark: bars of times, depth, normals and differences, labelled, as 8-bit BGR arrays for cv2."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]

COLORS = {
    "integrate": (180, 119, 31),
    "ray cast": (14, 127, 255),
    "track": (44, 160, 44),
    "filter before tracking": (34, 189, 188),
}
"""BGR of each action."""
_FONT, _INK, _GREY = cv2.FONT_HERSHEY_SIMPLEX, (40, 40, 40), (200, 200, 200)
_ROW, _LEFT, _WIDTH, _RIGHT = 34, 400, 640, 120


def bars(title: str, times_ms: Mapping[str, Mapping[str, float]]) -> Picture:
    """One row a contestant, its actions one after the other along it, milliseconds written at the end."""
    canvas = np.full((_ROW * (len(times_ms) + 3), _LEFT + _WIDTH + _RIGHT, 3), 255, np.uint8)
    _text(canvas, title, (16, 26), 0.65)
    longest = max(sum(times.values()) for times in times_ms.values())
    step = _round_step(longest / 5)
    for tick in np.arange(0, longest + 1e-9, step):
        x = _LEFT + int(_WIDTH * tick / longest)
        cv2.line(canvas, (x, 44), (x, canvas.shape[0] - 2 * _ROW), _GREY, 1)
        _text(canvas, f"{tick:g}", (x - 8, canvas.shape[0] - 2 * _ROW + 18), 0.45)
    for row, (name, times) in enumerate(times_ms.items()):
        y = _ROW * row + 50
        _text(canvas, name, (16, y + 18), 0.5)
        x = float(_LEFT)
        for action, value in times.items():
            end = x + _WIDTH * value / longest
            cv2.rectangle(canvas, (int(x), y), (int(end), y + 22), COLORS[action], cv2.FILLED)
            x = end
        _text(canvas, " + ".join(f"{value:.1f}" for value in times.values()), (int(x) + 6, y + 17), 0.5)
    x = _LEFT
    for action, color in COLORS.items():
        y = canvas.shape[0] - 24
        cv2.rectangle(canvas, (x, y), (x + 18, y + 14), color, cv2.FILLED)
        _text(canvas, f"{action}, ms", (x + 24, y + 12), 0.5)
        x += 190
    return canvas


def depth_picture(depth_m: NDArray[np.floating], nearest_m: float, farthest_m: float) -> Picture:
    """Near is bright, none is black."""
    share = np.clip((farthest_m - depth_m) / (farthest_m - nearest_m), 0, 1)
    shown = cv2.applyColorMap((40 + 215 * share).astype(np.uint8), cv2.COLORMAP_INFERNO)
    return np.where(depth_m[..., None] > 0, shown, 0).astype(np.uint8)


def normal_picture(normals: NDArray[np.floating]) -> Picture:
    """[h, w, 3] unit normals, (0, 0, 0) where there are none: x red, y green, z blue, each from -1 to 1."""
    known = np.abs(normals).sum(axis=-1, keepdims=True) > 0
    return np.where(known, 127.5 + 127.5 * normals[..., ::-1], 0).astype(np.uint8)


def difference_picture(depth_m: NDArray[np.floating], exact_m: NDArray[np.floating], greatest_m: float) -> Picture:
    """White where equal, red in front of the exact surface, blue behind; grey where there is none."""
    share = np.clip((depth_m - exact_m) / greatest_m, -1, 1)
    keep = 1 - np.abs(share)
    shown = 255 * np.stack([np.where(share < 0, keep, 1), keep, np.where(share > 0, keep, 1)], axis=-1)
    return np.where(((depth_m > 0) & (exact_m > 0))[..., None], shown, 128).astype(np.uint8)


def side_by_side(pictures: Sequence[tuple[str, Picture]], columns: int = 2) -> Picture:
    """Pictures of one size in rows, each with its name above it."""
    cells = []
    for name, picture in pictures:
        label = np.full((28, picture.shape[1], 3), 255, np.uint8)
        _text(label, name, (8, 20), 0.55)
        cells.append(np.vstack([label, picture]))
    while len(cells) % columns:
        cells.append(np.full_like(cells[0], 255))
    rows = [np.hstack(cells[i : i + columns]) for i in range(0, len(cells), columns)]
    return np.vstack(rows)


def _round_step(step: float) -> float:
    """The next of 1, 2, 5, 10, ... above."""
    power = 10.0 ** np.floor(np.log10(step))
    return float(next(m * power for m in (1, 2, 5, 10) if m * power >= step - 1e-12))


def _text(canvas: Picture, text: str, at: tuple[int, int], size: float) -> None:
    cv2.putText(canvas, text, at, _FONT, size, _INK, 1, cv2.LINE_AA)
