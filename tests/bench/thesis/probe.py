"""Figure 6.11: GR12, GR15 and GR15FAST against a passive light probe, in six scenes under four lights.

The probe (LP) is a matte grey ball in the middle of the empty place, before the things are put there: the sky that the
things hide would be dark to it, because light comes straight in these scenes. Its picture is exact but for 8 bits.
Depth is without noise, as if averaged over the thousand frames of the thesis's sequences.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.synthetic.source import SyntheticSource
from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Wishes
from server.input.measure import linear_values
from server.maths.light_direction import direction_error_deg
from server.maths.sh import dominant_direction, lambert_transfer
from server.shading.composite import srgb_codes
from tests.bench.light.runs import at_preset, light_in
from tests.bench.report.finished import Part
from tests.bench.report.run import Run
from tests.bench.thesis.numbers import THESIS_NAME
from tests.bench.thesis.runs import scene, turn_by_turn, usual_wishes
from tests.bench.truth.probe import Sphere, passive_probe, sphere_pixels

Floats = NDArray[np.float64]

SIZE, QUICK_SIZE = "320x240", "192x144"
PRESETS = ("rm", "gr15", "gr15fast")
LIGHTS = (6, 7, 1, 2)
"""On the ring: a half circle behind the camera and to its sides, as the thesis's four area lights."""
LP = "lp"
BANDS = 4
ALBEDO = 0.5
PROBE_CAMERA = CameraModel(width=40, height=40, fx=150.0, fy=150.0, cx=19.5, cy=19.5)
"""That looks at the probe from where the scene's camera stands."""
PROBE_SHARE = 0.9
"""Of that picture's half width that the probe covers."""


@dataclass(frozen=True)
class Place:
    """A scene that the light comes to from all sides."""

    words: str
    spec: str
    albedo: str


PLACES = (
    Place("1 stage, paper", "stage?texture=paper", "constant"),
    Place("2 stage, brick", "stage?texture=brick", "estimated"),
    Place("3 stage, colours", "stage?texture=market", "estimated"),
    Place("4 stage, town", "stage?texture=town", "estimated"),
    Place("5 table, grey", "table?texture=0", "constant"),
    Place("6 table, textured", "table?texture=1", "estimated"),
)
QUICK_PLACES = tuple(PLACES[number] for number in (0, 4, 5))
SPREAD = 96
"""Frames of the walk that a sequence's are taken from."""
SETTLED = 2
"""Frames after which the scene has been seen from some sides: those before do not count."""


def probe_part(
    run: Run, size: str | None = None, frames: int | None = None, places: tuple[Place, ...] | None = None
) -> Part:
    """Angles of each preset to LP, and of all to the true light; `details` by place and light."""
    size, frames = size or (QUICK_SIZE if run.quick else SIZE), frames or run.of(5, 16)
    places = places or (QUICK_PLACES if run.quick else PLACES)
    part = Part(sizes={"frames of each of fig. 6.11's sequences": frames})
    for place in PLACES:
        if place not in places:
            part.leave_out(f"fig. 6.11, {place.words}", "in the full run alone: coloured sets are hard, see there")
    cells = []
    for place in places:
        wishes = usual_wishes(scene(f"synthetic:{place.spec}&size=80x60&frames={SPREAD}"), albedo=place.albedo)
        for light in LIGHTS:
            run.say(f"fig. 6.11, {place.words}: light {light}")
            source = scene(f"synthetic:{place.spec}&size={size}&frames={SPREAD}&light={light}")
            pictures = (source[round(i)] for i in np.linspace(0, SPREAD - 1, frames))
            found = _lights(run, source.camera, pictures, wishes)
            cells.append(_cell(place, light, found, probed(source), source.light(0).sh))
    part.details["cells"] = cells
    for preset in (*PRESETS, LP):
        name = "LP" if preset == LP else THESIS_NAME[preset]
        to_true = [angle for cell in cells for angle in cell["to_true"][preset]]
        part.add(f"fig. 6.11, {name}: angle to the true light, median of all scenes", median(to_true), "deg")
        if preset != LP:
            to_lp = [angle for cell in cells for angle in cell["to_lp"][preset]]
            part.add(f"fig. 6.11, {name}: angle to LP, median of all scenes", median(to_lp), "deg")
    return part


def _lights(run: Run, camera: CameraModel, pictures: Iterable[RgbdFrame], wishes: Wishes) -> dict[str, list[Floats]]:
    found: dict[str, list[Floats]] = {preset: [] for preset in PRESETS}
    lanes = {preset: at_preset(wishes, preset) for preset in PRESETS}
    for _frame, answers in turn_by_turn(run.device, camera, pictures, lanes):
        for preset, answer in answers.items():
            found[preset].append(light_in(answer.result))
    return {preset: lights[SETTLED:] or lights for preset, lights in found.items()}


def _cell(place: Place, light: int, found: dict[str, list[Floats]], lp: Floats, true: Floats) -> dict[str, Any]:
    everyone = {**found, LP: [lp]}
    return {
        "place": place.words,
        "light": light,
        "true": true.tolist(),
        "directions": {k: [dominant_direction(x).tolist() for x in v] for k, v in everyone.items()},
        "to_lp": {preset: [direction_error_deg(x, lp) for x in lights] for preset, lights in found.items()},
        "to_true": {name: [direction_error_deg(x, true) for x in lights] for name, lights in everyone.items()},
    }


def probed(source: SyntheticSource) -> Floats:
    """[16, 3] the light that LP finds: a ball at the world's origin, seen from the first frame's camera."""
    camera, true = PROBE_CAMERA, source.light(0).sh
    turn = _looking(-source.pose(0)[:3, 3])
    distance_m = camera.fx / (PROBE_SHARE * camera.width / 2)
    pixels = sphere_pixels(camera, Sphere(np.array([0.0, 0.0, distance_m]), 1.0))
    picture = np.zeros((camera.height, camera.width, 3))
    shading = np.maximum(lambert_transfer(pixels.normals @ turn.T, BANDS) @ true, 0)
    picture[pixels.rows, pixels.columns] = ALBEDO * shading
    seen = linear_values("srgb8").astype(np.float64)[srgb_codes(picture)]
    return passive_probe(seen, pixels, BANDS, turn, ALBEDO).mean


def _looking(view: Floats) -> Floats:
    """[3, 3] world from camera: z along `view`, x level."""
    forward = view / np.linalg.norm(view)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=1)
