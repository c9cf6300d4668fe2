"""The kitchen's first frames in other volumes, from other origins, with other noise, without one of them: the light
stays the same.

It is the light from beyond the scan, of `light.jsonl`'s `sh`, found as `probeless run` does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from client.sources.frame_source import Source
from client.sources.volume import Volume, default_volume, default_voxel
from protocol.frames import RgbdFrame
from protocol.messages import Wishes
from server.maths.light_direction import direction_error_deg
from tests.bench.light.places import KITCHEN
from tests.bench.light.runs import light_in, results_of
from tests.bench.report.finished import Part
from tests.bench.report.run import Run, data_source

FRAMES = 20
VOLUMES = (20, 30, 40, 60, 100)
"""Frames that an automatic volume is for; the first is that of all other changes."""
NOISES, LEFT_OUT = 3, (0, 3, 7)
QUICK_VOLUMES = 2
"""Of a quick run, which has one of all else."""
COARSER = 1.25
"""Size of the larger voxels, over the default."""
ORIGINS_M = (0.04, 0.08, 0.11)
"""By how much the world's origin is moved along each axis: quarters of a patch, rounded to whole voxels, so that scan
and rays stay as they are."""

Lights = dict[int, tuple[NDArray[np.float64], float]]
"""By frame: [bands^2, 3], and its spread in degrees."""


@dataclass(frozen=True)
class _Kitchen:
    run: Run
    source: Source

    def lights(self, volume: Volume, voxel_m: float, frames: Mapping[int, RgbdFrame]) -> Lights:
        """Of one session."""
        wishes = Wishes(volume_m=volume, voxel_m=voxel_m, up=self.source.up)
        found = results_of(self.run.device, self.source, (replace(frame) for frame in frames.values()), wishes)
        return {
            i: (light_in(result), result.light.spread_deg or 180.0) for i, result in zip(frames, found, strict=True)
        }

    def changed(self) -> dict[str, list[Lights]]:
        """What other volumes, noise and so on give; of "volumes" the first is as it is."""
        frames = {i: self.source[i] for i in range(FRAMES)}
        volumes = {
            n: default_volume(self.source, range(n)) for n in VOLUMES[: self.run.of(QUICK_VOLUMES, len(VOLUMES))]
        }
        volume = volumes[VOLUMES[0]]
        voxel_m = default_voxel(volume)
        noises, left_out, origins = (self.run.of(1, n) for n in (NOISES, len(LEFT_OUT), len(ORIGINS_M)))
        return {
            "volumes": [self.lights(other, default_voxel(other), frames) for other in volumes.values()],
            "half a voxel's shift": [self.lights(moved_volume(volume, voxel_m / 2), voxel_m, frames)],
            "voxels a quarter larger": [self.lights(volume, COARSER * voxel_m, frames)],
            "another origin": [
                self.lights(moved_volume(volume, by_m), voxel_m, moved_frames(frames, by_m))
                for by_m in ORIGINS_M[:origins]
            ],
            "one code of noise": [self.lights(volume, voxel_m, noisy_frames(frames, seed)) for seed in range(noises)],
            "a frame left out": [
                self.lights(volume, voxel_m, {i: frame for i, frame in frames.items() if i != without})
                for without in LEFT_OUT[:left_out]
            ],
        }


def same_frames_part(run: Run) -> Part:
    """How far each change turns the light, and by how much of its spread."""
    run.say("kitchen, the same frames")
    changed = _Kitchen(run, data_source(KITCHEN)).changed()
    part = Part(sizes={"frames of the kitchen that are the same": FRAMES})
    first = changed["volumes"][0]
    goals = {"volumes": "<= 3", "half a voxel's shift": "<= 2", "one code of noise": "<= 2"}
    for words, sessions in changed.items():
        pairs = list(combinations(sessions, 2)) if words == "volumes" else [(first, lights) for lights in sessions]
        turns, shares = turns_between(pairs)
        row = f"kitchen, the same frames, {words}"
        part.add(f"{row}: light turns by, median", float(np.median(turns)), "deg")
        part.add(f"{row}: light turns by, at most", max(turns), "deg", goals.get(words, ""))
        part.add(f"{row}: light turns by, at most, of its spread", 100 * max(shares), "%", "<= 100")
    return part


def turns_between(pairs: list[tuple[Lights, Lights]]) -> tuple[list[float], list[float]]:
    """Degrees, and the same over the lesser spread, of all frames that both have."""
    turns, shares = [], []
    for some, others in pairs:
        for index in sorted(some.keys() & others.keys()):
            turns.append(direction_error_deg(some[index][0], others[index][0]))
            shares.append(turns[-1] / min(some[index][1], others[index][1]))
    return turns, shares


def moved_frames(frames: Mapping[int, RgbdFrame], by_m: float) -> dict[int, RgbdFrame]:
    """The same, seen in a world whose origin lies `by_m` metres farther back along each axis."""
    moved = {}
    for index, frame in frames.items():
        assert frame.world_from_camera is not None
        pose = np.array(frame.world_from_camera, np.float64)
        pose[:3, 3] += by_m
        moved[index] = replace(frame, world_from_camera=pose)
    return moved


def moved_volume(volume: Volume, by_m: float) -> Volume:
    """`volume`, moved by `by_m` metres along each axis."""
    x0, y0, z0, x1, y1, z1 = (side + by_m for side in volume)
    return x0, y0, z0, x1, y1, z1


def noisy_frames(frames: Mapping[int, RgbdFrame], seed: int) -> dict[int, RgbdFrame]:
    """Every value one less, the same or one more, by chance."""
    random = np.random.default_rng(seed)
    noisy = {}
    for index, frame in frames.items():
        codes = frame.color + random.integers(-1, 2, frame.color.shape)
        noisy[index] = replace(frame, color=codes.clip(0, 255).astype(np.uint8))
    return noisy
