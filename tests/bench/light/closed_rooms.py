"""Closed rooms: the light that arrives at places in them, against panoramas rendered there, and the pictures.

`data/rooms` holds path-traced rooms with lamps and windows inside; `python -m tests.bench.rooms` makes more of them,
without virtual objects and noisy depth. Everything is as `probeless run --preset reg4` does by itself. Errors are
medians over the last frames and over places unless a row says otherwise.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from client.options.source import open_source
from client.sources.frame_source import Source
from protocol.messages import ArrivingLight, Wishes
from server.maths.light_direction import direction_error_deg
from server.maths.sh import lambert_transfer, spherical_fibonacci
from server.pipeline import FrameResult
from tests.bench.light.coverage import Estimate, is_inside
from tests.bench.light.environment import NORMALS, irradiance_error
from tests.bench.light.runs import at_preset, results_of, wishes_for
from tests.bench.rendering.flip import flip_map
from tests.bench.report.finished import Part
from tests.bench.report.run import Run, data_folder

PRESET = "reg4"
LAST = 15
"""Frames that are judged: those of half a second in which the room has been seen."""
FIRST = 5
"""Frames after which a first answer is judged."""
NEAR = 3
"""Places on table and floor, the first of each room."""
OBJECTS = ("objects/a.ply", "objects/b.ply")
FAR_OFF_DEG = 45.0

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Arrived:
    """What was found at the places of one room, frame by frame; [frames, places] each."""

    angles_deg: Floats
    irradiance: Floats
    """Relative RMSE over all normals and colours after one scale."""
    level: Floats
    """Mean irradiance over the true one."""
    chroma: Floats
    """Greatest relative error of a channel's share of the irradiance."""
    spreads_deg: Floats
    is_valid: NDArray[np.bool_]
    inside: Floats
    """Share of the coefficients, 3 x 16, whose true value lies inside the 95 % interval of `sh_std` after one scale."""

    def last(self) -> Arrived:
        """The frames that are judged."""
        return Arrived(*(getattr(self, name)[-LAST:] for name in self.__dataclass_fields__))


def level_and_chroma(found: Floats, true: Floats) -> tuple[float, float]:
    """Level of the mean irradiance of light `found` [16, 3] over that of `true`, and the error of its chroma."""
    mean, truth = (np.mean(_irradiance(light), axis=0) for light in (found, true))
    shares, true_shares = mean / mean.sum(), truth / truth.sum()
    return float(mean.sum() / truth.sum()), float(np.abs(shares / true_shares - 1).max())


def compare(found: list[tuple[ArrivingLight, ...]], truth: Floats) -> Arrived:
    """found: a frame's lights at places, in the order of truth [places, 16, 3]."""
    rows = [[_errors(light, true) for light, true in zip(lights, truth, strict=True)] for lights in found]
    columns = [np.array([[place[k] for place in row] for row in rows]) for k in range(7)]
    return Arrived(*columns[:5], columns[5].astype(bool), columns[6])


def _errors(light: ArrivingLight, true: Floats) -> tuple[float, ...]:
    sh = np.array(light.sh, np.float64)
    level, chroma = level_and_chroma(sh, true)
    spread = 180.0 if light.spread_deg is None else light.spread_deg
    std = np.array([[np.inf if value is None else value for value in row] for row in light.sh_std])
    inside = float(is_inside(Estimate(sh, std, true)).mean())
    return direction_error_deg(sh, true), irradiance_error(sh, true), level, chroma, spread, float(light.valid), inside


def _irradiance(light: Floats) -> Floats:
    return np.asarray(lambert_transfer(spherical_fibonacci(NORMALS), 4) @ light)


def closed_rooms_part(run: Run) -> Part:
    """All rooms, exact and noisy depth."""
    part = Part()
    folders = sorted(path for path in data_folder("rooms").iterdir() if (path / "probes.json").exists())
    for folder in folders[: run.of(2, len(folders))]:
        run.say(f"room {folder.name}")
        exact, results = arrived_in(run, folder, folder)
        part.sizes["frames of each closed room"] = len(results)
        _add_errors(part, f"room {folder.name}", exact)
        part.details[folder.name] = {"angles_deg": exact.angles_deg.tolist()}
        if (folder / "with_objects").is_dir():
            _add_pictures(part, folder, results)
        if (folder / "noisy").is_dir():
            run.say(f"room {folder.name}, noisy depth")
            noisy, _ = arrived_in(run, folder / "noisy", folder, with_objects=False)
            ratio = np.median(noisy.last().angles_deg) / np.median(exact.last().angles_deg)
            part.add(f"room {folder.name}: dominant direction, noisy over exact depth", float(ratio), "", "<= 1.3")
            part.details[folder.name]["noisy_deg"] = noisy.angles_deg.tolist()
    return part


