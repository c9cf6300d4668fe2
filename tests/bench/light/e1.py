"""E1 as in thesis 6.1.3: five sequences under a moving disc light, each preset's light against the known one.

The thesis records its sequences with a Kinect. Here they are synthetic scenes measured with the noise of one, so that
everybody can make them: camera still or walking, things put in and taken out. The light goes around once in the 300
frames, about a degree a frame, and rises and sinks; its colour and share of even light are those of `disc_light`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.sources.volume import default_volume, default_voxel
from client.synthetic.lighting.lights import disc_light
from client.synthetic.render import camera_rays, cast
from client.synthetic.solids.polyhedra import Solid, box, rotation_about
from client.synthetic.solids.round import Sphere
from client.synthetic.source import SyntheticSource, open_synthetic
from client.tuning.known_light import LitFrame, moving_light, shaded_views
from protocol.frames import RgbdFrame
from protocol.messages import Wishes
from tests.bench.light.light_score import Score, lag_of, score
from tests.bench.light.runs import PRESETS, REFERENCE, at_preset, refusal
from tests.bench.report.finished import Part
from tests.bench.report.run import Run

FRAMES, QUICK_FRAMES = 300, 12
SIZE = "320x240"
DOT_GOAL, PRESET_GOAL = ">= 0.999", "<= 0.003"
START_FRAMES = 3
"""After so many a light that has changed should have been followed; the first ones also have the least geometry."""
MOST_LAG, QUICK_LAG = 15, 6
"""Frames."""

_ENTRY_FRAMES = 6
_ENTRY_HEIGHT_M = 0.3
_SENSOR_NOISE_M = 0.002
_GREY = 150


@dataclass(frozen=True)
class Thing:
    """A box or a ball that stands on `place` in part of a sequence; put in from above, taken out the same way."""

    place: tuple[float, float, float]
    """World, of its foot."""
    size_m: float
    is_ball: bool
    when: tuple[float, float]
    """Shares of the sequence."""

    def solid(self, index: int, frames: int) -> Solid | None:
        """As it is in one frame; None while it is not there."""
        first, last = (round(share * frames) for share in self.when)
        if not first <= index < last:
            return None
        away = max(0.0, 1 - min(index - first + 1, last - index) / _ENTRY_FRAMES)
        x, y, z = self.place
        center = (x, y + self.size_m / 2 + _ENTRY_HEIGHT_M * away, z)
        if self.is_ball:
            return Sphere(np.array(center), self.size_m / 2)
        return box(center, (self.size_m,) * 3, rotation_about("y", 25))


@dataclass(frozen=True)
class Sequence:
    """One of the five."""

    name: str
    scene: str
    is_still: bool
    things: tuple[Thing, ...] = ()


_ON_TABLE = (
    Thing((0.02, 0.0, 0.05), 0.14, False, (0.2, 0.6)),
    Thing((0.3, 0.0, 0.28), 0.13, True, (0.35, 0.85)),
)
_IN_ROOM = (
    Thing((0.1, 0.0, -0.3), 0.4, False, (0.2, 0.6)),
    Thing((-0.2, 0.0, 0.5), 0.36, True, (0.35, 0.85)),
)
SEQUENCES = (
    Sequence("table, camera still", "table", True),
    Sequence("table, camera moving", "table", False),
    Sequence("room, camera moving", "room", False),
    Sequence("table, camera still, things in and out", "table", True, _ON_TABLE),
    Sequence("room, camera moving, things in and out", "room", False, _IN_ROOM),
)


class WithThings:
    """The frames of a synthetic scene, of which only depth and pose are of use here, with things before it."""

    def __init__(self, sequence: Sequence, frames: int) -> None:
        self.source: SyntheticSource = open_synthetic(
            f"synthetic:{sequence.scene}?size={SIZE}&frames={frames}&noise=1&texture=0"
        )
        if sequence.is_still:
            path = self.source.scene.camera_path
            self.source.scene = replace(self.source.scene, camera_path=lambda _time_s: path(0.0))
        self.camera = self.source.camera
        self._things, self._rays = sequence.things, camera_rays(self.camera)

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, index: int) -> RgbdFrame:
        frame = self.source[index]
        present = (thing.solid(index, len(self)) for thing in self._things)
        solids = [solid for solid in present if solid is not None]
        return self._before(frame, solids) if solids else frame

    def _before(self, frame: RgbdFrame, solids: list[Solid]) -> RgbdFrame:
        assert frame.world_from_camera is not None
        far, _ = cast(solids, self.camera, self._rays, frame.world_from_camera)
        far_m = far.reshape(frame.depth.shape)
        behind = (frame.depth == 0) | (frame.depth * self.camera.depth_scale_m > far_m)
        near = np.isfinite(far_m) & behind
        noise_m = np.random.default_rng(frame.index).normal(0, _SENSOR_NOISE_M, far_m.shape)
        units = np.rint((np.where(near, far_m, 0) + noise_m) / self.camera.depth_scale_m).clip(0, 65535)
        depth = np.where(near, units, frame.depth).astype(np.uint16)
        return replace(frame, depth=depth, color=np.where(near[..., None], np.uint8(_GREY), frame.color))


def light_of(index: int, frames: int = FRAMES) -> NDArray[np.float64]:
    """[16, 3] the disc light in frame `index`: once around in `frames`, 25 to 65 degrees high."""
    turn = 2 * np.pi * index / frames
    height = np.radians(45 + 20 * np.sin(2 * turn))
    level = np.cos(height)
    return disc_light(np.array([level * np.sin(turn), np.sin(height), level * np.cos(turn)])).sh


def sequence_part(run: Run, sequence: Sequence) -> Part:
    """All presets on one sequence."""
    frames = run.of(QUICK_FRAMES, FRAMES)
    part = Part(sizes={"frames of each E1 sequence": frames})
    source = WithThings(sequence, frames)
    volume_m = default_volume(source.source, range(frames))
    voxel_m = default_voxel(volume_m)
    wishes = Wishes(volume_m=volume_m, voxel_m=voxel_m, up=source.source.up, albedo="constant", indirect="none")
    lit = list(_say_progress(run, sequence.name, _shaded(run, source, wishes)))
    scores: dict[str, Score] = {}
    for preset in PRESETS:
        row = f"E1, {sequence.name}: {preset.upper()}"
        asked = at_preset(wishes, preset)
        if refusal(asked):
            continue
        run.say(f"E1, {sequence.name}: {preset}")
        scores[preset] = score(run.device, source.camera, lit, asked)
        _add_rows(part, row, scores[preset])
        _add_lag(part, row, scores[preset], lit, run.of(QUICK_LAG, MOST_LAG))
    middle = frames // 2
    for preset, found in scores.items():
        shown = {"true": lit[middle].sh.tolist(), "light": found.lights[middle].tolist()}
        part.details[preset] = {"dots": found.dots, "differences": found.differences, **shown}
    return part


def _shaded(run: Run, source: WithThings, wishes: Wishes) -> Iterator[LitFrame]:
    assert wishes.volume_m is not None
    assert wishes.voxel_m is not None
    views = shaded_views(
        run.device, source.camera, (source[i] for i in range(len(source))), wishes.volume_m, wishes.voxel_m
    )
    return moving_light(views, light_of)


def _say_progress(run: Run, name: str, frames: Iterator[LitFrame]) -> Iterator[LitFrame]:
    for item in frames:
        if (item.frame.index + 1) % 10 == 0:
            run.say(f"E1, {name}: {item.frame.index + 1} pictures shaded")
        yield item


def _add_rows(part: Part, row: str, found: Score) -> None:
    part.add(f"{row}: dot product of dominant directions, mean", float(np.mean(found.dots)), "")
    part.add(f"{row}: dot product of dominant directions, std", float(np.std(found.dots)), "")
    part.add(f"{row}: environment map, relative MSAD, median", float(np.median(found.differences)), "")


def _add_lag(part: Part, row: str, found: Score, lit: list[LitFrame], most: int) -> None:
    late, angle_deg = lag_of(found.lights, [item.sh for item in lit], most)
    part.add(f"{row}: late by", late, "frames")
    part.add(f"{row}: mean angle to the light of so many frames before", angle_deg, "deg")


def overall_part(details: Mapping[str, Mapping[str, Any]]) -> Part:
    """Means over all frames of all sequences; `details` of their parts by name."""
    part = Part()
    means = {}
    for preset in PRESETS:
        found = [details[s.name][preset] for s in SEQUENCES if preset in details.get(s.name, {})]
        if len(found) < len(SEQUENCES):
            part.leave_out(f"E1: {preset.upper()}", refusal(at_preset(Wishes(), preset)) or "not on all sequences")
            continue
        dots = np.concatenate([item["dots"] for item in found])
        row = f"E1, all sequences: {preset.upper()}"
        means[preset] = float(dots.mean())
        goal = DOT_GOAL if preset == REFERENCE else ""
        part.add(f"{row}: dot product of dominant directions, mean", means[preset], "", goal)
        part.add(f"{row}: mean angle", float(np.degrees(np.arccos(np.clip(dots, -1, 1))).mean()), "deg")
        steady = np.concatenate([item["dots"][START_FRAMES:] for item in found])
        if len(steady):
            part.add(f"{row}: mean dot product without the first {START_FRAMES} frames", float(steady.mean()), "")
        differences = np.concatenate([item["differences"] for item in found])
        part.add(f"{row}: environment map, relative MSAD, median", float(np.median(differences)), "")
        if preset != REFERENCE and REFERENCE in means:
            part.add(f"{row}: below RM by", means[REFERENCE] - means[preset], "", PRESET_GOAL)
    return part
