"""Figure 7.11: one scene by GR12, GR14, GR15 and GR15FAST, beside the truth; with the thesis's short rays and ours."""

from __future__ import annotations

import msgspec
import numpy as np

from server.shading.composite import srgb_codes
from tests.bench.light.runs import at_preset
from tests.bench.rendering.composites import changed_pixels
from tests.bench.rendering.flip import flip_map
from tests.bench.report.finished import Part
from tests.bench.report.run import Run
from tests.bench.thesis.light import last_results
from tests.bench.thesis.numbers import FAMILIES, THESIS_NAME
from tests.bench.thesis.presets import close_up, has_flip
from tests.bench.thesis.runs import save_picture, scene, usual_wishes
from tests.bench.thesis.speed import REACH_M

SIZE, QUICK_SIZE = "640x480", "320x240"
SCENE = "synthetic:stage?texture=town&light=6"
GUESTS = "both"
SPREAD = 96
ROWS = {"rays through the room": None, f"rays of {REACH_M:g} m, as the thesis": REACH_M}
"""GR15 and GR15FAST trace none: theirs are in both."""


def families_part(run: Run, size: str | None = None, frames: int | None = None) -> Part:
    """Composites under the estimated light against the exact picture; `details` by row and preset."""
    size, frames = size or (QUICK_SIZE if run.quick else SIZE), frames or run.of(5, 24)
    part = Part(sizes={"frames of fig. 7.11": frames})
    spec = f"{SCENE}&size={size}&frames={SPREAD}"
    bare, full = scene(spec), scene(f"{spec}&with={GUESTS}")
    wishes = usual_wishes(bare)
    wanted, shown = srgb_codes(full.truth(0).radiance), srgb_codes(bare.truth(0).radiance)
    changed = changed_pixels(wanted, shown)
    window = close_up(changed)
    part.details["true"] = save_picture("7.11 true", wanted[window])
    for row, ray_length_m in ROWS.items():
        run.say(f"fig. 7.11: {row}")
        asked = msgspec.structs.replace(wishes, ray_length_m=ray_length_m)
        results = last_results(run, bare, {p: at_preset(asked, p) for p in FAMILIES}, frames, full)
        part.details[row] = {}
        for preset, result in results.items():
            name = THESIS_NAME[preset]
            cell = {"picture": save_picture(f"7.11 {row} {name}", result.color[window])}
            difference = float(np.abs(wanted[changed].astype(np.int16) - result.color[changed]).mean())
            part.add(f"fig. 7.11, {row}: {name}: difference from the true picture", difference, "codes")
            if has_flip():
                errors = flip_map(wanted, result.color)
                cell["flip"] = save_picture(f"7.11 {row} {name} flip", np.rint(255 * errors[window]).astype(np.uint8))
                part.add(f"fig. 7.11, {row}: {name}: FLIP of what the things change", float(errors[changed].mean()), "")
            part.details[row][preset] = cell
    if not has_flip():
        part.leave_out("fig. 7.11: FLIP", "flip_evaluator not installed")
    return part
