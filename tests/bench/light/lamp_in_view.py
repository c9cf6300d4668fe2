"""Bare bulbs, in view and not: the light that arrives at places near them, against the scene's own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from client.synthetic.source import SyntheticSource, open_synthetic
from tests.bench.light.closed_rooms import compare, room_wishes
from tests.bench.light.runs import results_of
from tests.bench.report.finished import Part
from tests.bench.report.run import Run
from tests.scenes.synthetic_light import light_at

DESK = ((-0.06, 0.84, -0.2), (0.3, 0.79, -0.05), (-0.4, 0.79, -0.2), (0.0, 1.3, 0.3), (0.0, 0.1, 0.6))
ROOM = ((0.2, 0.6, -0.6), (-0.6, 0.5, -0.2), (0.8, 0.1, 0.5), (-0.9, 0.1, 0.9), (0.0, 1.2, 0.4))
"""Metres, world; the first three are near the lamp and on what pictures show."""
NEAR = 3
IN_VIEW, OUT_OF_VIEW = (0, 1), (4, 6)
"""Places of the lamp of synthetic:lamp."""
FRAMES = 30


def lamps_in_view_part(run: Run) -> Part:
    """The desk, and a room with one lamp at several places."""
    part = Part()
    cases = [("the desk's lamp", open_synthetic(f"synthetic:desk?frames={run.of(8, FRAMES)}"), DESK)]
    for place in (*IN_VIEW, *OUT_OF_VIEW)[: run.of(1, 4)]:
        view = "in view" if place in IN_VIEW else "never in view"
        cases.append((f"a room's lamp at place {place}, {view}", lamp_room(place, run.of(8, FRAMES)), ROOM))
    for name, source, places in cases:
        run.say(name)
        truth = np.array([light_at(source, np.array(place)) for place in places])
        wishes = room_wishes(source, np.array(places))
        results = results_of(run.device, source, (source[i] for i in range(len(source))), wishes)
        last = compare([tuple(at for at in result.light.at if at.of == "place") for result in results], truth).last()
        goals = ("<= 10", "<= 15", "<= 0.2") if "never" not in name else ("", "", "")
        part.add(f"{name}: dominant direction nearby", float(np.median(last.angles_deg[:, :NEAR])), "deg", goals[0])
        part.add(f"{name}: irradiance nearby", float(100 * np.median(last.irradiance[:, :NEAR])), "%", goals[1])
        part.add(f"{name}: level, median off 1 by", float(abs(np.median(last.level) - 1)), "", goals[2])
        part.add(
            f"{name}: angles within the spread", float(100 * (last.angles_deg <= last.spreads_deg).mean()), "%", ""
        )
    return part


def lamp_room(place: int, frames: int) -> SyntheticSource:
    """synthetic:lamp with the light that surfaces send to each other."""
    source = open_synthetic(f"synthetic:lamp?frames={frames}&place={place}&texture=1")
    source.scene = replace(source.scene, name=f"lamp_bounced_{place}", lamps=source.lamps)
    return source
