"""`mitsuba_room`'s composites: every preset under the true light in the room scanned whole, RM under its own.

The first measures rendering alone: all that hides the light is known. RM stands there also with the pictures' part of
the room alone.

A part is the two sets of one light and one kind of surface, with direct light and with global illumination: what the
second has more than the first is indirect light.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import msgspec
import numpy as np
from numpy.typing import NDArray

from client.options.source import open_source
from server.quality.settings import THESIS_REACH_M
from tests.bench.light.runs import REFERENCE, at_preset, refusal, results_of, wishes_for
from tests.bench.rendering.bleeding import to_objects, to_real
from tests.bench.rendering.common import OUT, PRESETS, require
from tests.bench.rendering.flip import Codes
from tests.bench.rendering.pictures import bounce_strip, draw_set, preset_strip
from tests.bench.rendering.rows import ERROR_GOALS, SHADOW_GOALS, add_pasted, add_score
from tests.bench.report.finished import Part
from tests.bench.report.run import Run, data_folder
from tests.bench.truth.composite_truth import linear_from_codes, score
from tests.bench.truth.exact_room import ExactMeshes
from tests.bench.truth.mitsuba_room import OBJECTS, RoomSet, model_for
from tests.bench.truth.object_shading import ObjectShading
from tests.bench.truth.room_composites import RoomTruth, SetTruth, set_truth
from tests.bench.truth.whole_room import after_whole_room, volume_of

LIGHTS, SURFACES = ("key", "studio"), ("white", "tex")
"""Of the sets that have composites."""
ESTIMATED, NO_BOUNCE, AVERAGES = "RM, its own light", "RM, no indirect light", "RM, as bright as averages"
PART_SEEN = "RM, only what the pictures show of the room"
SHORT = {"RM, rays of 0.1 m": "rm", "ART4, rays of 0.1 m": "art4"}
"""As the thesis runs them in fig. 7.11: what is farther away does not shade."""
ESTIMATED_GOALS = {"white_direct": 0.08, "white_gi": 0.10, "tex_gi": 0.12}
"""FLIP of RM under its own light."""
BLEEDING_GOAL = 0.5
FRAMES, QUICK_FRAMES = 6, 2

Floats = NDArray[np.float64]
Composites = dict[str, list[Codes]]
"""By preset, `NO_BOUNCE`, `AVERAGES`, `PART_SEEN` and `SHORT` under the true light; by `ESTIMATED`."""


@dataclass(frozen=True)
class Room:
    """What all parts share."""

    run: Run
    truth: RoomTruth
    shading: ObjectShading
    meshes: ExactMeshes
    """Without the virtual objects."""


def room_part(run: Run, light: str, surface: str) -> Part:
    """Both sets of one light and one kind of surface. Raises UnmeasurableError."""
    room = _room(run)
    part = Part(sizes={"frames of each mitsuba_room set": len(room.truth.objects)})
    direct, gi = (set_truth(RoomSet(room.truth.room, light, surface, t), room.truth) for t in ("direct", "gi"))
    of_direct, of_gi = (_composites(part, room, truth) for truth in (direct, gi))
    _add_scores(part, room, direct, of_direct)
    _add_scores(part, room, gi, of_gi)
    for preset in (name for name in PRESETS if name in of_gi):
        _add_bleeding(part, preset, gi, direct, of_gi[preset], of_direct[preset])
    _draw(direct, gi, of_direct, of_gi)
    return part


@lru_cache(maxsize=1)
def _room(run: Run) -> Room:
    folder = data_folder("mitsuba_room")
    require("open3d", "flip_evaluator")
    source = open_source(str(RoomSet(folder, LIGHTS[0], SURFACES[0], "direct").folder))
    frames = (source[i] for i in range(run.of(QUICK_FRAMES, FRAMES)))
    poses = [frame.world_from_camera for frame in frames if frame.world_from_camera is not None]
    return Room(
        run,
        RoomTruth(folder, source.camera, poses),
        ObjectShading(folder, source.camera, poses),
        ExactMeshes([folder / "truth" / "room.ply"]),
    )


def _composites(part: Part, room: Room, truth: SetTruth) -> Composites:
    """What the pipeline makes of a set, with what it calls for."""
    item = truth.item
    source = open_source(str(item.folder))
    objects = [item.room / "objects" / name for name in OBJECTS]
    usual = wishes_for(source, range(len(source)))
    wishes = msgspec.structs.replace(model_for(item, usual), edges="hard")  # as the truth, a point sample of each pixel
    given = msgspec.structs.replace(wishes, light=tuple((float(r), float(g), float(b)) for r, g, b in truth.light))
    whole = msgspec.structs.replace(given, volume_m=volume_of(room.meshes))
    asked = {preset: at_preset(whole, preset) for preset in PRESETS}
    asked[ESTIMATED], asked[PART_SEEN] = at_preset(wishes, REFERENCE), at_preset(given, REFERENCE)
    asked[AVERAGES] = msgspec.structs.replace(asked[REFERENCE], tone_mapping="average")
    if item.transport == "gi":
        asked[NO_BOUNCE] = msgspec.structs.replace(asked[REFERENCE], indirect="none")
    else:
        short = msgspec.structs.replace(whole, ray_length_m=THESIS_REACH_M)
        asked |= {name: at_preset(short, preset) for name, preset in SHORT.items()}
    found: Composites = {}
    for name, of_name in asked.items():
        room.run.say(f"{item.name}: {name}")
        refused = refusal(of_name)
        if refused:
            part.leave_out(f"{item.name}: {name}", refused)
        else:
            frames = [source[i] for i in truth.frames]
            sees_part = name in (ESTIMATED, PART_SEEN)
            fed = frames if sees_part else after_whole_room(source, frames, room.meshes, room.shading.views)
            results = results_of(room.run.device, source, fed, of_name, objects)
            found[name] = [result.color for result in results[-len(frames) :]]
    return found


def _add_scores(part: Part, room: Room, truth: SetTruth, found: Composites) -> None:
    """Rows of every run on one set."""
    item = truth.item
    of_pasted = add_pasted(part, item.name, truth)
    _add_floor(part, room, truth)
    for name in (*PRESETS, *SHORT, AVERAGES, PART_SEEN, ESTIMATED):
        if name in found:
            row = f"{item.name}: {name.upper() if name in PRESETS else name}" + (", true light" * (name != ESTIMATED))
            goals = _error_goal(item, name), SHADOW_GOALS.get(name)
            is_held = name not in (*SHORT, AVERAGES, PART_SEEN)
            add_score(part, row, truth, found[name], of_pasted, *goals, is_held=is_held)


def _error_goal(item: RoomSet, name: str) -> float | None:
    """The issue's, for RM's own light of every kind of set, and for direct light that is given."""
    if name == ESTIMATED:
        return ESTIMATED_GOALS.get(f"{item.surface}_{item.transport}")
    return ERROR_GOALS.get(name) if item.transport == "direct" else None


def _add_floor(part: Part, room: Room, truth: SetTruth) -> None:
    """What the true light's 16 coefficients leave, however well they are rendered."""
    observed = truth.pictures if truth.item.transport == "gi" else None
    exact = [room.shading.radiance(i, truth.light, pictures=observed) for i in truth.frames]
    words = "observed" if observed else "no"
    row = f"{truth.item.name}: truth with the objects shaded by exact geometry, 16 coefficients, {words} indirect light"
    part.add(f"{row}: FLIP of what the objects change", score(truth, truth.with_objects(exact)).error, "")


