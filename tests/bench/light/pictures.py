"""Estimated and true environments side by side, as the thesis's fig. 5.4, a picture for each data set."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from server.maths.sh import dominant_direction, webxr_from_world
from server.shading.composite import srgb_codes
from tests.bench.geometry.pictures import save
from tests.bench.light.environment import best_scale, lat_long_directions, radiance_from
from tests.bench.report.drawing import Picture, side_by_side

Floats = NDArray[np.float64]

HEIGHT_PX = 180
TRUE_COLOR, FOUND_COLOR = (90, 200, 60), (250, 250, 250)
"""BGR of the marks, as the thesis has them: green the known light, white the estimate."""
_MARK_PX = 7


def environment_picture(light: Floats, up: Floats, view: Floats, brightest: float) -> Picture:
    """[h, 2h, 3] lat-long: up at the top, the camera's `view` in the middle; `brightest` is white."""
    directions = lat_long_directions(HEIGHT_PX, webxr_from_world(up, view).T)
    shown = srgb_codes(np.maximum(radiance_from(light, directions), 0) / brightest)
    return np.ascontiguousarray(shown[..., ::-1])


def mark(picture: Picture, light: Floats, up: Floats, view: Floats, color: tuple[int, int, int]) -> None:
    """A ring at the dominant direction, in place; nothing where there is none."""
    x, y, z = webxr_from_world(up, view) @ dominant_direction(light)
    if x or y or z:
        across = (np.arctan2(x, -z) / np.pi + 1) * HEIGHT_PX
        down = np.arccos(np.clip(y, -1, 1)) / np.pi * HEIGHT_PX
        center = (int(across), int(down))
        cv2.circle(picture, center, _MARK_PX, (0, 0, 0), 4, cv2.LINE_AA)
        cv2.circle(picture, center, _MARK_PX, color, 2, cv2.LINE_AA)


def panels(lights: Mapping[str, Floats], true: Floats, up: Floats, view: Floats) -> list[tuple[str, Picture]]:
    """The truth, then each estimate brought to its scale; all marked with the true and their own direction."""
    brightest = float(np.maximum(radiance_from(true, lat_long_directions(HEIGHT_PX, np.eye(3))), 0).max())
    cells = []
    for name, light in {"true": true, **lights}.items():
        picture = environment_picture(best_scale(light, true) * light, up, view, brightest)
        mark(picture, true, up, view, TRUE_COLOR)
        if name != "true":
            mark(picture, light, up, view, FOUND_COLOR)
        cells.append((name, picture))
    return cells


def draw_rooms(folder: Path, details: Mapping[str, Mapping[str, Any]], names: tuple[str, ...]) -> None:
    """A file for each set of `mitsuba_room`: the truth and the estimates called `names`. y is down, z forward."""
    up, view = np.array([0.0, -1, 0]), np.array([0.0, 0, 1])
    for item, lights in details.items():
        found = {name: np.array(lights[name]) for name in names if name in lights}
        save(folder / f"{item}.png", side_by_side(panels(found, np.array(lights["true"]), up, view), columns=3))


def draw_e1(path: Path, details: Mapping[str, Mapping[str, Any]], preset: str) -> None:
    """The middle frame of each E1 sequence: truth and estimate. +x is in the middle: that light is at +z or -z."""
    up, view = np.array([0.0, 1, 0]), np.array([1.0, 0, 0])
    cells = []
    for name, found in details.items():
        if preset in found:
            true, light = (np.array(found[preset][key]) for key in ("true", "light"))
            for words, picture in panels({preset.upper(): light}, true, up, view):
                cells.append((f"{name}: {words}", picture))
    if cells:
        save(path, side_by_side(cells))


def draw_alone(path: Path, name: str, light: Floats, up: Floats, view: Floats) -> None:
    """An estimate where the truth is not known."""
    brightest = float(np.maximum(radiance_from(light, lat_long_directions(HEIGHT_PX, np.eye(3))), 0).max())
    picture = environment_picture(light, up, view, max(brightest, 1e-9))
    mark(picture, light, up, view, FOUND_COLOR)
    save(path, side_by_side([(name, picture)], columns=1))
