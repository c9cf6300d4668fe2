"""The light of a room in closed form (tests/scenes/shell_room.py): what spoils its pictures, what they cannot tell.

The cases hold on the host alone: kernels give patches and arrivals, whose twins are elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from server.light.shell.distant import distant_light
from server.light.shell.objective import step
from server.light.shell.shell import SIDES
from server.light.shell.solver import Solver
from server.light.shell.sources import distant_sources
from server.light.shell.switches import Switches
from server.light.shell.transport import Transport
from server.light.shell.unknowns import Unknowns
from server.maths.lobes import LOBES
from server.maths.sh import LUMINANCE
from tests.hard_cases.catalogue import Family, Found, Trial
from tests.scenes.lamp_in_air import lamps_of, lit_room
from tests.scenes.lamp_in_air import solved as solved_often
from tests.scenes.lights import unit
from tests.scenes.shell_room import NO_EMITTERS, Lamp, ShellRoom, make_room

Floats = NDArray[np.float64]

ROOM_LIGHT = Family("light of a room", checkable=False)
STEPS = 25
LAMP = Lamp((3.0, 0.9), 0.7, (16.0, 15.0, 14.0))
AMBIENT = (0.3, 0.3, 0.3)
IN_AIR = (1.35, 1.05, 1.35)
TOWARDS = unit([0.6, 0.5, 0.6])
_LINEAR = [3, 1, 2]
_MODEL = (
    "the lobes' 35 degrees, 512 rays a patch and the priors of what three walls do not tell leave up to 14 degrees in "
    "closed form (tests/maths/test_shell.py)"
)


def sky(directions: Floats) -> Floats:
    """[..., 3] a soft sun before an even sky."""
    apart = np.arccos(np.clip(directions @ TOWARDS, -1, 1))
    level = 0.3 + 3 * np.exp(-0.5 * (apart / np.radians(25)) ** 2)
    return np.asarray(level[..., None] * np.ones(3))


def corner(change: Callable[[ShellRoom], None] | None = None) -> ShellRoom:
    """A floor and two walls under the sky, `change`d before their transport is known."""
    room = make_room(None, sky)
    if change is not None:
        change(room)
        room.transport = Transport()
        room.transport.update(room.patches, NO_EMITTERS, room.patches.used, room.shell)
    return room


def solved(room: ShellRoom, closed: Floats | None = None) -> Unknowns:
    """The light from beyond the scan; closed: of its sides, where it is not as was scanned."""
    unknowns, evidence = Unknowns(), room.evidence
    rows = evidence.rows
    sources = room.distant()
    if closed is not None:
        sources = distant_sources(room.transport, closed, room.shell.axes[2], rows, with_indirect=True)
    for _ in range(STEPS):
        step(unknowns, evidence, sources)
    return unknowns


def direction_of(unknowns: Unknowns) -> Found:
    light = distant_light(unknowns.solved(LOBES), 4)
    return Found(unit((light.sh @ LUMINANCE)[_LINEAR]), TOWARDS, known=light.valid)


@ROOM_LIGHT.case("three walls", np.deg2rad(15), "rad", f"{_MODEL}.")
def three_walls(_trial: Trial) -> Found:
    return direction_of(solved(corner()))


def _half_black(room: ShellRoom) -> None:
    used = room.patches.used
    black = room.patches.positions[used][:, 1] > 1.8
    room.patches.logarithms[used[black]] += np.log(0.1)


@ROOM_LIGHT.case(
    "half of it black",
    np.deg2rad(20),
    "rad",
    f"{_MODEL}, and black paint, told apart by its edge, leaves each of its parts a level of its own.",
)
def half_black(_trial: Trial) -> Found:
    return direction_of(solved(corner(_half_black)))


def _outliers(room: ShellRoom) -> None:
    used, random = room.patches.used, np.random.default_rng(1)
    chosen = used[random.random(len(used)) < 0.1]
    room.patches.logarithms[chosen] += random.uniform(-2, 2, (len(chosen), 1))


@ROOM_LIGHT.case(
    "a tenth of the patches wrong by up to e^2",
    np.deg2rad(20),
    "rad",
    f"{_MODEL}; an outlier, which is a surface by itself, pulls by no more than its prior allows.",
)
def outliers(_trial: Trial) -> Found:
    return direction_of(solved(corner(_outliers)))


def _clipped(room: ShellRoom) -> None:
    patches, used = room.patches, room.patches.used
    limit = np.median(patches.logarithms[used].mean(axis=1))
    bright = used[patches.logarithms[used].mean(axis=1) > limit]
    patches.logarithms[bright], patches.clipped[bright] = limit, 1.0


@ROOM_LIGHT.case(
    "the brighter half clipped",
    np.deg2rad(30),
    "rad",
    f"{_MODEL}; the darker half of the patches sees half of the light's gradients, so twice that.",
)
def clipped(_trial: Trial) -> Found:
    return direction_of(solved(corner(_clipped)))


@ROOM_LIGHT.case(
    "last bits of the pictures",
    1e-3,
    "rad",
    "a relative change of 1e-6 of every patch may turn the light by the condition of the solve, below 1e6 for what is "
    "told, times 1e-6 over the root of 1000 patches, and the matrix is of float32.",
)
def last_bits(_trial: Trial) -> Found:
    def shaken(room: ShellRoom) -> None:
        used = room.patches.used
        room.patches.logarithms[used] += 1e-6 * np.random.default_rng(6).normal(size=(len(used), 3))

    one, other = (direction_of(solved(corner(change))).values for change in (None, shaken))
    return Found(other, one)


@ROOM_LIGHT.case(
    "a light twice as bright",
    0.01,
    "of the light",
    "logarithms move by one constant, which the mean takes up; what is left is of float32 and of steps not taken.",
)
def twice(_trial: Trial) -> Found:
    def brighter(room: ShellRoom) -> None:
        used = room.patches.used
        room.patches.logarithms[used] += np.log(2.0)
        room.patches.arrivals[used, :, :3] *= 2.0

    one, other = (distant_light(solved(corner(change)).solved(LOBES), 4).sh for change in (None, brighter))
    return Found(other / one[0].mean(), 2 * one / one[0].mean())


def _black(room: ShellRoom) -> None:
    used = room.patches.used
    room.patches.logarithms[used], room.patches.arrivals[used, :, :3] = np.log(0.002), 0.0


@ROOM_LIGHT.case(
    "black pictures",
    0.02,
    "radiance",
    "all that is shown is a code of 255 or less, so the light is that over the albedo, and a few times it where lobes "
    "that nothing sees lie at their prior.",
)
def black(_trial: Trial) -> Found:
    return Found(distant_light(solved(corner(_black)).solved(LOBES), 4).sh, 0)


def _from_behind(room: ShellRoom) -> None:
    room.patches.arrivals[room.patches.used, :, 3] *= -1


@ROOM_LIGHT.case(
    "every surface seen from behind",
    np.deg2rad(20),
    "rad",
    f"{_MODEL}; what would be known of the walls' light is unknown too.",
)
def from_behind(_trial: Trial) -> Found:
    return direction_of(solved(corner(_from_behind)))


@ROOM_LIGHT.case(
    "closed on all sides",
    0,
    "valid",
    "no ray leaves the room, so nothing is known of what is beyond, and it must say so.",
    known=False,
)
def closed_room(_trial: Trial) -> Found:
    light = distant_light(solved(make_room(LAMP, AMBIENT), np.ones(SIDES)).solved(LOBES), 4)
    return Found(float(light.valid), 0, known=light.valid)


@ROOM_LIGHT.case("nothing seen", 0, "radiance", "no estimate is made of nothing: exactly zero.", known=False)
def nothing(_trial: Trial) -> Found:
    estimate = distant_light(Unknowns().solved(), 4)
    return Found(estimate.sh, 0, known=estimate.valid or estimate.std is not None)


def _lamp_in_air(noise: float) -> Floats:
    """[3] where a lamp is found, with this deviation of the logarithms that patches show; far off where none is."""
    room = lit_room(IN_AIR)
    used = room.patches.used
    room.patches.logarithms[used] += noise * np.random.default_rng(7).normal(size=(len(used), 1))
    lamps = lamps_of(solved_often(Solver(Switches()), room))
    return lamps.centers[0] if lamps.count == 1 else np.full(3, np.inf)


@ROOM_LIGHT.case(
    "a lamp in the air, and noise",
    0.15,
    "m",
    "a place is looked at in steps of 6 cm, and 5 % of noise moves the best one by two of them at most.",
)
def lamp_in_air(_trial: Trial) -> Found:
    return Found(_lamp_in_air(0.05), np.array(IN_AIR))


@ROOM_LIGHT.case(
    "a lamp in the air, last bits of the pictures",
    0.01,
    "m",
    "a relative change of 1e-6 may choose another of places that are as good, which steps then leave for the same one.",
)
def lamp_in_air_last_bits(_trial: Trial) -> Found:
    return Found(_lamp_in_air(1e-6), _lamp_in_air(0.0))