def _add_bleeding(
    part: Part, preset: str, gi: SetTruth, direct: SetTruth, of_gi: list[Codes], of_direct: list[Codes]
) -> None:
    """Rows of indirect light. What a white room sends to the objects has no colour to tell."""
    row, goal = f"{gi.item.name}: {preset.upper()}, true light: indirect light", f">= {BLEEDING_GOAL}"
    real = to_real(gi, direct, of_gi, of_direct)
    part.add(f"{row} of objects on real surface, colour, slope", real.color.value, "", goal)
    part.add(f"{row} of objects on real surface, luminance, slope", real.luminance.value, "")
    objects = to_objects(gi, direct, of_gi, of_direct)
    if gi.item.surface == "tex":
        part.add(f"{row} of the room on objects, colour, slope", objects.color.value, "", goal)
    part.add(f"{row} of the room on objects, luminance, slope", objects.luminance.value, "")


def _draw(direct: SetTruth, gi: SetTruth, of_direct: Composites, of_gi: Composites) -> None:
    """One frame of each set, in a sheet of its own and in the rows of fig. 7.11 and 7.10."""
    index = len(gi.frames) // 2
    for truth, found in ((direct, of_direct), (gi, of_gi)):
        draw_set(OUT / f"{truth.item.name}.jpg", truth, found, index)
        shown = {name: composites for name, composites in found.items() if name in (*PRESETS, *SHORT)}
        preset_strip(OUT, truth.item.name, truth, shown, index)
    if NO_BOUNCE in of_gi and REFERENCE in of_gi:
        decoded = [linear_from_codes(found[REFERENCE][index]) for found in (of_gi, of_direct)]
        without = [linear_from_codes(truth.shown[index]) for truth in (gi, direct)]
        true = [[truth.composites[index] for truth in (gi, direct)], [truth.pictures[index] for truth in (gi, direct)]]
        added = _added(gi, direct, index, decoded, without), _added(gi, direct, index, *true)
        pair = of_gi[NO_BOUNCE][index], of_gi[REFERENCE][index]
        bounce_strip(OUT, gi.item.name, *pair, *added, gi.objects[index])


def _added(gi: SetTruth, direct: SetTruth, index: int, composites: list[Floats], without: list[Floats]) -> Floats:
    """What global illumination adds to the change that the objects make, and on them all of it."""
    change = [a - np.where(gi.objects[index][..., None], 0.0, b) for a, b in zip(composites, without, strict=True)]
    return (gi.units * change[0] - direct.units * change[1]) / gi.units
