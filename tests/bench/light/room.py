"""`mitsuba_room`: each preset's light against the path tracer's, and the virtual objects under it against its pictures.

Every set is run with what it calls for (the row says which): estimated albedos, and observed indirect light where there
is any.
"""

from __future__ import annotations

from statistics import median
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from client.options.source import open_source
from protocol.messages import Wishes
from server.input.measure import linear_values
from server.maths.light_direction import direction_error_deg
from server.pipeline import FrameResult
from server.quality.settings import THESIS_REACH_M
from tests.bench.light.environment import irradiance_error, relative_rmse
from tests.bench.light.runs import PRESETS, REFERENCE, Exposed, at_preset, light_in, refusal, results_of, wishes_for
from tests.bench.report.finished import Part
from tests.bench.report.run import Run, data_folder
from tests.bench.truth.mitsuba_room import OBJECTS, RoomSet, model_for, room_sets
from tests.bench.truth.object_shading import ObjectShading

Floats = NDArray[np.float64]

DIRECTION_GOALS_DEG = {
    "key_white_direct": 3, "two_white_direct": 3, "studio_white_direct": 8,
    "key_white_gi": 8, "two_white_gi": 8, "studio_white_gi": 8,
    "key_tex_direct": 12, "two_tex_direct": 12, "studio_tex_direct": 12,
    "key_tex_gi": 15, "two_tex_gi": 15, "studio_tex_gi": 15,
}  # fmt: skip
IRRADIANCE_GOALS = {
    "key_white_direct": 10, "two_white_direct": 10,
    "key_white_gi": 15, "two_white_gi": 15, "studio_white_gi": 15,
}  # fmt: skip
NEAR_REFERENCE_DEG = {"art4": 2, "gr15fast": 4}
"""On white, direct sets."""
SHADING_GOALS: dict[str, dict[str, int]] = {
    REFERENCE: {"white_direct": 5, "white_gi": 10, "tex_gi": 15},
    "gr15fast": {"white_direct": 10, "white_gi": 15, "tex_gi": 20},
}
THESIS = "as the thesis prints it"
QUICK_FRAMES = 3
EXPOSURE = 0.5
"""Of the pictures fed in, so that composites brighter than the truth do not clip; scale is not compared."""


class RoomBench:
    """All sets, and their objects' pixels where Open3D is installed."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self.room = data_folder("mitsuba_room")
        first = open_source(str(room_sets(self.room)[0].folder))
        self.shading: ObjectShading | None = None
        self.no_shading = ""
        self.refused = {preset: refusal(at_preset(Wishes(), preset)) for preset in PRESETS}
        self.presets = [preset for preset, reason in self.refused.items() if not reason]
        self.refused = {preset: reason for preset, reason in self.refused.items() if reason}
        try:
            poses = [frame.world_from_camera for frame in (first[i] for i in range(len(first)))]
            self.shading = ObjectShading(self.room, first.camera, [pose for pose in poses if pose is not None])
        except ImportError:
            self.no_shading = "open3d is not installed: make install-bench"


def room_part(run: Run) -> Part:
    """All twelve sets at all presets."""
    bench = RoomBench(run)
    part = Part()
    for name, refused in bench.refused.items():
        part.leave_out(f"mitsuba_room: {name.upper()}", refused)
    for item in room_sets(bench.room):
        part.details[item.name] = _add_set(part, bench, item)
    return part


def _add_set(part: Part, bench: RoomBench, item: RoomSet) -> dict[str, Any]:
    """Rows of one set; what pictures are drawn from."""
    source = Exposed(open_source(str(item.folder)), EXPOSURE)
    frames = range(bench.run.of(QUICK_FRAMES, len(source)))
    wishes = msgspec.structs.replace(wishes_for(source.source, range(len(source))), edges="hard")  # as the truth
    part.sizes["frames of each mitsuba_room set"] = len(frames)
    details: dict[str, Any] = {"true": item.sh.tolist()}
    errors: dict[str, float] = {}
    for name in (*bench.presets, THESIS):
        asked = _asked(item, wishes, name)
        row = f"{item.name}: {name if name == THESIS else name.upper()}"
        bench.run.say(f"{item.name}: {name}")
        words = f"{row}, {_model(asked)}"
        objects = [bench.room / "objects" / file for file in OBJECTS]
        found = results_of(bench.run.device, source.source, (source[i] for i in frames), asked, objects)
        lights = [light_in(result) for result in found]
        errors[name] = median(direction_error_deg(light, item.sh) for light in lights)
        _add_light(part, words, item, name, lights, errors)
        _add_shading(part, bench, words, item, name, asked, found)
        details[name] = lights[-1].tolist()
    _add_floors(part, bench, item, wishes, source, frames)
    return details


def _asked(item: RoomSet, wishes: Wishes, name: str) -> Wishes:
    """The wishes of a preset, or of the thesis's method."""
    if name == THESIS:
        return msgspec.structs.replace(wishes, as_thesis=True, albedo="constant", indirect="none")
    return model_for(item, at_preset(wishes, name))


