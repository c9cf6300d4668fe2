"""The model of a room's light in a box of known light: what is found, and that it is the objective's minimum."""

from __future__ import annotations

import numpy as np
import pytest

from server.light.shell import objective
from server.light.shell.shell import (
    BEHIND_M,
    CELLS,
    LEAST_HEIGHT_M,
    SIDE,
    Shell,
    neighbours,
    shell_around,
    upright,
    wall_axes,
)
from server.light.shell.transport import SATURATED, Transport
from server.maths.sh import LUMINANCE, sh_basis, spherical_fibonacci
from tests.reference.room_objective import level_objective
from tests.scenes.analytic import Floats
from tests.scenes.shell_room import CAMERA, KNOWN, SIZE_M, UP, Lamp, ShellRoom, make_room, sent

LAMP = Lamp((3.0, 0.9), 0.7, (16.0, 15.0, 14.0))
AMBIENT = (0.3, 0.3, 0.3)
DIRECTIONS = spherical_fibonacci(2048)
BASIS = 4 * np.pi / len(DIRECTIONS) * sh_basis(DIRECTIONS, 4).T


def light_at(room: ShellRoom, place: Floats) -> Floats:
    """[16] luminance of the light found at `place`, with the scanned surface's own."""
    directions = np.broadcast_to(DIRECTIONS, (1, *DIRECTIONS.shape))
    _, arrivals = sent(place[None], directions, None, np.zeros(3))
    met = room.transport.meet(room.shell, place[None], directions, arrivals)
    cells = objective.radiances(room.unknowns, room.transport, room.unknowns.known)
    radiance = np.where((met.columns >= 0)[..., None], cells[np.maximum(met.columns, 0)], met.known)[0]
    return np.asarray(BASIS @ radiance @ LUMINANCE)


def true_light(place: Floats, lamp: Lamp | None, ambient: tuple[float, float, float]) -> Floats:
    radiance, _ = sent(place[None], DIRECTIONS[None], lamp, np.array(ambient))
    return np.asarray(BASIS @ radiance[0] @ LUMINANCE)


def angle_deg(a: Floats, b: Floats) -> float:
    a, b = a[1:4], b[1:4]
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))))


@pytest.fixture(scope="module")
def lit() -> ShellRoom:
    room = make_room(LAMP, AMBIENT)
    room.solve(25)
    return room


@pytest.mark.parametrize("place", [(1.0, 1.0, 0.7), (3.0, 2.5, 0.1), (2.0, 1.0, 0.1)])
def test_a_lamp_out_of_view_is_found(lit: ShellRoom, place: tuple[float, float, float]) -> None:
    """The lamp is on the ceiling, which no picture shows; its light turns by 60 degrees between the places."""
    found, truth = light_at(lit, np.array(place)), true_light(np.array(place), LAMP, AMBIENT)
    assert angle_deg(found, truth) < 8  # seen: 5 to 6.4 (13 in mid-air)
    assert found[0] == pytest.approx(truth[0], rel=0.25)


def test_light_without_direction_has_none() -> None:
    """A white furnace: the ambient light alone."""
    room = make_room(None, AMBIENT, dict.fromkeys(range(3), (0.6, 0.6, 0.6)))
    room.solve(15)
    cells = objective.radiances(room.unknowns, room.transport, CELLS)
    seen = room.transport.shares[:, :CELLS].sum(0) > 0.5
    assert np.ptp(np.log(cells[seen])) < 0.25
    assert np.exp(np.log(cells[seen]).mean()) == pytest.approx(0.3, rel=0.1)


def test_a_brighter_picture_is_a_brighter_light() -> None:
    """Twice the radiance everywhere is twice the light, exactly."""
    rooms = []
    for factor in (1.0, 2.0):
        room = make_room(LAMP, AMBIENT)
        used = room.patches.used
        room.patches.logarithms[used] += np.log(factor)
        room.patches.arrivals[used, :, :3] *= factor
        room.transport = Transport()
        room.transport.update(room.patches, used, room.shell)
        room.solve(5)
        rooms.append(objective.radiances(room.unknowns, room.transport, CELLS))
    np.testing.assert_allclose(rooms[1], 2 * rooms[0], rtol=2e-3)  # the Gram matrix is summed in float32


def test_albedos_stay_below_one(lit: ShellRoom) -> None:
    """The brightest patch may not be explained by surface that sends more than it receives."""
    data = objective._data(lit.patches, lit.transport)
    level, _ = objective._levels(lit.unknowns.z[: lit.unknowns.known], lit.transport, lit.unknowns.known)
    albedo = np.exp(data.level) / (data.shares @ level + data.known)
    truth = np.exp(np.log([(0.6, 0.3, 0.2), (0.55, 0.55, 0.5), (0.3, 0.4, 0.6)]).mean(1))
    assert np.median(albedo) == pytest.approx(np.median(truth), rel=0.3)
    assert np.quantile(albedo, 0.99) < 1.0


