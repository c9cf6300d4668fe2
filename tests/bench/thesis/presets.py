"""The six presets of thesis 6.1.3 on E1 sequences with one virtual thing: table 6.1 and figures 6.5 to 6.8.

Pictures show reconstructed geometry under the moving disc light (client.tuning.known_light), so the light is known.
What the presets make of a frame is held against RM's: light against the known one, composites against RM's composite.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.synthetic.source import SyntheticSource
from client.tuning.known_light import LitFrame, moving_light, shaded_views
from protocol.messages import Wishes
from server.maths.light_direction import direction_dot
from server.scene.placement import Placement
from tests.bench.light.e1 import FRAMES as LIGHTS
from tests.bench.light.e1 import light_of
from tests.bench.light.environment import environment_difference
from tests.bench.light.runs import at_preset, light_in
from tests.bench.rendering.composites import grown
from tests.bench.rendering.flip import flip_map
from tests.bench.report.finished import Part
from tests.bench.report.run import Run
from tests.bench.thesis.numbers import DOTS, MOVING, PRESETS, STATIC
from tests.bench.thesis.runs import (
    Answer,
    Codes,
    Times,
    medians,
    no_times,
    note_times,
    save_picture,
    scene,
    turn_by_turn,
    usual_wishes,
    vase,
)

Bools = NDArray[np.bool_]

REFERENCE = "rm"
FRAMES, QUICK_FRAMES = 60, 10
SIZE, QUICK_SIZE = "640x480", "320x240"
VISIBLE = 0.1
"""FLIP of a just noticeable difference: it is what greys give whose lightness differs by 2.3 of CIELAB's units."""
RIM_PX = 2
"""Around what the thing changes."""
CLOSE_UP = (0.5, 0.42)
"""Height and width of what fig. 6.8 shows, of the picture's."""


@dataclass(frozen=True)
class Sequence:
    """A path of the camera, and where the vase stands."""

    name: str
    scene: str
    is_still: bool
    vase: Placement
    first_light: int
    """Of light_e1's, of which a quick run shows a short stretch: the light is at the side then, never behind the scene,
    where it is hardest to tell."""


SEQUENCES = (
    Sequence(STATIC, "table", True, Placement(position_m=(0.08, 0.0, 0.12), scale=0.9), 30),
    Sequence(MOVING, "table", False, Placement(position_m=(0.08, 0.0, 0.12), scale=0.9), 75),
)


@dataclass
class Found:
    """What one preset made of a sequence, a figure a frame."""

    dots: list[float]
    msad: list[float]
    """Of environment maps, relative."""
    times: Times
    difference: list[float]
    """Mean absolute difference of codes from RM's composite, over what the thing changes."""
    flip: list[float]
    """Mean over the same pixels; empty where flip_evaluator is not installed."""
    visible: list[float]
    """Share of them above VISIBLE."""
    worst: list[float]
    """The greatest FLIP of a pixel."""

    @classmethod
    def nothing(cls) -> Found:
        return cls([], [], no_times(), [], [], [], [])


def presets_part(run: Run, size: str | None = None, frames: int | None = None) -> Part:
    """Rows of table 6.1 and figures 6.5 to 6.8; `details` by sequence and preset, for the tables and the figures."""
    size, frames = size or (QUICK_SIZE if run.quick else SIZE), frames or run.of(QUICK_FRAMES, FRAMES)
    part = Part(sizes={"frames of the presets' sequences": frames})
    if run.quick:
        part.leave_out("table 6.1 with the light all around", "in the full run alone: from behind, errors are greater")
    if not has_flip():
        part.leave_out("fig. 6.7, 6.8: FLIP of the presets against RM", "flip_evaluator not installed")
    for sequence in SEQUENCES:
        run.say(f"presets, {sequence.name} camera: {frames} frames of {size}")
        found, nothing, pictures = _measure(run, sequence, size, frames)
        part.details[sequence.name] = {
            "presets": {preset: _plain(item) for preset, item in found.items()},
            "without": nothing,
            "close_ups": pictures,
        }
        _add_rows(part, sequence.name, found)
    return part


def has_flip() -> bool:
    """Whether flip_evaluator is installed."""
    return find_spec("flip_evaluator") is not None


def _plain(found: Found) -> dict[str, Any]:
    return {**vars(found), "medians": medians(found.times)}


def _measure(
    run: Run, sequence: Sequence, size: str, frames: int
) -> tuple[dict[str, Found], list[float], dict[str, str]]:
    """What each preset made; the difference of no virtual thing at all from RM's composites; fig. 6.8's pictures."""
    source = scene(
        f"synthetic:{sequence.scene}?size={size}&frames={frames}&noise=1&texture=0", is_still=sequence.is_still
    )
    wishes = usual_wishes(source, albedo="constant")
    found = {preset: Found.nothing() for preset in PRESETS}
    nothing: list[float] = []
    pictures: dict[str, str] = {}
    lit = list(_lit(run, source, wishes, sequence.first_light))
    lanes = {preset: at_preset(wishes, preset) for preset in PRESETS}
    answers = turn_by_turn(run.device, source.camera, (i.frame for i in lit), lanes, [(vase(), sequence.vase)])
    for item, (frame, by_preset) in zip(lit, answers, strict=True):
        composites = {preset: answer.result.color for preset, answer in by_preset.items()}
        changed = changed_by_any(np.asarray(frame.color, np.uint8), composites)
        reference = composites[REFERENCE]
        nothing.append(mean_difference(reference, np.asarray(frame.color, np.uint8), changed))
        maps = {name: flip_map(reference, codes) for name, codes in composites.items()} if has_flip() else {}
        for preset, answer in by_preset.items():
            _note(found[preset], answer, item, changed, reference, maps.get(preset))
        if frame.index == frames - 1:
            pictures = _close_ups(sequence.name, composites, maps, changed)
    return found, nothing, pictures


