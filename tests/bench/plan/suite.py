"""`probeless bench plan`: does each frame run what its scene calls for, and is what is left out not seen (U3).

Every scene of the gallery (client/gallery) goes through the pipeline as planned, with everything simulated that can
be, and as planned with the caches of earlier frames, which the first two do without. Time is processor time over all
cores, which other load distorts least.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from client.commands.explain import is_of_noise
from client.gallery.play import play, wishes_of
from client.gallery.scenes import GALLERY
from client.gallery.source import GallerySource
from protocol.messages import Plan
from server.culling.spine import GIVEN_LIGHT
from server.opencl.device import Device, open_device
from server.shading.kept_changes import HARDLY
from server.transfer.kept_bounds import MEASURED, NOT_YET
from tests.bench.rendering.flip import flip_map
from tests.bench.rendering.speed import EVERYTHING as WHOLE_STAGE
from tests.bench.rendering.speed import StageClock, clocked
from tests.bench.report.processor import ProcessorTime
from tests.bench.report.report import Report, Row, Unmeasured

OUT = Path("out/bench/plan")
LARGE_WIDTH = 320
CAMERA_WIDTH, CAMERA_FRAMES = 640, 24
"""A camera's own pictures, and frames enough for what is kept to be met again."""
QUICK_AT_CAMERA = ("closed-room", "soft-sky", "sharp-sun")
KEPT_FRAMES = 80
"""Frames whose last 32 tell how far off what is kept may be: in the others its bound is not known yet."""
HELD = frozenset({"composite"})
"""Effects of a frame whose virtual things are held."""
WARM_UP = 2
"""Frames whose time does not count: kernels are compiled in them."""


@dataclass(frozen=True)
class Played:
    """One frame, played one way."""

    color: NDArray[np.uint8]
    plan: Plan
    cpu_ms: float
    rendering_ms: float


