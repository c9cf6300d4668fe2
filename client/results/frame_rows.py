"""Rows of the page of results: what it shows of each frame, packed. client/web/src/results/data.ts reads them.

Numbers keep four significant digits, which is more than is shown. Effects, reasons and names that come again in many
frames are kept once, in tables; rows have their positions there.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np

from client.results.frame_output import FrameOutput
from protocol.messages import TIMING_ROWS, ArrivingLight, LeftOut, Light

STAGES = tuple(name for name in TIMING_ROWS if name != "total")
VISIBLE_CODES = 8
"""Change of an 8-bit code from which on a pixel counts as changed."""
NEARLY_ALL = 0.96
"""Share of the changed pixels that counts: the rest is noise and faint shadow."""
_DIGITS, _POSE_DIGITS = 4, 6


class Table:
    """Distinct values in the order of their first use."""

    def __init__(self) -> None:
        self._positions: dict[Any, int] = {}

    def position(self, value: Any) -> int:
        """Position of a hashable value; new ones are added."""
        return self._positions.setdefault(value, len(self._positions))

    def values(self) -> list[Any]:
        """All values by position."""
        return list(self._positions)


class FrameRows:
    """Packed rows of all frames so far; a row is about a kilobyte per light."""

    def __init__(self) -> None:
        self._rows: list[str] = []
        self._effects, self._left_out, self._points, self._places = Table(), Table(), Table(), Table()

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, output: FrameOutput, has_camera_picture: bool) -> None:
        """Add a frame; `has_camera_picture`: whether the camera's own picture was written."""
        point = output.plan.point
        drawn: dict[str, Any] = {
            "picture": 2 if has_camera_picture else 1,
            "changed": _changed(output) if has_camera_picture else None,
            "pose": rounded(output.world_from_camera[:3].ravel().tolist(), _POSE_DIGITS),
            "tracking": output.tracking,
            "ms": rounded(getattr(output.timings, name) for name in STAGES),
            "total": rounded((output.timings.total,))[0],
            "host": rounded((output.timings.host,))[0],
            "run": [self._effects.position(name) for name in output.plan.run],
            "out": [self._left_out.position(_left_out(effect)) for effect in output.plan.left_out],
            "point": None if point is None else self._points.position((point.settings, point.reason)),
        }
        if output.notes:
            drawn["notes"] = list(output.notes)
        self._append({**self._light_row(output.light), "drawn": drawn})

    def add_light(self, light: Light) -> None:
        """Add a frame of which only the light is known."""
        self._append({**self._light_row(light), "drawn": None})

    def tables(self) -> dict[str, Any]:
        """What rows refer to by position."""
        return {
            "stages": list(STAGES),
            "effects": self._effects.values(),
            "left_out": self._left_out.values(),
            "points": self._points.values(),
            "places": self._places.values(),
        }

    def json(self) -> Iterable[str]:
        """JSON text of each row."""
        return self._rows

    def _append(self, row: dict[str, Any]) -> None:
        self._rows.append(json.dumps(row, allow_nan=False, separators=(",", ":")))

    def _light_row(self, light: Light) -> dict[str, Any]:
        lights = [self._beyond(light), *(self._arriving(each) for each in light.at)]
        return {"frame": light.frame, "time": round(light.timestamp_s, 6), "lights": lights}

    def _beyond(self, light: Light) -> dict[str, Any]:
        """The light from beyond the scan."""
        row = _light(light, self._places.position(("beyond", 0)), light.position)
        if light.lamps:
            row["lamps"] = len(light.lamps)
        return row

    def _arriving(self, light: ArrivingLight) -> dict[str, Any]:
        row = _light(light, self._places.position((light.of, light.index)), light.position)
        row["seen"] = light.seen
        return row


def _light(light: Light | ArrivingLight, place: int, position: tuple[float, float, float] | None) -> dict[str, Any]:
    return {
        "place": place,
        "at": None if position is None else rounded(position),
        "sh": rounded(value for rgb in light.sh for value in rgb),
        "towards": rounded(light.dominant_direction),
        "intensity": rounded((light.dominant_intensity,))[0],
        "spread": None if light.spread_deg is None else round(light.spread_deg, 1),
        "valid": light.valid,
    }


def _changed(output: FrameOutput) -> list[float] | None:
    """Share of the pixels that virtual content changes visibly, and between which columns nearly all of them lie.

    Columns are shares of the width. None: there are no such pixels.
    """
    assert output.captured is not None
    red, green, blue = cv2.split(cv2.absdiff(output.color, output.captured.color))
    is_changed = cv2.max(cv2.max(red, green), blue) > VISIBLE_CODES
    columns = np.count_nonzero(is_changed, 0).cumsum()
    if columns[-1] == 0:
        return None
    outer = (1 - NEARLY_ALL) / 2
    first, last = (int(np.searchsorted(columns, share * columns[-1])) for share in (outer, 1 - outer))
    width = is_changed.shape[1]
    return [round(float(columns[-1]) / is_changed.size, 5), round(first / width, 3), round((last + 1) / width, 3)]


def _left_out(effect: LeftOut) -> tuple[str, str, float | None]:
    bound = effect.error_bound
    return effect.effect, effect.reason, None if bound is None else rounded((bound,))[0]


def rounded(values: Iterable[float], digits: int = _DIGITS) -> list[float]:
    """Values with so many significant digits; whole ones as integers, which are shorter."""
    short = (float(f"{value:.{digits}g}") for value in values)
    return [int(value) if value.is_integer() and abs(value) < 1e15 else value for value in short]