def _lit(run: Run, source: SyntheticSource, wishes: Wishes, first: int) -> Iterator[LitFrame]:
    assert wishes.volume_m is not None
    assert wishes.voxel_m is not None
    frames = (source[i] for i in range(len(source)))
    step = run.of(1, LIGHTS // FRAMES)
    views = shaded_views(run.device, source.camera, frames, wishes.volume_m, wishes.voxel_m)
    return moving_light(views, lambda index: light_of(first + step * index))


def _note(
    found: Found, answer: Answer, item: LitFrame, changed: Bools, reference: Codes, errors: NDArray[np.float64] | None
) -> None:
    light = light_in(answer.result)
    found.dots.append(direction_dot(light, item.sh))
    found.msad.append(environment_difference(light, item.sh))
    note_times(found.times, answer)
    found.difference.append(mean_difference(reference, answer.result.color, changed))
    if errors is not None:
        found.flip.append(float(errors[changed].mean()))
        found.visible.append(float((errors[changed] > VISIBLE).mean()))
        found.worst.append(float(errors.max()))


def changed_by_any(picture: Codes, composites: dict[str, Codes]) -> Bools:
    """[h, w] pixels that any composite has otherwise than the camera's picture, and a rim."""
    return grown(np.any([(codes != picture).any(axis=-1) for codes in composites.values()], axis=0), RIM_PX)


def mean_difference(reference: Codes, codes: Codes, where: Bools) -> float:
    """Mean absolute difference of sRGB codes over the pixels `where` [h, w]; 0 where there are none."""
    apart = np.abs(reference[where].astype(np.int16) - codes[where])
    return float(apart.mean()) if apart.size else 0.0


def _close_ups(
    name: str, composites: dict[str, Codes], maps: dict[str, NDArray[np.float64]], changed: Bools
) -> dict[str, str]:
    window = close_up(changed)
    kept = {preset: save_picture(f"6.8 {name} {preset}", codes[window]) for preset, codes in composites.items()}
    for preset, errors in maps.items():
        grey = np.rint(255 * np.clip(errors[window], 0, 1)).astype(np.uint8)
        kept[f"{preset} flip"] = save_picture(f"6.8 {name} {preset} flip", grey)
    return kept


def close_up(changed: Bools) -> tuple[slice, slice]:
    """Rows and columns around the middle of the changed pixels."""
    slices = []
    for axis, share in zip((0, 1), CLOSE_UP, strict=True):
        places = np.nonzero(changed)[axis]
        length = round(share * changed.shape[axis])
        middle = int(np.median(places)) if len(places) else changed.shape[axis] // 2
        start = int(np.clip(middle - length // 2, 0, changed.shape[axis] - length))
        slices.append(slice(start, start + length))
    return slices[0], slices[1]


def _add_rows(part: Part, name: str, found: dict[str, Found]) -> None:
    fast = {preset: median(item.times["cpu"]) for preset, item in found.items()}
    for preset, item in found.items():
        row = f"{name} camera: {preset.upper()}"
        mean, _std = DOTS[name][preset]
        dots = np.array(item.dots)
        part.add(f"table 6.1, {row}: dot product of dominant directions, mean", float(dots.mean()), "", f">= {mean}")
        part.add(f"table 6.1, {row}: dot product of dominant directions, std", float(dots.std()), "")
        angles = np.degrees(np.arccos(np.clip(dots, -1, 1)))
        part.add(f"table 6.1, {row}: mean angle to the true light", float(angles.mean()), "deg")
        times = medians(item.times)
        part.add(f"fig. 6.5, {row}: median", times["fps"], "frames/s")
        part.add(f"fig. 6.5, {row}: by processor time over the cores", 1e3 / times["cpu"], "frames/s")
        both = times["radiance_transfer"] + times["light_estimation"]
        part.add(f"fig. 6.5, {row}: transfer + estimation, median", both, "ms")
        part.add(f"fig. 6.6, {row}: environment map, relative MSAD, median", median(item.msad), "")
        if preset != REFERENCE:
            part.add(f"fig. 6.5, {row}: times as fast as RM", fast[REFERENCE] / fast[preset], "")
            part.add(f"fig. 6.7, {row}: difference from RM's picture, median", median(item.difference), "codes")
            if item.flip:
                part.add(f"fig. 6.7, {row}: FLIP against RM, median", median(item.flip), "")
                part.add(f"fig. 6.7, {row}: pixels with visible difference, median", median(item.visible), "")


def paced_ms(found: dict[str, Any], *, is_gpu: bool) -> list[float]:
    """Times that other programs disturb least: of the processor over its cores, or the wall's of a GPU."""
    times: list[float] = found["times"]["total" if is_gpu else "cpu"]
    return times
