"""Clipped surface as emitters: sizes and shares against closed forms, when they count, and a bulb that is solved."""

from __future__ import annotations

import numpy as np
import pytest

from server.light.shell.bright_surface import MOST_EMITTERS, BrightSurface
from server.light.shell.emitters import CELL_M, Emitters, EmittersSeen
from server.light.shell.objective import step
from server.light.shell.patches import MOST_PATCHES, PATCH_M, Patches
from server.light.shell.picture import Seen, SeenBright
from server.light.shell.sources import near_sources
from server.light.shell.transport import bright_keys, columns_of
from server.light.shell.unknowns import Unknowns
from server.maths.sh import spherical_fibonacci
from tests.scenes.analytic import Floats
from tests.scenes.shell_room import UP, make_room

EYE = np.array([0.15, 0.15, -2.0])
MIDDLE = np.array([0.15, 0.15, 0.15])
BULB_M = 0.04


def bulb(eye: Floats = EYE, blocks: int = 4000) -> SeenBright:
    """The half of a bulb at MIDDLE that a far eye sees, in blocks of equal area across the line of sight."""
    line = (MIDDLE - eye) / np.linalg.norm(MIDDLE - eye)
    side = np.eye(3)[np.abs(line).argmin()]
    first = np.cross(line, side) / np.linalg.norm(np.cross(line, side))
    turns, radii = 2.399963 * np.arange(blocks), np.sqrt((np.arange(blocks) + 0.5) / blocks)
    across = radii[:, None] * (np.cos(turns)[:, None] * first + np.sin(turns)[:, None] * np.cross(line, first))
    normals = across - np.sqrt(1 - radii**2)[:, None] * line
    areas = np.full(blocks, np.pi * BULB_M**2 / blocks)
    return SeenBright(MIDDLE + BULB_M * normals, normals, np.ones((blocks, 3)), areas, eye)


def pane(tilt_deg: float, area_m2: float = 0.02) -> SeenBright:
    """A pane at MIDDLE whose normal is turned from the line of sight."""
    normal = np.array([np.sin(np.radians(tilt_deg)), 0.0, -np.cos(np.radians(tilt_deg))])
    across = np.array([area_m2 * np.cos(np.radians(tilt_deg))])
    return SeenBright(MIDDLE[None], normal[None], np.ones((1, 3)), across, EYE)


def found(*pictures: SeenBright, positions: Floats | None = None) -> Emitters:
    surface = BrightSurface()
    for picture in pictures:
        surface.add(picture, np.zeros((0, 3)) if positions is None else positions)
    return surface.emitters()[0]


def test_a_bulb_is_as_large_as_its_disc_from_everywhere() -> None:
    emitters = found(bulb())
    assert emitters.count == 1
    np.testing.assert_allclose(emitters.areas_m2, np.pi * BULB_M**2, rtol=1e-6)
    assert emitters.flatness[0] < 0.01
    for direction in spherical_fibonacci(20):
        _, across = emitters.seen_from(MIDDLE + 2 * direction[None])
        np.testing.assert_allclose(across, np.pi * BULB_M**2, rtol=0.01)


@pytest.mark.parametrize("tilt_deg", [0.0, 30.0, 60.0])
def test_a_pane_keeps_its_size_when_it_is_seen_askew(tilt_deg: float) -> None:
    emitters = found(pane(tilt_deg))
    np.testing.assert_allclose(emitters.areas_m2, 0.02, rtol=1e-6)
    _, behind = emitters.seen_from(MIDDLE - emitters.facing)
    assert behind == 0.0


def test_shares_are_those_of_a_disc() -> None:
    """A disc of radius r that faces a point at distance d on its axis fills r^2 / (d^2 + r^2) of its hemisphere."""
    emitters = found(pane(0.0))
    for distance in (0.05, 0.2, 1.0, 3.0):
        point = MIDDLE + distance * emitters.facing
        share = emitters.shares(point, -emitters.facing)
        squared = 0.02 / np.pi
        np.testing.assert_allclose(share, squared / (distance**2 + squared), rtol=1e-9)
    far = MIDDLE + 3.0 * emitters.facing
    np.testing.assert_allclose(emitters.solid_angles(far), 0.02 / 9, rtol=1e-3)


def test_what_frames_show_in_part_hardly_makes_it_smaller() -> None:
    whole, part = pane(0.0, 0.04), pane(0.0, 0.01)
    emitters = found(*[whole] * 10, *[part] * 5)
    assert 0.035 < emitters.areas_m2[0] < 0.04  # the plain mean is .03


def test_a_lamp_that_is_off_is_soon_none_and_one_out_of_view_stays() -> None:
    nothing, elsewhere = SeenBright(), MIDDLE + np.array([0.0, 1.0, 0.0])
    surface = BrightSurface()
    for _ in range(10):
        surface.add(bulb(), MIDDLE[None])
    for _ in range(100):
        surface.add(nothing, elsewhere[None])
    assert surface.emitters()[0].presence[0] == 1.0
    for _ in range(20):
        surface.add(nothing, MIDDLE[None])
    assert surface.emitters()[0].count == 0