def room_wishes(source: Source, places: Floats) -> Wishes:
    """What `probeless run --preset reg4 --light-at ...` wishes for."""
    asked = at_preset(wishes_for(source, range(len(source))), PRESET)
    return msgspec.structs.replace(
        asked, albedo="estimated", indirect="observed", light_at=tuple(tuple(map(float, place)) for place in places)
    )


def arrived_in(
    run: Run, source_folder: Path, room: Path, *, frames: int | None = None, with_objects: bool = True
) -> tuple[Arrived, list[FrameResult]]:
    """What a source shows of a room whose folder has the probes and, some, the objects; frames: the first so many."""
    probes = json.loads((room / "probes.json").read_text())["probes"]
    source = open_source(str(source_folder))
    wishes = room_wishes(source, np.array([probe["position"] for probe in probes]))
    numbers = range(len(source) if frames is None else frames)
    objects = [room / name for name in OBJECTS if with_objects and (room / name).exists()]
    results = results_of(run.device, source, (source[i] for i in numbers), wishes, objects)
    found = [tuple(light for light in result.light.at if light.of == "place") for result in results]
    return compare(found, np.array([probe["sh"] for probe in probes])), results


def _add_errors(part: Part, name: str, arrived: Arrived) -> None:
    last = arrived.last()
    rows: list[tuple[str, Any, str, str]] = [
        ("table and floor: dominant direction", np.median(last.angles_deg[:, :NEAR]), "deg", "<= 10"),
        ("table and floor: irradiance", 100 * np.median(last.irradiance[:, :NEAR]), "%", "<= 15"),
        ("all places: dominant direction", np.median(last.angles_deg), "deg", "<= 15"),
        ("all places: irradiance", 100 * np.median(last.irradiance), "%", "<= 22"),
        ("all places: dominant direction after five frames", np.median(arrived.angles_deg[FIRST - 1]), "deg", "<= 30"),
        ("all places: level, median off 1 by", abs(np.median(last.level) - 1), "", "<= 0.2"),
        ("all places: chroma of irradiance", 100 * np.median(last.chroma), "%", "<= 10"),
        ("angles within the spread that is said", 100 * (last.angles_deg <= last.spreads_deg).mean(), "%", ">= 90"),
        ("coefficients inside the 95 % interval of sh_std", 100 * last.inside.mean(), "%", ">= 90"),
        ("spread over error", np.median(last.spreads_deg) / np.median(last.angles_deg), "", "<= 2.5"),
        ("valid", 100 * last.is_valid.mean(), "%", ">= 60"),
        ("greatest error where valid", np.where(last.is_valid, last.angles_deg, 0.0).max(), "deg", f"<= {FAR_OFF_DEG}"),
    ]
    for words, value, unit, goal in rows:
        part.add(f"{name}: {words}", float(value), unit, goal)


def _add_pictures(part: Part, folder: Path, results: list[FrameResult]) -> None:
    """FLIP over the pixels that objects change, and how bright objects are; every fifth frame has a true picture."""
    errors, nothing, brightness = [], [], []
    for path in sorted((folder / "with_objects").glob("*.png")):
        number = int(path.stem)
        if number >= len(results) or results[number].color is None:
            continue
        true, color = _picture(path), _picture(folder / "color" / path.name)
        shown = np.asarray(results[number].color)
        changed = _mask(folder / "changed" / path.name)
        own = _mask(folder / "objects_own" / path.name)
        try:
            errors.append(flip_map(true, shown)[changed].mean())
            nothing.append(flip_map(true, color)[changed].mean())
        except ImportError:
            part.leave_out(f"room {folder.name}: FLIP", "flip-evaluator is not installed: make install-bench")
            return
        if own.any():
            brightness.append(_linear(shown)[own].mean() / _linear(true)[own].mean())
    part.add(f"room {folder.name}: FLIP over changed pixels", float(np.mean(errors)), "", "<= .17")
    part.add(f"room {folder.name}: FLIP of the picture without objects", float(np.mean(nothing)), "")
    off = abs(float(np.mean(brightness)) - 1)
    part.add(f"room {folder.name}: objects' brightness over the true one, off 1 by", off, "", "<= 0.15")


def _picture(path: Path) -> NDArray[np.uint8]:
    return np.ascontiguousarray(cv2.imread(str(path))[:, :, ::-1])


def _mask(path: Path) -> NDArray[np.bool_]:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) > 0)


def _linear(codes: NDArray[np.uint8]) -> Floats:
    value = codes / 255.0
    return np.asarray(np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4))
