"""The stage set (`synthetic:stage`), exact: all that hides light is in view, so this is rendering and nothing else.

Its guests are real in the true picture and virtual in ours. Light is of exactly 16 coefficients and comes straight.
"""

from __future__ import annotations

import msgspec
import numpy as np

from client.synthetic.export import write_guests
from client.synthetic.source import SyntheticSource, open_synthetic
from server.shading.composite import srgb_codes
from tests.bench.light.runs import at_preset, refusal, results_of, wishes_for
from tests.bench.rendering.common import OUT, PRESETS, require
from tests.bench.rendering.flip import Codes
from tests.bench.rendering.pasting import pasted
from tests.bench.rendering.pictures import draw_set, preset_strip
from tests.bench.rendering.rows import ERROR_GOALS, SHADOW_GOALS, add_pasted, add_score
from tests.bench.report.finished import Part
from tests.bench.report.run import Run
from tests.bench.truth.composite_truth import CompositeTruth

SETS = {
    "stage market, light from the left": "texture=market&light=7",
    "stage checker, light from behind": "texture=checker&light=4",
}
SIZE, GUESTS = "320x240", "both"
FRAMES, QUICK_FRAMES = 12, 4


def stage_part(run: Run) -> Part:
    """Rows of every preset on each set. Raises UnmeasurableError."""
    require("flip_evaluator")
    count = run.of(QUICK_FRAMES, FRAMES)
    part = Part(sizes={"frames of the stage set": count})
    for words, query in SETS.items():
        spec = f"synthetic:stage?size={SIZE}&frames={count}&{query}"
        _add_set(part, run, words, open_synthetic(spec), open_synthetic(f"{spec}&with={GUESTS}"))
    return part


def _add_set(part: Part, run: Run, row: str, bare: SyntheticSource, with_guests: SyntheticSource) -> None:
    truth = stage_truth(bare, with_guests)
    of_pasted = add_pasted(part, row, truth)
    objects = write_guests(OUT / "stage", with_guests)
    light = tuple((float(r), float(g), float(b)) for r, g, b in bare.truth(0).sh)
    wishes = msgspec.structs.replace(wishes_for(bare, range(len(bare))), light=light, edges="hard")
    found: dict[str, list[Codes]] = {}
    for preset in PRESETS:
        run.say(f"{row}: {preset}")
        refused = refusal(at_preset(wishes, preset))
        if refused:
            part.leave_out(f"{row}: {preset.upper()}", refused)
            continue
        frames = (bare[i] for i in range(len(bare)))
        results = results_of(run.device, bare, frames, at_preset(wishes, preset), objects)
        found[preset] = [result.color for result in results]
        goals = ERROR_GOALS[preset], SHADOW_GOALS.get(preset)
        add_score(part, f"{row}: {preset.upper()}, true light", truth, found[preset], of_pasted, *goals)
    name, index = row.replace(",", ""), len(bare) // 2
    draw_set(OUT / f"{name.replace(' ', '_')}.jpg", truth, found, index)
    preset_strip(OUT, name, truth, found, index)


def stage_truth(bare: SyntheticSource, with_guests: SyntheticSource) -> CompositeTruth:
    """Exact pictures of every frame without and with the guests."""
    pictures = [bare.truth(i).radiance for i in range(len(bare))]
    exact = [with_guests.truth(i) for i in range(len(bare))]
    baseline = [
        pasted(srgb_codes(picture), truth.guest, truth.normals.astype(np.float64), truth.albedo, truth.sh)
        for picture, truth in zip(pictures, exact, strict=True)
    ]
    return CompositeTruth(pictures, [truth.radiance for truth in exact], [truth.guest for truth in exact], baseline)
