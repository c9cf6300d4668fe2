"""Solutions of the light from beyond the scan, one after the other: what they take from what, and from those before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from server.light.shell import weights
from server.light.shell.objective import received, step
from server.light.shell.patches import PATCH_M
from server.light.shell.solution import Solution
from server.light.shell.solver import Solver
from server.light.shell.sources import Sources
from server.light.shell.switches import Switches
from server.light.shell.transport import NEAR_SIDES, Transport
from server.light.shell.unknowns import Unknowns
from server.maths.light_direction import direction_error_deg
from tests.scenes.analytic import Floats
from tests.scenes.shell_room import AWAY, NO_EMITTERS, OPEN, SIZE_M, UP, ShellRoom, make_room, sky


def solved(solver: Solver, room: ShellRoom) -> Solution:
    solution = solver.solve(room.patches, NO_EMITTERS, room.patches.used, AWAY, UP)
    assert solution is not None
    return solution


def apart_deg(one: Solution, other: Solution) -> float:
    return direction_error_deg(one.estimate(4).sh, other.estimate(4).sh)


@pytest.fixture(scope="module")
def rooms() -> tuple[ShellRoom, ShellRoom]:
    """The same corner under two skies."""
    first, second = (make_room(None, sky(np.array(towards))) for towards in OPEN[:2])
    return first, second


def test_the_first_solutions_are_forgotten(rooms: tuple[ShellRoom, ShellRoom]) -> None:
    """A solver that was shown another sky before finds what one finds that was not, in a few solutions."""
    before, now = rooms
    went_on, anew = Solver(Switches()), Solver(Switches())
    solved(went_on, before)
    apart = [apart_deg(solved(went_on, now), solved(anew, now)) for _ in range(8)]
    assert apart[0] < 8  # seen: 3.7; in steps that lead to the minimum alone, 21
    assert apart[2] < 1  # seen: .4; 10
    assert apart[7] < 0.1


def test_a_new_solver_makes_up_for_what_it_missed(rooms: tuple[ShellRoom, ShellRoom]) -> None:
    """Of a room that has been seen for ten frames, not of one that was seen in one."""
    went_on = Solver(Switches())
    for _ in range(8):
        last = solved(went_on, rooms[0])
    seen_long = replace(rooms[0], patches=rooms[0].patches.copy())
    seen_long.patches.weights *= 10
    assert apart_deg(solved(Solver(Switches()), seen_long), last) < 0.5
    assert apart_deg(solved(Solver(Switches()), rooms[0]), last) > 1.5


def test_a_light_that_stays_comes_to_rest(rooms: tuple[ShellRoom, ShellRoom]) -> None:
    """Though each solution begins nearer to the prior: its step is the change from the last one."""
    solver = Solver(Switches())
    steps = [solved(solver, rooms[0]).distant.step for _ in range(12)]
    assert steps[0] > 0.05
    assert steps[-1] < 0.002


def sources_and_unknowns(room: ShellRoom) -> tuple[Sources, Unknowns]:
    sources, unknowns = room.distant(), Unknowns(most_relaxation=0.5)
    for _ in range(6):
        step(unknowns, room.evidence, sources)
    return sources, unknowns


def test_all_is_forgotten_at_the_prior(rooms: tuple[ShellRoom, ShellRoom]) -> None:
    sources, unknowns = sources_and_unknowns(rooms[0])
    z, materials = unknowns.z.copy(), unknowns.materials.copy()
    unknowns.forget(0.0, sources, Switches())
    np.testing.assert_array_equal(unknowns.z, z)
    np.testing.assert_array_equal(unknowns.materials, materials)
    unknowns.forget(1.0, sources, Switches())
    np.testing.assert_allclose(unknowns.z, unknowns.mean + sources.offset, atol=1e-12)
    given = weights.DISTANT_ALBEDO
    np.testing.assert_allclose(unknowns.materials, np.log(given / (1 - given)), atol=1e-12)
    assert unknowns.relaxation == 0.5


def test_what_patches_receive(rooms: tuple[ShellRoom, ShellRoom]) -> None:
    """The logarithm of (1), also before there is a light: of its prior."""
    sources, unknowns = sources_and_unknowns(rooms[0])
    level = np.exp(unknowns.z)
    known = np.exp(np.log(np.maximum(sources.known, 1e-9)).mean(axis=1))
    np.testing.assert_allclose(
        received(unknowns, sources), np.log(sources.shares @ level + known), rtol=1e-4, atol=1e-4
    )
    fresh = Unknowns(mean=-0.3)
    expected = np.log(sources.shares @ np.exp(sources.offset - 0.3) + known)
    np.testing.assert_allclose(received(fresh, sources), expected, rtol=1e-4, atol=1e-4)


def segment(least: Floats) -> Floats:
    """Share of a cosine-weighted hemisphere whose directions have a part of at least `least` along a horizontal axis.

    Seen from above it is an even disc (Malley), and they are a segment of it.
    """
    least = np.minimum(least, 1.0)
    return np.asarray((np.arccos(least) - least * np.sqrt(1 - least**2)) / np.pi)


def test_how_much_of_what_a_patch_sees_is_near(rooms: tuple[ShellRoom, ShellRoom]) -> None:
    """On the floor, beside one wall: rays that end on it within a radius, here of patches of .6 m."""
    patches, transport = rooms[0].patches.copy(), Transport()
    patches.side_m, rows = 4 * PATCH_M, patches.used
    transport.update(patches, NO_EMITTERS, rows, rooms[0].shell)
    positions, normals = patches.positions[rows], patches.normals[rows]
    radius_m = NEAR_SIDES * patches.side_m
    beside = (normals[:, 2] > 0.9) & (np.abs(positions[:, 1] - SIZE_M[1] / 2) < SIZE_M[1] / 2 - radius_m)
    near = transport.near[rows][beside]
    np.testing.assert_allclose(near, segment(positions[beside, 0] / radius_m), atol=0.02)
    assert near.max() > 0.1
    assert (near == 0).any()


def test_noise_is_added_as_variance(rooms: tuple[ShellRoom, ShellRoom]) -> None:
    evidence = rooms[0].evidence
    variance = np.linspace(0, 1, len(evidence.level))
    noisier = evidence.with_noise(variance)
    np.testing.assert_allclose(1 / noisier.precision, 1 / evidence.precision + variance, rtol=1e-12)
    np.testing.assert_array_equal(noisier.level, evidence.level)
