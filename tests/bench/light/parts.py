"""The parts of `probeless bench light`: each measures one row of what light estimation is held to."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from tests.bench.light.changes import changes_part
from tests.bench.light.closed_rooms import closed_rooms_part
from tests.bench.light.e1 import SEQUENCES, sequence_part
from tests.bench.light.honesty import honesty_part
from tests.bench.light.lamp_in_view import lamps_in_view_part
from tests.bench.light.places import halves_part, kitchen_part
from tests.bench.light.robustness import robustness_part
from tests.bench.light.room import room_part
from tests.bench.light.room_cost import room_cost_part
from tests.bench.light.same_frames import same_frames_part
from tests.bench.light.speed import speed_part
from tests.bench.report.finished import Part
from tests.bench.report.run import Run

OUT = Path("out/bench/light")
ROOM, KITCHEN = "mitsuba_room", "kitchen"

ELSEWHERE = {
    "lamp": ("tests.bench.light.lamp", "lamp_part"),
    "photographs": ("tests.bench.light.photographs", "photographs_part"),
    "bust": ("tests.bench.light.photographs", "socrates_part"),
    "visibility": ("tests.bench.light.visibility", "visibility_part"),
}
"""Parts that are a module of their own: its name, and its function's."""


def elsewhere(part: str, run: Run) -> Part:
    """What the part's own module measures; without one, a note that there is none."""
    module, name = ELSEWHERE[part]
    if find_spec(module) is None:
        missing = Part()
        missing.leave_out(part, f"there is no {module} yet")
        return missing
    measured: Part = getattr(import_module(module), name)(run)
    return measured


PARTS: dict[str, Callable[[Run], Part]] = {
    ROOM: room_part,
    **{sequence.name: partial(sequence_part, sequence=sequence) for sequence in SEQUENCES},
    "closed rooms": closed_rooms_part,
    "lamps in view": lamps_in_view_part,
    "light that changes": changes_part,
    "half black room": halves_part,
    "robustness": robustness_part,
    "honesty": honesty_part,
    KITCHEN: kitchen_part,
    "kitchen, the same frames": same_frames_part,
    "speed": speed_part,
    "what a room's light costs": room_cost_part,
    **{name: partial(elsewhere, name) for name in ELSEWHERE},
}