def test_another_light_forgets_it() -> None:
    surface = BrightSurface()
    surface.add(bulb(), MIDDLE[None])
    surface.forget(1.0)
    assert surface.emitters()[0].count == 0
    surface.add(bulb(), MIDDLE[None])
    np.testing.assert_allclose(surface.emitters()[0].areas_m2, np.pi * BULB_M**2, rtol=1e-6)


def test_the_largest_are_kept() -> None:
    surface, random = BrightSurface(), np.random.default_rng(2)
    areas = random.uniform(0.001, 0.02, 3 * MOST_EMITTERS)
    for number, area in enumerate(areas):
        at = MIDDLE + np.array([CELL_M * number, 0.0, 0.0])
        surface.add(SeenBright(at[None], np.array([[0.0, 0.0, -1.0]]), np.ones((1, 3)), area[None], at + EYE), at[None])
    kept = np.sort(surface.emitters()[0].areas_m2)
    np.testing.assert_allclose(kept, np.sort(areas)[-MOST_EMITTERS:], rtol=0.02)


def test_near_ones_are_left_to_evenly_spread_rays() -> None:
    emitters = found(pane(0.0))
    near, far = MIDDLE + 0.05 * emitters.facing, MIDDLE + 2.0 * emitters.facing
    points, normals = np.concatenate([near, far]), np.tile(-emitters.facing, (2, 1))
    weights = emitters.weights(emitters.shares(points, normals), 128)
    assert weights[0] < 0.1
    assert weights[1] > 0.9
    ends = np.stack([MIDDLE, MIDDLE, MIDDLE + np.array([0.0, CELL_M, 0.0])])
    left = emitters.left_to_others(weights, np.array([0, 1, 1]), ends)
    np.testing.assert_allclose(left, [1 - weights[0, 0], 1 - weights[1, 0], 1.0])


@pytest.mark.parametrize(("shown", "lit"), [(0.05, 0.0), (0.6, 1.0)])
def test_bright_surface_nearby_explains_a_clipped_pane(shown: float, lit: float) -> None:
    """A window in a dark wall is a lamp; white paint on a bright wall may be lit."""
    patches, steps = Patches(), np.arange(-2, 3) * PATCH_M
    x, y = np.meshgrid(steps, steps)
    at = MIDDLE + np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.01)], axis=1)
    facing = np.tile([0.0, 0.0, -1.0], (x.size, 1))
    patches.add(Seen(at, facing, np.full((x.size, 3), np.log(shown)), np.zeros(x.size), np.zeros(x.size)))
    patches.traced_in[:] = 1
    assert found(pane(0.0)).lit_by(patches, UP)[0] == lit
    assert found(bulb()).lit_by(patches, UP)[0] < 0.02


@pytest.mark.parametrize(("tilt_deg", "lit"), [(0, 1.0), (45, np.sqrt(2) - 1), (90, 0.0), (180, 0.0)])
def test_flat_surface_that_faces_up_is_lit(tilt_deg: float, lit: float) -> None:
    """A table, though nothing around it is known to be bright; not a window, a panel on the ceiling, or a bulb."""
    up = np.array([np.sin(np.radians(tilt_deg)), 0.0, -np.cos(np.radians(tilt_deg))])
    assert found(pane(0.0)).lit_by(Patches(), up)[0] == pytest.approx(lit, abs=1e-9)
    assert found(bulb()).lit_by(Patches(), up)[0] < 0.02


@pytest.mark.parametrize("excess", [100.0, 400.0])
def test_a_bulb_in_view_is_solved(excess: float) -> None:
    """Its radiance beyond what the picture shows, in a room in closed form (tests/scenes/shell_room.py)."""
    center, radius_m = np.array([1.35, 1.05, 1.35]), 0.05
    room = make_room(None, (0.3, 0.3, 0.3))
    rows = room.patches.used
    away = center - room.patches.positions[rows]
    squared = (away**2).sum(axis=1)
    cosine = np.maximum((away * room.patches.normals[rows]).sum(axis=1), 0.0) / np.sqrt(squared)
    without = 0.3 * room.transport.shares[rows].sum(axis=1) + room.transport.known[rows].mean(axis=1)
    brought = (excess * radius_m**2 * cosine / squared) / without
    room.patches.logarithms[rows] += np.log1p(brought)[:, None]
    emitters = Emitters(
        np.floor(center[None] / CELL_M).astype(np.int64),
        center[None],
        np.array([[0.0, 0.0, -1.0]]),
        np.zeros(1),
        np.array([np.pi * radius_m**2]),
        np.ones((1, 3)),
        np.ones(1),
        np.zeros(1, bool),
    )
    bright = EmittersSeen(emitters, np.ones((MOST_PATCHES, 1)))
    room.transport.update(room.patches, bright, rows, room.shell)
    unknowns, evidence = Unknowns(), room.evidence
    for _ in range(30):
        step(unknowns, evidence, near_sources(room.transport, room.shell, room.patches, evidence.rows))
    column = columns_of(room.transport.hidden, bright_keys(emitters.centers))[0]
    assert np.exp(unknowns.z[column]) == pytest.approx(excess, rel=0.25)
