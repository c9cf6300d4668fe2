"""Details as the parts of E5 leave them, made up: what tables and figures are drawn from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tests.bench.thesis.numbers import FAMILIES, MOVING, PRESETS, ROWS, STATIC
from tests.bench.thesis.runs import medians

FRAMES = 4


def picture(folder: Path, name: str, seed: int = 0) -> str:
    """A small picture in `folder`; its name."""
    values = np.random.default_rng(seed).integers(0, 255, (24, 32, 3), np.uint8)
    assert cv2.imwrite(str(folder / f"{name}.png"), values)
    return f"{name}.png"


def presets_details(folder: Path) -> dict[str, Any]:
    """Of thesis_presets: dots 0.99, 0.98, ... by preset, 0.005 to each side; RM takes 200 ms, each next one half."""
    details: dict[str, Any] = {"is_gpu": False}
    for sequence in (STATIC, MOVING):
        presets = {}
        for number, preset in enumerate(PRESETS):
            times = {name: [200 / 2**number] * FRAMES for name in (*list(ROWS)[1:], "cpu")}
            presets[preset] = {
                "dots": [0.99 - 0.01 * number - 0.005, 0.99 - 0.01 * number + 0.005] * 2,
                "msad": [0.1 + 0.01 * number] * FRAMES,
                "times": times,
                "medians": medians(times),
                "difference": [float(number)] * FRAMES,
                "flip": [0.01 * number] * FRAMES,
                "visible": [0.02 * number] * FRAMES,
                "worst": [0.1] * FRAMES,
            }
        pictures = {p: picture(folder, f"{sequence}_{p}", n) for n, p in enumerate(PRESETS)}
        maps = {}
        for number, preset in enumerate(PRESETS):
            name = f"{sequence}_{preset}_flip.png"
            assert cv2.imwrite(str(folder / name), np.full((24, 32), 20 * number, np.uint8))
            maps[f"{preset} flip"] = name
        details[sequence] = {"presets": presets, "without": [50.0] * FRAMES, "close_ups": pictures | maps}
    return details


def speed_details() -> dict[str, Any]:
    """Of thesis_speed: every row its own number."""
    column = {name: 1000.0 + number for number, name in enumerate((*ROWS, "cpu"))}
    modes = {mode: dict.fromkeys(FAMILIES, column) for mode in ("as thesis", "usual")}
    return {"is_gpu": False, "cores": 2, "device": "a device", "6.2": modes, "6.3": modes}