def run_suite(quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure; `say` gets progress."""
    device = open_device(None)
    report = Report(device.name)
    saved: dict[str, float] = {}
    rendering_saved: list[float] = []
    with_caches: dict[str, Cached] = {}
    OUT.mkdir(parents=True, exist_ok=True)
    rounds = 1 if quick else 3
    for name in GALLERY:
        say(name)
        source = GallerySource(name)
        pairs = _pairs(device, source, rounds)
        _compare(report, name, source, *pairs[0])
        frames = range(WARM_UP, len(source))
        if not source.scene.resting_frames:
            with_caches[name] = _cached(device, source, [everything for _, everything in pairs])
            _beside(report, f"{name}: time saved by plan and caches, of the whole frame", with_caches[name].saved)
        saved[name] = _saved(pairs, frames, lambda frame: frame.cpu_ms)
        rendering_saved.append(_saved(pairs, frames, lambda frame: frame.rendering_ms))
        _beside(report, f"{name}: time saved, of the whole frame", saved[name])
        _beside(report, f"{name}: time saved, of rendering", rendering_saved[-1])
        if source.scene.resting_frames:
            at_rest = _saved(pairs, source.scene.resting_frames, lambda frame: frame.cpu_ms)
            _beside(report, f"{name}: time saved, of the frames known to rest", at_rest)
        cv2.imwrite(str(OUT / f"{name}.png"), pairs[0][0][-1].color[..., ::-1])
    _add_cached(report, "gallery, where nothing rests", list(with_caches.values()))
    _add_kept_bounds(report, device, say, QUICK_AT_CAMERA if quick else tuple(with_caches))
    _add_at_camera(report, device, say, QUICK_AT_CAMERA if quick else tuple(with_caches))
    _beside_medians(report, "gallery", saved)
    _beside(report, "gallery: time saved, of rendering, median", median(rendering_saved))
    if not quick:
        _add_larger(report, device, say)
    report.rows.append(Row("gallery: scenes", len(GALLERY), "", ">= 12"))
    report.sizes["rounds"] = rounds
    report.sizes["frames of the gallery"] = sum(len(GallerySource(name)) for name in GALLERY)
    if find_spec("flip_evaluator") is None:
        report.unmeasured.append(Unmeasured("FLIP", "flip_evaluator not installed: make install-bench"))
    result = report.as_dict()
    (OUT / "result.json").write_text(json.dumps(result, indent=1, allow_nan=False))
    return result


def played(device: Device, source: GallerySource, plan: str, cache: str = "off") -> list[Played]:
    """Every frame of a scene. Bounds are of the plan alone, without caches."""
    for index in range(len(source)):
        source[index]  # its own time does not count
    frames: list[Played] = []
    wishes = wishes_of(source, plan=plan, cache=cache)
    with closing(play(device, source, wishes)) as results:
        clock = None
        pipeline = None
        for _ in range(len(source)):
            if pipeline is None:
                spent = ProcessorTime()
                pipeline, result = next(results)
                clock = StageClock(pipeline._engine.queue)
                rendering_ms = 0.0
            else:
                assert clock is not None
                with clocked(pipeline, clock):
                    spent = ProcessorTime()
                    _, result = next(results)
                rendering_ms = clock.cpu_ms[WHOLE_STAGE][-1]
            frames.append(Played(result.color, result.plan, spent.ms(), rendering_ms))
    return frames


def is_as_known(source: GallerySource, index: int, plan: Plan) -> bool:
    """Whether a frame ran what its scene calls for, and the spine rested where it could; where it hangs on noise when a
    view has settled, it may."""
    scene = source.scene
    if changed_share(plan) > scene.largest_changed_share:
        return False
    run, called = (
        frozenset(plan.run) - scene.noise_dependent_effects,
        scene.expected_effects(index) - scene.noise_dependent_effects,
    )
    if index in scene.settling_frames:
        return run in (HELD, called)
    return run == (HELD if index in scene.held_frames else called) and is_at_rest(plan) == (
        index in scene.resting_frames
    )


def is_at_rest(plan: Plan) -> bool:
    """Whether the spine learns nothing from a frame because the view is still, and not because its light is given."""
    return any(left.effect == "estimate_light" and left.reason != GIVEN_LIGHT.reason for left in plan.left_out)


def changed_share(plan: Plan) -> float:
    """Of the picture, as the plan says it; 0 where it does not."""
    said = (re.search(r"change (\d+) % of the picture", left.reason) for left in plan.left_out)
    return max((int(found[1]) / 100 for found in said if found), default=0.0)


def stated_bound(plan: Plan, reference: Plan) -> float:
    """Display units before rounding that what is left out here alone may change; equal reasons count once."""
    neither = {left.effect for left in reference.left_out}
    omissions = {(left.reason, left.error_bound) for left in plan.left_out if left.effect not in neither}
    return sum(bound or 0.0 for _, bound in omissions)


def holds(bound: float, difference: int) -> bool:
    """Whether pictures that differ by so many codes can be within `bound` before rounding, which adds less than 1."""
    return difference == 0 if bound == 0 else difference < bound + 1


def greatest(plan: Plan, difference: NDArray[np.int_]) -> int:
    """Of a difference [h, w, 3], in codes; where a plan says so of its bound, of all but a thousandth of the pixels."""
    of_pixels = difference.max(axis=-1)
    if not any(is_of_noise(left) for left in plan.left_out):
        return int(of_pixels.max())
    return int(np.quantile(of_pixels, 1 - HARDLY, method="higher"))


def _compare(report: Report, name: str, source: GallerySource, needed: list[Played], everything: list[Played]) -> None:
    differences = [np.abs(a.color.astype(int) - b.color) for a, b in zip(needed, everything, strict=True)]
    bounds = [stated_bound(a.plan, b.plan) for a, b in zip(needed, everything, strict=True)]
    as_known = [is_as_known(source, i, a.plan) for i, a in enumerate(needed)]
    kept = [holds(b, greatest(a.plan, d)) for b, a, d in zip(bounds, needed, differences, strict=True)]
    within = min(float((d.max(axis=-1) <= 1).mean()) for d in differences)
    report.rows.append(Row(f"{name}: frames whose plan is the known one", float(np.mean(as_known)), "share", ">= 1"))
    report.rows.append(Row(f"{name}: pixels within 1/255, worst frame", within, "share", ">= 0.999"))
    report.rows.append(Row(f"{name}: frames whose bounds hold", float(np.mean(kept)), "share", ">= 1"))
    report.rows.append(Row(f"{name}: greatest difference", max(int(d.max()) for d in differences), "1/255", ""))
    report.rows.append(Row(f"{name}: greatest bound", max(bounds), "1/255", ""))
    if find_spec("flip_evaluator") is not None:
        flips = [float(flip_map(b.color, a.color).mean()) for a, b in zip(needed, everything, strict=True)]
        report.rows.append(Row(f"{name}: FLIP, worst frame", max(flips), "", "<= 0.005"))


@dataclass(frozen=True)
class Cached:
    """A scene as planned with caches, against everything without them."""

    saved: float
    """Share of the time."""
    within: list[float]
    """Share of the pixels within 1/255, of each frame."""


def _cached(device: Device, source: GallerySource, everything: list[list[Played]]) -> Cached:
    """As often as `everything` was played; beforehand once for what is compiled and made."""
    played(device, source, "needed", "on")
    pairs = [(played(device, source, "needed", "on"), whole) for whole in everything]
    saved = _saved(pairs, range(WARM_UP, len(source)), lambda frame: frame.cpu_ms)
    differences = [np.abs(a.color.astype(int) - b.color).max(axis=-1) for a, b in zip(*pairs[0], strict=True)]
    return Cached(saved, [float((d <= 1).mean()) for d in differences])


def kept_bounds_hold(cached: Sequence[Played], exact: Sequence[Played]) -> list[bool | None]:
    """Whether frames that have something kept are within the bounds that their plans state of it, but for a thousandth
    of the pixels, of frames with nothing kept; None where a bound is not known yet."""
    held: list[bool | None] = []
    for a, b in zip(cached, exact, strict=True):
        bounds = [left.error_bound for left in a.plan.left_out if left.reason.endswith((MEASURED, NOT_YET))]
        known = [bound for bound in bounds if bound is not None]
        apart = np.abs(a.color.astype(int) - b.color).max(axis=-1)
        most = int(np.quantile(apart, 1 - HARDLY, method="higher"))
        if bounds:
            held.append(holds(sum(known), most) if len(known) == len(bounds) else None)
    return held


def _add_kept_bounds(report: Report, device: Device, say: Callable[[str], None], names: Sequence[str]) -> None:
    """As long as it takes until what was kept at first was found anew."""
    held: list[bool | None] = []
    for name in names:
        say(f"{name}, {KEPT_FRAMES} frames with caches and without")
        source = GallerySource(name, frames=KEPT_FRAMES)
        held += kept_bounds_hold(played(device, source, "needed", "on"), played(device, source, "needed", "off"))
    what = f"gallery, {KEPT_FRAMES} frames, where nothing rests"
    known = [frame for frame in held if frame is not None]
    report.rows.append(
        Row(f"{what}: frames with something kept whose bounds are known", len(known) / len(held), "share", "")
    )
    row = f"{what}: of these, frames whose bounds hold"
    report.rows.append(Row(row, float(np.mean(known)) if known else 0.0, "share", ">= 1"))


def _add_at_camera(report: Report, device: Device, say: Callable[[str], None], names: Sequence[str]) -> None:
    """Plan and caches at the size and for the time that a camera has."""
    scenes = []
    for name in names:
        say(f"{name}, {CAMERA_WIDTH} pixels wide, {CAMERA_FRAMES} frames")
        source = GallerySource(name, CAMERA_WIDTH, CAMERA_FRAMES)
        scenes.append(_cached(device, source, [played(device, source, "everything")]))
        row = f"{name}, {CAMERA_WIDTH} pixels wide, {CAMERA_FRAMES} frames: time saved by plan and caches"
        _beside(report, row, scenes[-1].saved)
    what = f"gallery, {CAMERA_WIDTH} pixels wide, {CAMERA_FRAMES} frames, where nothing rests"
    _add_cached(report, what, scenes)
    within = median(median(scene.within) for scene in scenes)
    report.rows.append(Row(f"{what}: pixels within 1/255, median frame, median", within, "share", ""))
    report.sizes["scenes at a camera's size"] = len(scenes)


def _add_cached(report: Report, what: str, scenes: list[Cached]) -> None:
    """Medians of the scenes in which something always moves."""
    saved, within = median(scene.saved for scene in scenes), median(min(scene.within) for scene in scenes)
    report.rows.append(Row(f"{what}: time saved by plan and caches, median", 100 * saved, "%", ">= 40"))
    row = f"{what}: pixels within 1/255 with plan and caches, worst frame, median"
    report.rows.append(Row(row, within, "share", ">= 0.999"))


def _add_larger(report: Report, device: Device, say: Callable[[str], None]) -> None:
    """The gallery at LARGE_WIDTH, where the host's own time counts for less."""
    saved: dict[str, float] = {}
    for name in GALLERY:
        say(f"{name}, {LARGE_WIDTH} pixels wide")
        source = GallerySource(name, LARGE_WIDTH)
        pairs = _pairs(device, source, 1)
        saved[name] = _saved(pairs, range(WARM_UP, len(source)), lambda frame: frame.cpu_ms)
        _beside(report, f"{name}, {LARGE_WIDTH} pixels wide: time saved, of the whole frame", saved[name])
        differences = [np.abs(a.color.astype(int) - b.color).max(axis=-1) for a, b in zip(*pairs[0], strict=True)]
        within = min(float((d <= 1).mean()) for d in differences)
        row = f"{name}, {LARGE_WIDTH} pixels wide: pixels within 1/255, worst frame"
        report.rows.append(Row(row, within, "share", ""))
    _beside_medians(report, f"gallery, {LARGE_WIDTH} pixels wide", saved)


def _beside_medians(report: Report, what: str, saved: dict[str, float]) -> None:
    """Of all scenes, of those where something always moves, and of those that come to rest."""
    rest = [value for name, value in saved.items() if GALLERY[name].resting_frames]
    moving = [value for name, value in saved.items() if not GALLERY[name].resting_frames]
    _beside(report, f"{what}: time saved, of the whole frame, median of all", median(saved.values()))
    _beside(report, f"{what}: time saved, of the whole frame, median where nothing rests", median(moving))
    _beside(report, f"{what}: time saved, of the whole frame, median where a view comes to rest", median(rest))


def _beside(report: Report, name: str, share: float) -> None:
    report.rows.append(Row(name, 100 * share, "%", ""))


def _pairs(device: Device, source: GallerySource, rounds: int) -> list[tuple[list[Played], list[Played]]]:
    """So many times as planned, and with everything; beforehand once for what is compiled and made."""
    played(device, source, "needed")
    return [(played(device, source, "needed"), played(device, source, "everything")) for _ in range(rounds)]


def _saved(
    pairs: list[tuple[list[Played], list[Played]]], frames: Sequence[int], spent: Callable[[Played], float]
) -> float:
    """Share of everything's time that the plan saves: of each frame the median over rounds, summed over `frames`."""
    needed, everything = (sum(median(spent(pair[which][i]) for pair in pairs) for i in frames) for which in (0, 1))
    return 1 - needed / everything
