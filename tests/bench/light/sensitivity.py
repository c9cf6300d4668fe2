"""How much the constants of a room's light matter: what it finds in closed rooms when each is about halved and doubled.

`python -m tests.bench.light.sensitivity` prints rows of the table in docs/light.md, with medians over places and the
last frames of each room: direction (degrees), irradiance (%), level over the true one, chroma of irradiance (%).
"""

from __future__ import annotations

import argparse
import importlib
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

ROOMS = ("r1_ceiling", "r3_two")
AT_ONCE = 2
"""Measurements that run beside each other."""

Value = float | tuple[float, ...]


@dataclass(frozen=True)
class Constant:
    """A constant, where it stands, and its other values."""

    module: str
    """Below server.light.shell."""
    name: str
    low: Value
    high: Value


CONSTANTS = (
    Constant("weights", "MEAN_ALBEDO", 0.25, 0.45),
    Constant("weights", "MEAN_SPREAD", 0.15, 0.6),
    Constant("weights", "BRIGHTEST", 0.45, 0.8),
    Constant("weights", "BRIGHTEST_SPREAD", 0.035, 0.14),
    Constant("weights", "WHITE_TOLERANCE", 0.1, 0.4),
    Constant("weights", "NOT_WHITE", 0.01, 0.04),
    Constant("weights", "ALBEDO_SPREAD", 0.25, 1.0),
    Constant("weights", "MATERIAL_CHROMA", 0.4, 1.6),
    Constant("weights", "SURFACE_SPREAD", 0.045, 0.18),
    Constant("weights", "REGION_SPREAD", 0.025, 0.1),
    Constant("weights", "DARK_EDGE", 0.015, 0.06),
    Constant("weights", "BRIGHT_EDGE", 0.05, 0.2),
    Constant("weights", "WHITE", 0.0025, 0.01),
    Constant("weights", "LUMINOUS", 0.5, 2.0),
    Constant("weights", "HUBER", 0.5, 2.0),
    Constant("weights", "CELL_LOW", 0.235, 0.94),
    Constant("weights", "CELL_HIGH", 1.45, 5.8),
    Constant("weights", "FLOOR_PATCHES", 5, 20),
    Constant("weights", "CELL_HIDDEN", 0.35, 1.4),
    Constant("weights", "SMOOTHNESS", 0.65, 2.6),
    Constant("weights", "EDGE", 0.125, 0.5),
    Constant("weights", "CHROMA_NOISE", 0.03, 0.12),
    Constant("weights", "CELL_CHROMA", 0.15, 0.6),
    Constant("weights", "TINT", 0.225, 0.9),
    Constant("weights", "TINT_ACROSS", 0.04, 0.16),
    Constant("weights", "SURFACE_CHROMA", 2.0, 8.0),
    Constant("weights", "REGION_CHROMA", 0.015, 0.06),
    Constant("weights", "WHITE_CHROMA", (0.0, 0.0), (0.1, -0.24)),
    Constant("weights", "WHITE_CHROMA_SPREAD", 0.025, 0.1),
    Constant("weights", "CHROMA_SMOOTHNESS", 2.5, 10.0),
    Constant("weights", "PATCH_NOISE", 0.065, 0.26),
    Constant("segments", "LEVEL_EDGE", 0.35, 1.4),
    Constant("segments", "CHROMA_EDGE", 0.1, 0.4),
    Constant("shell", "BEHIND_M", 0.5, 2.0),
    Constant("patches", "PATCH_M", 0.1, 0.3),
    Constant("patches", "ROOM_M", 1.0, 4.0),
    Constant("patches", "REGION_M", 0.2, 0.8),
    Constant("patches", "RAYS", 512, 2048),
)


def set_before_import(constant: Constant, value: Value) -> None:
    """Other modules take constants over when they are imported: raises RuntimeError where that was already."""
    name = f"server.light.shell.{constant.module}"
    if "server.light.shell.objective" in sys.modules:
        raise RuntimeError(f"{name} is in use: set {constant.name} in a process of its own")
    module = importlib.import_module(name)
    if not hasattr(module, constant.name):
        raise RuntimeError(f"{name} has no {constant.name}")
    setattr(module, constant.name, np.array(value) if isinstance(value, tuple) else value)


def measure(rooms: list[str]) -> list[list[float]]:
    """Medians in each room, without virtual objects, in the order of the text above."""
    from server.children import process_pool

    process_pool.IS_SUPPORTED = False  # a solver in another process would not have the value
    from server.opencl.device import open_device
    from tests.bench.light.closed_rooms import arrived_in
    from tests.bench.report.run import Run, data_folder

    run, found = Run(open_device(None), quick=False, say=lambda _text: None), []
    for room in rooms:
        folder = data_folder("rooms") / room
        last = arrived_in(run, folder, folder, with_objects=False)[0].last()
        medians = [np.median(part) for part in (last.angles_deg, last.irradiance, last.level, last.chroma)]
        found.append([float(value) for value in medians * np.array([1, 100, 1, 100])])
    return found


def _measured_aside(rooms: list[str], constant: Constant | None, value: Value | None) -> str:
    """Of a process of its own, as words."""
    which = [] if constant is None else ["--set", constant.name, json.dumps(value)]
    asked = ["--measure", *which, *(f"--room={room}" for room in rooms)]
    command = [sys.executable, "-m", "tests.bench.light.sensitivity", *asked]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        last = (result.stderr.strip().splitlines() or ["no word"])[-1]
        raise SystemExit(f"{constant.name if constant else 'as it is'} at {value}: {last}")
    found = json.loads(result.stdout.splitlines()[-1])
    return "; ".join(f"{angle:.0f}, {off:.0f}, {level:.2f}, {chroma:.0f}" for angle, off, level, chroma in found)


def _words(value: Value) -> str:
    parts = value if isinstance(value, tuple) else (value,)
    return ", ".join(f"{part:g}".replace("0.", ".", 1) if abs(part) < 1 else f"{part:g}" for part in parts)


def _row(rooms: list[str], constant: Constant) -> str:
    low, high = (_measured_aside(rooms, constant, value) for value in (constant.low, constant.high))
    return f"| `{constant.name}` | {_words(constant.low)}: {low} / {_words(constant.high)}: {high} |"


def main(arguments: list[str] | None = None) -> int:
    """Exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.light.sensitivity", description=(__doc__ or "").split("\n")[0]
    )
    names = [constant.name for constant in CONSTANTS]
    parser.add_argument("--room", action="append", help=f"of PROBELESS_DATA/rooms; default: {', '.join(ROOMS)}")
    parser.add_argument("--constant", action="append", choices=names, metavar="NAME", help="default: all of them")
    parser.add_argument("--measure", action="store_true", help="once, in this process, and print it as JSON")
    parser.add_argument("--set", nargs=2, metavar=("NAME", "VALUE"), help="with --measure: with this value")
    asked = parser.parse_args(arguments)
    rooms = asked.room or list(ROOMS)
    by_name = dict(zip(names, CONSTANTS, strict=True))
    if asked.measure:
        if asked.set:
            value: Any = json.loads(asked.set[1])
            set_before_import(by_name[asked.set[0]], tuple(value) if isinstance(value, list) else value)
        print(json.dumps(measure(rooms)))
        return 0
    print(f"as they are: {_measured_aside(rooms, None, None)}", flush=True)
    with ThreadPoolExecutor(AT_ONCE) as pool:
        for row in pool.map(partial(_row, rooms), [by_name[name] for name in asked.constant or names]):
            print(row, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
