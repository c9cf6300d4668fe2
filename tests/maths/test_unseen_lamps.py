"""Lamps in air that no picture has looked through, in a room in closed form (tests/scenes/shell_room.py)."""

from __future__ import annotations

from dataclasses import replace
from math import tan

import numpy as np
import pytest

from protocol.frames import CameraModel
from server.light.shell.elimination import Regions
from server.light.shell.objective import step
from server.light.shell.patches import RAYS, ray_directions
from server.light.shell.solver import Solver
from server.light.shell.switches import Switches
from server.light.shell.transport import columns_of, emitter_keys
from server.light.shell.unknowns import Unknowns
from server.light.shell.unseen_lamps import AGAIN, BULB_M, YOUNG, Room, lamp_shares
from server.light.shell.view import View
from server.maths.sh import spherical_fibonacci
from tests.scenes.analytic import Floats
from tests.scenes.lamp_in_air import AMBIENT, RADIANCE, lamps_of, lit_room, solved
from tests.scenes.shell_room import CAMERA, UP, Lamp, make_room

PLACES = [(1.35, 1.05, 1.35), (2.6, 0.9, 1.0), (0.9, 2.3, 1.7)]


def looking_at(place: tuple[float, float, float], half_deg: float = 15.0) -> View:
    """From the camera."""
    ahead = np.array(place) - CAMERA
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, UP)
    right /= np.linalg.norm(right)
    half = tan(np.radians(half_deg))
    return View(CAMERA, np.stack([right, np.cross(ahead, right), ahead], axis=1), (-half, half), (-half, half))


@pytest.mark.parametrize("place", PLACES)
def test_a_lamp_is_found_at_its_place(place: tuple[float, float, float]) -> None:
    solution = solved(Solver(Switches()), lit_room(place))
    lamps = lamps_of(solution)
    assert lamps.count == 1
    assert np.linalg.norm(lamps.centers[0] - place) < 0.1  # seen: .02, .02, .06
    sent = solution.near.radiance[columns_of(solution.hidden, emitter_keys(lamps))[0]]
    assert sent.mean() == pytest.approx(RADIANCE, rel=0.2)  # seen: 54, 56, 61


def test_light_from_the_shell_is_no_lamp_in_the_air() -> None:
    on_ceiling = make_room(Lamp((1.9, 1.6), 0.8, (9.0, 9.0, 9.0)), AMBIENT)
    for room in (on_ceiling, make_room(None, AMBIENT)):
        assert lamps_of(solved(Solver(Switches()), room)).count == 0


def test_none_is_found_before_it_has_been_found_often() -> None:
    solver, room = Solver(Switches()), lit_room(PLACES[0])
    assert lamps_of(solved(solver, room, times=YOUNG + AGAIN)).count == 0
    assert lamps_of(solved(solver, room, times=1)).count == 1


def test_none_is_where_pictures_look() -> None:
    room, place = lit_room(PLACES[0]), PLACES[0]
    lamps = lamps_of(solved(Solver(Switches()), room, looking_at(place)))
    assert all(np.linalg.norm(lamps.centers - place, axis=1) > 0.2)
    solver = Solver(Switches())
    assert lamps_of(solved(solver, room)).count == 1
    assert lamps_of(solved(solver, room, looking_at(place), times=1)).count == 0  # nothing shines there


def test_a_lamp_that_goes_out_goes() -> None:
    solver = Solver(Switches())
    assert lamps_of(solved(solver, lit_room(PLACES[0]))).count == 1
    assert lamps_of(solved(solver, make_room(None, AMBIENT))).count == 0


def test_another_light_has_other_lamps() -> None:
    solver, room = Solver(Switches()), lit_room(PLACES[1])
    assert lamps_of(solved(solver, lit_room(PLACES[0]))).count == 1
    room.patches.outdated = 1.0
    assert lamps_of(solved(solver, room, times=1)).count == 0
    room.patches.outdated = 0.0
    lamps = lamps_of(solved(solver, room))
    assert lamps.count == 1
    assert np.linalg.norm(lamps.centers[0] - PLACES[1]) < 0.2