def test_the_solution_is_a_minimum(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the twin of the objective, which has no outliers: no unknown can be moved to a smaller sum."""
    monkeypatch.setattr(objective, "HUBER", np.inf)
    room = make_room(LAMP, AMBIENT, dict.fromkeys(range(3), (0.5, 0.5, 0.5)))
    room.solve(60)
    data, unknowns = objective._data(room.patches, room.transport), room.unknowns
    count = unknowns.known
    prior, deviation = objective._prior(unknowns.mean, room.transport, room.shell, count)
    known_part = (data.known / (data.shares @ np.exp(unknowns.z[:count]) + data.known))[:, None] * data.known_chroma
    parts = data.shares * np.exp(unknowns.z[:count]) / (data.shares @ np.exp(unknowns.z[:count]) + data.known)[:, None]
    nodes, weights = objective._materials(data.chroma - parts @ unknowns.chroma[:count] - known_part)
    offsets = np.array([unknowns.surfaces[int(key)] for key in data.surface_keys])
    z, materials = unknowns.z[:count].copy(), unknowns.materials[nodes]

    def value(z: Floats, materials: Floats, offsets: Floats) -> float:
        return level_objective(
            z, materials, offsets, data.shares, data.known, data.level, weights, data.surfaces, data.regions,
            prior, deviation,
        )  # fmt: skip

    best = value(z, materials, offsets)
    random = np.random.default_rng(1)
    for size in (0.3, 0.1, 0.03):
        for _ in range(10):
            moved = value(
                z + size * random.normal(size=count),
                materials + size * random.normal(size=len(materials)),
                offsets + size * random.normal(size=len(offsets)),
            )
            assert moved > best
    for cell in np.argsort(-data.shares.sum(0))[:12]:
        ends = [value(z + sign * 0.05 * np.eye(count)[cell], materials, offsets) for sign in (-1, 1)]
        slope, bend = (ends[1] - ends[0]) / 0.1, (ends[1] + ends[0] - 2 * best) / 0.05**2
        assert abs(slope / bend) < 0.02  # the minimum along this cell is nearer than 2 %


def spoilt(case: str) -> ShellRoom:
    """A room whose pictures hardly tell anything, or lie."""
    albedos = {2: (0.5, 0.5, 0.5)} if case == "one plane" else dict.fromkeys(range(3), (0.5, 0.5, 0.5))
    room = make_room(LAMP, AMBIENT, albedos)
    patches, used = room.patches, room.patches.used
    if case == "black":
        patches.logarithms[used] = np.log(0.002)
        patches.arrivals[used, :, :3] = 0.0
    elif case == "all clipped":
        patches.clipped[used], patches.logarithms[used] = 1.0, 0.0
        patches.arrivals[used, :, :3] = 1.0
    elif case == "noise":
        patches.logarithms[used] = np.random.default_rng(4).normal(-2, 3, (len(used), 3))
    elif case == "seen from behind":
        patches.arrivals[used, :, 3] *= -1
    elif case == "a speck":
        patches.weights[used[12:]] = 0.0
    elif case == "nothing but surface":
        patches.arrivals[used, :, :3], patches.arrivals[used, :, 3] = KNOWN, 1.0
    room.transport = Transport()
    room.transport.update(patches, patches.used, room.shell)
    return room


SPOILT = ("black", "all clipped", "noise", "seen from behind", "a speck", "nothing but surface", "one plane")


@pytest.mark.parametrize("case", SPOILT)
def test_the_solve_is_stable(case: str) -> None:
    """Finite light within what an 8-bit camera could have seen, a bounded condition."""
    room = spoilt(case)
    room.solve(25)
    unknowns = room.unknowns
    light = objective.radiances(unknowns, room.transport, unknowns.known)
    assert np.isfinite(light).all()
    assert light.max() < 1e5
    assert np.isfinite(unknowns.covariance).all()
    assert (np.diag(unknowns.covariance) > 0).all()
    # A cell is known at least as well as beforehand.
    _, deviation = objective._prior(unknowns.mean, room.transport, room.shell, unknowns.known)
    assert (np.sqrt(np.diag(unknowns.covariance)) <= 1.01 * deviation).all()
    assert unknowns.condition < 1e7
    assert np.isfinite(unknowns.step)


def test_last_bits_of_the_pictures_do_not_matter() -> None:
    """A relative change of 1e-6 in every patch turns the light by far less than a degree."""
    lights = []
    for noise in (0.0, 1e-6):
        room = make_room(LAMP, AMBIENT)
        used = room.patches.used
        room.patches.logarithms[used] += noise * np.random.default_rng(6).normal(size=(len(used), 3))
        room.solve(10)
        lights.append(light_at(room, np.array([1.0, 1.0, 0.7])))
    assert angle_deg(*lights) < 0.05


def test_rays_end_where_they_meet_the_box() -> None:
    shell = Shell(np.eye(3), np.zeros(3), np.array([2.0, 3.0, 4.0]), 0.0)
    random = np.random.default_rng(5)
    points = random.uniform(0.1, 1.9, (50, 3))
    directions = DIRECTIONS[random.integers(0, len(DIRECTIONS), (50, 7))]
    cells = shell.exits(np.broadcast_to(points[:, None], directions.shape), directions)
    # The middle of the cell lies within half a cell's diagonal of the point where the ray leaves.
    with np.errstate(divide="ignore"):
        far = np.where(directions > 0, shell.high - points[:, None], -points[:, None]) / directions
    ends = points[:, None] + np.min(np.where(far > 0, far, np.inf), -1)[..., None] * directions
    assert np.abs(ends - shell.centers[cells]).max() <= (4.0 / SIDE) / 2 + 1e-9
    assert cells.min() >= 0
    assert cells.max() < CELLS


def test_cells_of_a_closed_box_have_four_neighbours() -> None:
    counts = np.bincount(neighbours().ravel(), minlength=CELLS)
    np.testing.assert_array_equal(counts, 4)
    shell = Shell(np.eye(3), np.zeros(3), np.ones(3), 0.0)
    first, second = (shell.centers[side] for side in neighbours().T)
    assert np.linalg.norm(first - second, axis=1).max() < 1.01 / SIDE


def test_the_box_is_aligned_with_floor_and_walls() -> None:
    turn, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))
    faces = np.concatenate([np.tile(turn[axis], (40, 1)) for axis in range(3)])
    faces += np.random.default_rng(3).normal(0, 0.05, faces.shape)
    faces /= np.linalg.norm(faces, axis=1, keepdims=True)
    tilted = turn[2] + 0.4 * turn[0]
    up = upright(faces, tilted / np.linalg.norm(tilted))
    assert np.degrees(np.arccos(up @ turn[2])) < 3  # given 22 degrees off
    axes = wall_axes(faces, up)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.abs(axes @ turn.T).max(1).min() > np.cos(np.radians(4))


def test_the_box_holds_scan_cameras_and_a_ceiling() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0.5], [0, 1, 0.2]])
    shell = shell_around(points, np.tile(UP, (4, 1)), CAMERA[None], UP, None)
    camera = shell.axes @ CAMERA
    assert (shell.low[:2] <= camera[:2] - BEHIND_M + 1e-9).all() or (camera[:2] - BEHIND_M > shell.low[:2]).all()
    assert (shell.high[:2] >= camera[:2] + BEHIND_M - 1e-9).all()
    assert shell.high[2] - shell.floor_m >= LEAST_HEIGHT_M - 1e-9
    again = shell_around(points + 0.01, np.tile(UP, (4, 1)), CAMERA[None], UP, shell)
    assert again is shell  # noise moves nothing
    grown = shell_around(points, np.tile(UP, (4, 1)), CAMERA[None] + SIZE_M, UP, shell)
    assert (grown.high >= shell.high).all()
    assert (grown.high[:2] > shell.high[:2]).all()


def test_what_rays_meet() -> None:
    transport, shell = Transport(), Shell(np.eye(3), np.zeros(3), np.full(3, 4.0), 0.0)
    directions = np.array([[[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [0, 0, -1.0]]])
    arrivals = np.array([[[0.2, 0.3, 0.4, 1.0], [0, 0, 0, -1.0], [1, SATURATED, 0.5, 1.5], [0, 0, 0, 0]]])
    met = transport.meet(shell, np.array([[2.0, 2.0, 2.0]]), directions, arrivals, learn=True)
    known, back, bright, free = met.columns[0]
    assert known == -1
    np.testing.assert_array_equal(met.known[0, 0], [0.2, 0.3, 0.4])
    assert not transport.is_saturated[back]
    assert back >= CELLS
    assert transport.is_saturated[bright]
    np.testing.assert_allclose(transport.at_least[bright], [1, SATURATED, 0.5])
    assert free == shell.exits(np.array([2.0, 2.0, 2.0]), np.array([0.0, 0, -1.0]))
    assert transport.columns == CELLS + 2
