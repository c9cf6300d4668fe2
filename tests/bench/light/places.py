"""Two places: a room half black and half white, and a real kitchen whose light should not flicker."""

from __future__ import annotations

import msgspec
import numpy as np

from client.sources.frame_source import Source
from client.synthetic.source import open_synthetic
from protocol.messages import Wishes
from server.maths.light_direction import direction_error_deg
from server.pipeline import FrameResult
from tests.bench.light.runs import at_preset, light_in, refusal, results_of, wishes_for
from tests.bench.report.finished import Part
from tests.bench.report.run import Run, data_source

HALVES_LIGHTS = (0, 1, 7)
"""Of the ring: from the front, and from either side of it."""
HALVES_FRAMES = range(0, 240, 24)
HALVES_GOAL_DEG = 5
KITCHEN, KITCHEN_FRAMES, QUICK_KITCHEN_FRAMES = "rgbd_7scenes_redkitchen", 200, 40
FLICKER_GOAL_DEG = 2


def halves_part(run: Run) -> Part:
    """Estimated albedo where the server has it, plain least squares beside it."""
    part = Part(sizes={"frames of the half black room": len(HALVES_FRAMES)})
    errors: dict[str, list[float]] = {}
    for number in HALVES_LIGHTS:
        source = open_synthetic(f"synthetic:halves?size=320x240&frames={HALVES_FRAMES.stop}&light={number}")
        wishes = wishes_for(source, range(HALVES_FRAMES.stop))
        for words, asked in _ways(wishes).items():
            run.say(f"half black room, light {number}: {words}")
            found = results_of(run.device, source, (source[i] for i in HALVES_FRAMES), asked)
            true = source.light(0).sh
            errors.setdefault(words, []).append(
                float(np.median([direction_error_deg(light_in(result), true) for result in found]))
            )
    for words, of_lights in errors.items():
        goal = f"<= {HALVES_GOAL_DEG}" if words.startswith("RM") else ""
        row = f"half black, half white room: {words}: dominant direction"
        part.add(f"{row}, median over frames, worst of {len(HALVES_LIGHTS)} lights", max(of_lights), "deg", goal)
        part.add(f"{row}, median over frames, best light", min(of_lights), "deg")
    return part


def _ways(wishes: Wishes) -> dict[str, Wishes]:
    estimated = msgspec.structs.replace(wishes, albedo="estimated", indirect="none")
    model = estimated if not refusal(estimated) else msgspec.structs.replace(estimated, albedo="constant")
    plain = msgspec.structs.replace(wishes, albedo="constant", indirect="none", as_thesis=True)
    return {f"RM, albedo {model.albedo}": model, "plain least squares, 10 cm rays": plain}


def kitchen_part(run: Run) -> Part:
    """Angles between the dominant directions of consecutive frames: as `probeless run` has it, and of one albedo."""
    source = data_source(KITCHEN)
    frames = range(run.of(QUICK_KITCHEN_FRAMES, KITCHEN_FRAMES))
    part = Part(sizes={"frames of the kitchen": len(frames)})
    plain = at_preset(wishes_for(source, frames), Wishes().preset)
    asked = msgspec.structs.replace(plain, albedo="estimated", indirect="observed")
    _add_turns(part, run, "kitchen, one albedo, no indirect light", source, frames, plain, "")
    last = _add_turns(part, run, "kitchen", source, frames, asked, f"<= {FLICKER_GOAL_DEG}")
    up = asked.up or -np.array(source[0].world_from_camera)[:3, 1]
    view = last.world_from_camera[:3, 2].tolist()
    part.details = {"light": light_in(last).tolist(), "up": list(map(float, up)), "view": view}
    return part


def _add_turns(
    part: Part, run: Run, words: str, source: Source, frames: range, asked: Wishes, goal: str
) -> FrameResult:
    run.say(words)
    found = results_of(run.device, source, (source[i] for i in frames), asked)
    directions = np.array([result.light.dominant_direction for result in found])
    turns = np.degrees(np.arccos(np.clip((directions[1:] * directions[:-1]).sum(axis=1), -1, 1)))
    row = f"{words}: dominant direction"
    part.add(f"{row}, frame to frame, standard deviation", float(np.sqrt((turns**2).mean())), "deg", goal)
    part.add(f"{row}, frame to frame, greatest", float(turns.max()), "deg")
    part.add(f"{row}, valid frames", 100 * float(np.mean([result.light.valid for result in found])), "%")
    return found[-1]