def test_what_a_place_gains_is_by_how_much_the_quadratic_objective_falls_further() -> None:
    """The one about a first step, far from its minimum: with a column more, and all others going along."""
    room, unknowns = lit_room(PLACES[0]), Unknowns()
    evidence = room.evidence
    here = step(unknowns, evidence, room.near)
    solution = Room(unknowns, here, room.patches, evidence.rows, room.shell)
    place = np.array(PLACES[:1])
    column = solution.columns(place)
    column /= np.linalg.norm(column)
    paint, known = here.paint, len(here.slope)
    design = np.concatenate([paint.design, column], axis=1)
    regions = Regions.of(design, paint.surfaces.regions.counts, evidence)
    matrix, vector = replace(paint.surfaces, regions=regions).normal_equations(design, paint.residual[:, None])
    matrix[:known, :known] = here.curvature
    slope = np.append(here.slope, vector[-1, 0])
    falls = [
        (slope[:n] @ np.linalg.solve(matrix[:n, :n].astype(np.float64), slope[:n])) / 2 for n in (known, known + 1)
    ]
    assert solution.gains(place)[0] == pytest.approx(falls[1] - falls[0], rel=0.02)
    assert falls[1] - falls[0] > 10


def test_patches_see_a_lamp_as_far_as_their_rays_go() -> None:
    room = make_room(None, AMBIENT)
    patches, rows = room.patches, room.patches.used
    place = np.array([PLACES[0]])
    patches.arrivals[rows] = 0.0
    shares, visible = lamp_shares(patches, rows, place)
    away = place - patches.positions[rows]
    far = np.linalg.norm(away, axis=1)
    cosine = np.maximum((away * patches.normals[rows]).sum(axis=1), 0.0) / far
    np.testing.assert_allclose(shares[:, 0], cosine * (BULB_M / far) ** 2, rtol=0.02)  # 1 / (1 + (BULB_M / far)^2)
    np.testing.assert_array_equal(visible, shares > 0)
    patches.arrivals[rows, :, 3] = 1.0  # surface a metre away all around
    np.testing.assert_array_equal(lamp_shares(patches, rows, place)[1][:, 0], (far <= 1.0) & (cosine > 0))
    above = ray_directions() @ away[0] > far[0] * np.cos(np.radians(30))
    patches.arrivals[rows[0], :, 3] = np.where(above, 0.0, 0.1)
    assert above.sum() < RAYS / 10
    assert lamp_shares(patches, rows[:1], place)[1] == 1


def test_rays_that_meet_a_lamp() -> None:
    """As many as its solid angle tells, where nothing is before it."""
    lamps = lamps_of(solved(Solver(Switches()), lit_room(PLACES[0])))
    eye, directions = lamps.centers[0] + np.array([0.6, 0.3, -0.4]), spherical_fibonacci(20000)
    far = np.linalg.norm(lamps.centers[0] - eye)
    share = (1 - np.sqrt(1 - (BULB_M / far) ** 2)) / 2
    met = lamps.lamp_met(eye, directions, np.zeros(len(directions)))
    assert set(met) == {-1, 0}
    assert (met == 0).mean() == pytest.approx(share, rel=0.05)
    assert directions[met == 0] @ (lamps.centers[0] - eye) == pytest.approx(far, rel=0.02)
    behind, before = (np.full(len(directions), far + side) for side in (0.1, -0.1))
    np.testing.assert_array_equal(lamps.lamp_met(eye, directions, behind), met)
    assert (lamps.lamp_met(eye, directions, before) == -1).all()


def test_a_view_frames_what_its_camera_shows() -> None:
    camera = CameraModel(width=64, height=48, fx=50.0, fy=55.0, cx=30.0, cy=25.0)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0.5, 0.2, 1.0]
    pixels = np.array([(0.1, 0.1), (62.9, 46.9), (-0.1, 20), (63.1, 20), (20, -0.1), (20, 47.1)])
    rays = np.stack([(pixels[:, 0] - 30) / 50, (pixels[:, 1] - 25) / 55, np.ones(6)], axis=1)
    points: Floats = pose[:3, 3] + 2.0 * rays @ pose[:3, :3].T
    view = View.of(camera, pose)
    np.testing.assert_array_equal(view.frames(points), [True, True, False, False, False, False])
    assert not view.frames(2 * view.eye - points).any()  # behind it
