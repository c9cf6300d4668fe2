"""Two places: a room half black and half white, and a real kitchen whose light should not flicker."""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from client.sources.frame_source import Source
from client.synthetic.source import open_synthetic
from protocol.messages import Wishes
from server.input.measure import linear_values
from server.maths.light_direction import direction_error_deg
from server.maths.sh import lambert_transfer
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
FLICKER_FROM = 30
"""Frames until the room has been looked at for a second."""
KITCHEN_UP = np.array([0.010, -0.888, -0.460])
"""[3] world: the normal of its table and its floor."""
MUG_FRAME, MUG_PX = 20, (400, 193)
"""The side of a white mug on the kitchen's table, nearer to the camera than to the lamps above: it is not clipped."""
MUG_CLEARANCE_M = 0.05

Floats = NDArray[np.float64]


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
    up = asked.up or -np.array(source[0].world_from_camera)[:3, 1]
    mug = _Mug.seen_in(source)
    asked = msgspec.structs.replace(asked, light_at=(tuple(mug.place.tolist()),))
    found = _add_turns(part, run, "kitchen", source, frames, asked, f"<= {FLICKER_GOAL_DEG}")
    last, exposure = found[-1], found[MUG_FRAME].light.exposure
    part.add("kitchen: colour of the light on a white mug, off the mug's own by", 100 * mug.off_by(last), "%")
    part.add("kitchen: albedo of the white mug under that light", mug.albedo_under(last, exposure), "", "<= 0.95")
    changes = 100 * _changes_at_place(found[FLICKER_FROM:])
    row = f"kitchen: light at the mug, frame to frame from frame {FLICKER_FROM} on"
    part.add(f"{row}, root mean square", float(np.sqrt((changes**2).mean())), "%")
    part.add(f"{row}, greatest", float(changes.max()), "%")
    view = last.world_from_camera[:3, 2].tolist()
    part.details = {"light": light_in(last).tolist(), "up": list(map(float, up)), "view": view}
    return part


@dataclass(frozen=True)
class _Mug:
    """A real thing that is white."""

    place: Floats
    """[3] world, before its side."""
    normal: Floats
    """[3] of its side, world."""
    seen: Floats
    """[3] linear RGB, as exposed in MUG_FRAME."""

    @staticmethod
    def seen_in(source: Source) -> _Mug:
        frame, camera, (x, y) = source[MUG_FRAME], source.camera, MUG_PX
        around = np.s_[y - 2 : y + 3, x - 2 : x + 3]
        depth_m = float(np.median(frame.depth[around])) * camera.depth_scale_m
        pose = np.array(frame.world_from_camera)
        at = pose[:3, :3] @ [(x - camera.cx) / camera.fx * depth_m, (y - camera.cy) / camera.fy * depth_m, depth_m]
        normal = -at + (at @ KITCHEN_UP) * KITCHEN_UP
        normal /= np.linalg.norm(normal)
        seen = np.median(linear_values(camera.color_encoding)[frame.color[around]].reshape(-1, 3), axis=0)
        return _Mug(pose[:3, 3] + at + MUG_CLEARANCE_M * normal, normal, seen)

    def off_by(self, result: FrameResult) -> float:
        """The greatest relative difference of a channel, levels apart."""
        ratios = np.log(self._shading(result) / self.seen)
        return float(np.exp(np.abs(ratios - ratios.mean()).max())) - 1

    def albedo_under(self, result: FrameResult, exposure: float) -> float:
        """Geometric mean of the channels; `exposure` of MUG_FRAME."""
        received = self._shading(result) * exposure / result.light.exposure
        return float(np.exp(np.log(self.seen / received).mean()))

    def _shading(self, result: FrameResult) -> Floats:
        """[3] of a white surface that faces as its side does, as exposed in that frame."""
        sh = _light_at_place(result)
        return np.asarray((lambert_transfer(self.normal[None], math.isqrt(len(sh))) @ sh)[0])


def _light_at_place(result: FrameResult) -> Floats:
    """[16, 3] at the place that was asked for, as exposed in that frame."""
    return next(np.array(lit.sh) for lit in result.light.at if lit.of == "place")


def _changes_at_place(found: list[FrameResult]) -> Floats:
    """[frames - 1] difference of two lights in a row, over the first: norms of all coefficients, exposure apart."""
    lights = np.array([_light_at_place(result) / result.light.exposure for result in found])
    return np.asarray(np.linalg.norm(np.diff(lights, axis=0), axis=(1, 2)) / np.linalg.norm(lights[:-1], axis=(1, 2)))


def _add_turns(
    part: Part, run: Run, words: str, source: Source, frames: range, asked: Wishes, goal: str
) -> list[FrameResult]:
    run.say(words)
    found = results_of(run.device, source, (source[i] for i in frames), asked)
    directions = np.array([result.light.dominant_direction for result in found])
    turns = np.degrees(np.arccos(np.clip((directions[1:] * directions[:-1]).sum(axis=1), -1, 1)))
    row = f"{words}: dominant direction"
    part.add(f"{row}, frame to frame, standard deviation", float(np.sqrt((turns**2).mean())), "deg", goal)
    part.add(f"{row}, frame to frame, greatest", float(turns.max()), "deg")
    part.add(f"{row}, valid frames", 100 * float(np.mean([result.light.valid for result in found])), "%")
    return found