def _model(wishes: Wishes) -> str:
    return "plain least squares" if wishes.as_thesis else f"albedo {wishes.albedo}, indirect {wishes.indirect}"


def _add_light(part: Part, row: str, item: RoomSet, name: str, lights: list[Floats], errors: dict[str, float]) -> None:
    direction_goal = f"<= {DIRECTION_GOALS_DEG[item.name]}" if name == REFERENCE else ""
    part.add(f"{row}: dominant direction, median error", errors[name], "deg", direction_goal)
    irradiance = median(irradiance_error(light, item.sh) for light in lights)
    held = name == REFERENCE and item.name in IRRADIANCE_GOALS
    goal = f"<= {IRRADIANCE_GOALS[item.name]}" if held else ""
    part.add(f"{row}: irradiance over all normals, median error", 100 * irradiance, "%", goal)
    if name in NEAR_REFERENCE_DEG and REFERENCE in errors:
        white = (item.surface, item.transport) == ("white", "direct")
        goal = f"<= {NEAR_REFERENCE_DEG[name]}" if white else ""
        part.add(f"{row}: dominant direction, error more than RM's", errors[name] - errors[REFERENCE], "deg", goal)


def _add_shading(
    part: Part, bench: RoomBench, row: str, item: RoomSet, name: str, wishes: Wishes, found: list[FrameResult]
) -> None:
    """By exact geometry, and as the composite shows it."""
    if not item.has_composites:
        return
    number = SHADING_GOALS.get(name, {}).get(f"{item.surface}_{item.transport}")
    goal = f"<= {number}" if number else ""
    if bench.shading is None:
        part.leave_out(f"{row}: objects' radiance", bench.no_shading)
        return
    shading = bench.shading
    pictures = [EXPOSURE * item.picture(i) for i in range(len(shading.frames))]
    ray_length_m = THESIS_REACH_M if wishes.as_thesis else np.inf
    observed = pictures if wishes.indirect == "observed" else None
    exact = [shading.error(item, i, light_in(result), ray_length_m, observed) for i, result in enumerate(found)]
    part.add(f"{row}: objects' radiance, exact geometry, median error", 100 * median(exact), "%", goal)
    shown = [_shown_error(item, shading, i, result) for i, result in enumerate(found)]
    part.add(f"{row}: objects' radiance, composite, median error", 100 * median(shown), "%", goal)


def _add_floors(part: Part, bench: RoomBench, item: RoomSet, wishes: Wishes, source: Exposed, frames: range) -> None:
    """What the true light's 16 coefficients leave, by exact geometry and as the pipeline renders them."""
    if bench.shading is None or not item.has_composites:
        return
    shading, row = bench.shading, f"{item.name}: true light's 16 coefficients: objects' radiance"
    floor = [shading.error(item, i, item.sh) for i in frames]
    part.add(f"{row}, exact geometry, no indirect light, median error", 100 * median(floor), "%")
    given = msgspec.structs.replace(_asked(item, wishes, REFERENCE), light=in_picture(item, source))
    objects = [bench.room / "objects" / file for file in OBJECTS]
    found = results_of(bench.run.device, source.source, (source[i] for i in frames), given, objects)
    shown = [_shown_error(item, shading, i, result) for i, result in enumerate(found)]
    part.add(f"{row}, composite, {_model(given)}, median error", 100 * median(shown), "%")


def in_picture(item: RoomSet, source: Exposed) -> tuple[tuple[float, float, float], ...]:
    """The true light in the units of the exposed picture."""
    meta: dict[str, Any] = source.source.meta  # type: ignore[attr-defined]
    light = item.sh * (source.factor / float(meta["radiance_at_65535"]))
    return tuple((float(r), float(g), float(b)) for r, g, b in light)


def _shown_error(item: RoomSet, shading: ObjectShading, index: int, result: FrameResult) -> float:
    """Relative RMSE on the objects' pixels of the pipeline's own composite."""
    mask = shading.frames[index].mask
    shown = linear_values("srgb8").astype(np.float64)[result.color[mask]]
    return relative_rmse(shown, item.composite(index)[mask])
