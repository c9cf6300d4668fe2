"""What each measure against bad samples buys (thesis 5.2 and 5.4): a table under lights from all around, one measure
left out at a time, and the weights by normals, which are off by default, put in."""

from __future__ import annotations

import msgspec
import numpy as np

from client.synthetic.source import open_synthetic
from protocol.messages import Wishes
from server.maths.light_direction import direction_error_deg
from tests.bench.light.runs import at_preset, light_in, results_of, wishes_for
from tests.bench.report.finished import Part
from tests.bench.report.run import Run

LIGHTS, QUICK_LIGHTS = (0, 2, 4, 6), (0, 4)
FRAMES = range(0, 240, 24)
USUAL = Wishes().robustness
WAYS = {
    "all three": USUAL,
    **{f"without {name}": tuple(n for n in USUAL if n != name) for name in USUAL},
    "and weights by normals, from the three effects": (*USUAL, "normals"),
    "and weights by normals, eq. 5.7 as printed": (*USUAL, "normals_printed"),
}


def robustness_part(run: Run) -> Part:
    """Direction errors and flicker, REG4, albedos estimated, no indirect light in the pictures."""
    lights = run.of(QUICK_LIGHTS, LIGHTS)
    part = Part(sizes={"frames of the table": len(FRAMES), "lights of the table": len(lights)})
    for words, measures in WAYS.items():
        errors, turns = [], []
        for number in lights:
            run.say(f"robustness, light {number}: {words}")
            source = open_synthetic(f"synthetic:table?size=320x240&frames={FRAMES.stop}&light={number}")
            wishes = at_preset(wishes_for(source, range(FRAMES.stop)), "reg4")
            asked = msgspec.structs.replace(wishes, albedo="estimated", indirect="none", robustness=measures)
            found = [light_in(r) for r in results_of(run.device, source, (source[i] for i in FRAMES), asked)]
            true = source.light(0).sh
            errors += [direction_error_deg(light, true) for light in found]
            turns += [direction_error_deg(a, b) for a, b in zip(found[1:], found[:-1], strict=True)]
        row = f"table, measures against bad samples: {words}: dominant direction"
        part.add(f"{row}, median over frames", float(np.median(errors)), "deg")
        part.add(f"{row}, from frame to frame, root mean square", float(np.sqrt(np.mean(np.square(turns)))), "deg")
    return part
