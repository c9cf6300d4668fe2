"""A light inside the room (B4): where the search finds lamps, how strong, and whether it finds some where none are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import permutations
from statistics import median

import numpy as np
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from client.sources.volume import default_volume, default_voxel
from client.synthetic.lighting.lamps import Lamp
from client.synthetic.source import SyntheticSource, open_synthetic
from protocol.messages import Wishes
from server.geometry.geometry import Geometry
from server.light.lamp_finder import VIEW_SAMPLES
from server.light.near_light import search_lamps
from server.light.near_samples import see_samples
from server.maths.emitters import Emitter
from server.maths.near_light import result_of
from server.maths.sh import LUMINANCE
from server.opencl.device import Device
from server.opencl.engine import Engine
from tests.bench.geometry.parts import Run
from tests.bench.report.finished import Part

POSITION_GOAL_M = 0.1
SHARE_GOAL = 0.1
SCENE = "size=320x240&frames=90"
FRAMES = range(0, 90, 18)
INSIDE = (0, 1, 4, 5, 6, 7)
"""Places within what the cameras see, and so within the volume."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Search:
    """What a search gave and what is true."""

    found: tuple[Emitter, ...]
    origin_world: Floats
    lamps: tuple[Lamp, ...]
    share: float
    """Of the light (luminance) on the samples, from all lamps."""

    def position_error_m(self) -> float:
        """The mean over lamps, matched the best way; infinite where their number is wrong."""
        if len(self.found) != len(self.lamps):
            return float("inf")
        places = np.array([lamp.position for lamp in self.lamps])
        found = np.array([emitter.position for emitter in self.found]) + self.origin_world
        orders = permutations(range(len(places)))
        return min(float(np.linalg.norm(found[list(order)] - places, axis=1).mean()) for order in orders)

    def share_error(self) -> float:
        """Of all lamps' share of the light, in proportion."""
        return abs(sum(emitter.share for emitter in self.found) / self.share - 1)


def search(device: Device, spec: str) -> Search:
    """Five frames of half the camera's path, with given poses."""
    source = open_synthetic(spec)
    bounds = default_volume(source, range(len(source)))
    wishes = Wishes(volume_m=bounds, voxel_m=default_voxel(bounds), up=source.up)
    engine = Engine(device)
    try:
        geometry, random = Geometry(engine, source.camera, wishes), np.random.default_rng(1)
        views, near, all_light = [], 0.0, 0.0
        for index in FRAMES:
            frame = geometry.scan(source[index])
            volume, radiance = geometry.volume, frame.measurement.radiance
            assert volume is not None
            seen, lamps_only = (
                see_samples(engine, source.camera, light, frame.surface, volume)
                for light in (radiance, _lamplight(engine, source, index, radiance))
            )
            views.append(seen.thinned(VIEW_SAMPLES, random))
            near += float((lamps_only.colors @ LUMINANCE).sum())
            all_light += float((seen.colors @ LUMINANCE).sum())
        assert volume is not None
        found = result_of(search_lamps(engine, volume, sum(views[1:], views[0])))
        return Search(found.emitters, volume.origin_world, source.lamps, near / all_light)
    finally:
        engine.close()


def _lamplight(engine: Engine, source: SyntheticSource, index: int, radiance):  # type: ignore[no-untyped-def]
    """[h, w] float4 on the device: the lamps' part of the picture `radiance`, usable where that is."""
    lamplight = engine.download(radiance).view(np.float32).reshape(*radiance.shape, 4).copy()
    lamplight[..., :3] = source.truth(index).lamplight
    return engine.workspace.upload("bench_lamplight", lamplight.view(cl_types.float4)[..., 0])


def lamp_specs(quick: bool) -> list[str]:
    """Rooms with one lamp where it can be found."""
    places = INSIDE[:3] if quick else INSIDE
    return [f"synthetic:lamp?{SCENE}&place={place}" for place in places]


def dark_specs(quick: bool) -> list[str]:
    """Rooms and tables without a lamp: every light of the ring, with and without textures."""
    lights = (1, 4, 6) if quick else range(8)
    rooms = [f"synthetic:room?{SCENE}&light={light}&texture={t}" for light in lights for t in (0, 1)]
    return rooms + [f"synthetic:table?{SCENE}&light={light}&texture={t}" for light in lights for t in (0, 1)]


def lamp_part(run: Run) -> Part:
    """Rows for one lamp, two lamps, textures, and none."""
    part = Part()
    one = _searches(run, lamp_specs(run.quick), "lamps")
    dark = _searches(run, dark_specs(run.quick), "rooms without a lamp")
    part.sizes |= {"rooms with a lamp": len(one), "scenes without a lamp": len(dark)}
    _add_lamp_rows(part, "one lamp", one)
    for place, result in zip(INSIDE, one, strict=False):
        part.add(f"one lamp, place {place}: position error", 100 * result.position_error_m(), "cm")
        part.add(f"one lamp, place {place}: share of the light, error", 100 * result.share_error(), "%")
    wrong = sum(len(result.found) > 0 for result in dark)
    part.add("no lamp: scenes where one was found", wrong, "scenes", "<= 0")
    two = _searches(run, [f"synthetic:lamp?{SCENE}&place=1&lamps=2"], "two lamps")
    _add_lamp_rows(part, "two lamps", two, goal=False)
    painted = _searches(run, [f"{spec}&texture=1" for spec in lamp_specs(True)], "textured rooms")
    _add_lamp_rows(part, "one lamp, textured room, one albedo assumed", painted, goal=False)
    return part


def _searches(run: Run, specs: Sequence[str], name: str) -> list[Search]:
    results = []
    for spec in specs:
        results.append(search(run.device, spec))
        run.say(f"{name}: {len(results)} of {len(specs)}")
    return results


def _add_lamp_rows(part: Part, name: str, results: Sequence[Search], goal: bool = True) -> None:
    right = [result for result in results if np.isfinite(result.position_error_m())]
    found = f">= {len(results)}" if goal else ""
    part.add(f"{name}: scenes where as many were found, of {len(results)}", len(right), "scenes", found)
    if not right:
        part.leave_out(f"{name}: position and share", "none was found")
        return
    measures: tuple[tuple[str, Callable[[Sequence[float]], float]], ...] = (("median", median), ("worst", max))
    for words, pick in measures:
        position = 100 * pick([result.position_error_m() for result in right])
        share = 100 * pick([result.share_error() for result in right])
        part.add(f"{name}: position error, {words}", position, "cm", f"<= {100 * POSITION_GOAL_M:.0f}" if goal else "")
        part.add(
            f"{name}: share of the light, error, {words}", share, "%", f"<= {100 * SHARE_GOAL:.0f}" if goal else ""
        )
    part.add(f"{name}: largest error of a colour over green", _worst_color(right), "%")


def _worst_color(results: Sequence[Search]) -> float:
    """Of red over green and blue over green, percent, over scenes with one lamp."""
    worst = 0.0
    for result in results:
        if len(result.found) == 1:
            found, true = result.found[0].intensity, result.lamps[0].intensity
            worst = max(worst, *np.abs((found / found[1]) / (true / true[1]) - 1).tolist())
    return 100 * worst
