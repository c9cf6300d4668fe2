"""The model of a room's light in a box of known light: what is found, and that it is the objective's minimum."""

from __future__ import annotations

import numpy as np
import pytest

from server.light.shell import weights
from server.light.shell.distant import distant_light
from server.light.shell.evidence import DARKEST, log_chroma, materials_of
from server.light.shell.level import LOGIT
from server.light.shell.objective import received, step
from server.light.shell.patches import PATCH_M, RAYS, Patches, hemisphere_weights, ray_directions
from server.light.shell.shell import (
    BEHIND_M,
    CELLS,
    LEAST_HEIGHT_M,
    SIDE,
    SIDES,
    Shell,
    neighbours,
    upright,
    wall_axes,
)
from server.light.shell.solver import LEAST_PATCHES
from server.light.shell.sources import distant_sources
from server.light.shell.switches import Switches
from server.light.shell.transport import COLUMNS, MOST_HIDDEN, MOST_LAMPS, MOST_SATURATED, SATURATED, Transport, meet
from server.light.shell.unknowns import Unknowns
from server.maths.lobes import LOBES, lobes_along, lobes_to_sh
from server.maths.sh import LUMINANCE, sh_basis, spherical_fibonacci
from tests.reference.room_objective import level_objective, middle_objective
from tests.scenes.analytic import Floats
from tests.scenes.shell_room import (
    CAMERA,
    KNOWN,
    NO_EMITTERS,
    OPEN,
    SIZE_M,
    UP,
    Lamp,
    ShellRoom,
    make_room,
    sent,
    sky,
)
from tests.scenes.shells import shell_of

LAMP = Lamp((3.0, 0.9), 0.7, (16.0, 15.0, 14.0))
AMBIENT = (0.3, 0.3, 0.3)
DIRECTIONS = spherical_fibonacci(2048)
BASIS = 4 * np.pi / len(DIRECTIONS) * sh_basis(DIRECTIONS, 4).T


def light_at(room: ShellRoom, place: Floats) -> Floats:
    """[16] luminance of the light found at `place`, with the scanned surface's own."""
    directions = np.broadcast_to(DIRECTIONS, (1, *DIRECTIONS.shape))
    _, arrivals = sent(place[None], directions, None, np.zeros(3))
    met = meet(room.shell, room.transport.hidden, place[None], directions, arrivals)
    cells = room.unknowns.radiance
    radiance = (met.known + np.einsum("nmc,nmcr->nmr", met.shares, cells[np.maximum(met.columns, 0)]))[0]
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


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_light_does_not_depend_on_where_steps_begin(lit: ShellRoom, seed: int) -> None:
    """Nor on what was solved before: cells that are e times brighter or darker at first, by chance."""
    room, place = make_room(LAMP, AMBIENT), np.array((1.0, 1.0, 0.7))
    room.solve(1)
    room.unknowns.z += np.random.default_rng(seed).normal(size=room.unknowns.known)
    room.solve(24)
    found, other = light_at(room, place), light_at(lit, place)
    assert angle_deg(found, other) < 0.05  # seen: .02, and eight steps leave a tenth
    assert found[0] == pytest.approx(other[0], rel=1e-3)


def test_light_without_direction_has_none() -> None:
    """A white furnace: the ambient light alone."""
    room = make_room(None, AMBIENT, dict.fromkeys(range(3), (0.6, 0.6, 0.6)))
    room.solve(15)
    for place in ((1.0, 1.0, 0.7), (0.7, 0.7, 0.7), (1.5, 1.5, 1.0)):
        found, truth = light_at(room, np.array(place)), true_light(np.array(place), None, AMBIENT)
        # Seen: .13 to .17. Grey is taken for white paint, which is a little warm, and what is not in view for bluer.
        assert np.linalg.norm(found[1:4]) < 0.2 * found[0]
        # Seen: .78. What is not in view is taken to be surface, which is darker than the light of a furnace.
        assert found[0] == pytest.approx(truth[0], rel=0.3)


def test_a_brighter_picture_is_a_brighter_light() -> None:
    """Twice the radiance everywhere is twice the light, exactly."""
    rooms = []
    for factor in (1.0, 2.0):
        room = make_room(LAMP, AMBIENT)
        used = room.patches.used
        room.patches.logarithms[used] += np.log(factor)
        room.patches.arrivals[used, :, :3] *= factor
        room.transport = Transport()
        room.transport.update(room.patches, NO_EMITTERS, used, room.shell)
        room.solve(5)
        rooms.append(room.unknowns.radiance[:CELLS])
    np.testing.assert_allclose(rooms[1], 2 * rooms[0], rtol=2e-3)  # the Gram matrix is summed in float32


def test_albedos_stay_below_one(lit: ShellRoom) -> None:
    """The brightest patch may not be explained by surface that sends more than it receives."""
    evidence, near = lit.evidence, lit.near
    known = np.exp(np.log(np.maximum(near.known, DARKEST)).mean(1))
    level = np.exp(np.log(lit.unknowns.radiance).mean(1))
    albedo = np.exp(evidence.level) / (near.shares @ level + known)
    truth = np.exp(np.log([(0.6, 0.3, 0.2), (0.55, 0.55, 0.5), (0.3, 0.4, 0.6)]).mean(1))
    assert np.median(albedo) == pytest.approx(np.median(truth), rel=0.3)
    assert np.quantile(albedo, 0.99) < 1.0


def test_a_light_that_no_picture_clips_says_nothing_of_what_arrives() -> None:
    """A screen of 1.2 x 1.2 m on a wall, ten times as bright as white surface would be."""
    place, lights = np.array([1.0, 1.0, 0.7]), []
    for is_on in (False, True):
        room = make_room(LAMP, AMBIENT)
        patches, used = room.patches, room.patches.used
        on_wall = used[patches.normals[used, 0] > 0.9]
        middle = patches.positions[on_wall].mean(axis=0)
        screen = on_wall[np.abs(patches.positions[on_wall] - middle).max(axis=1) < 0.6]
        assert len(screen) > 20
        if is_on:
            patches.logarithms[screen] = np.log(8.0)
        room.solve(25)
        lights.append(light_at(room, place))
    assert lights[1][0] == pytest.approx(lights[0][0], rel=0.15)  # 19 times as bright while it counted
    assert angle_deg(lights[1], lights[0]) < 8


def test_the_solution_is_a_minimum(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the twin of the objective, which has no outliers: no unknown can be moved to a smaller sum."""
    monkeypatch.setattr(weights, "HUBER", np.inf)
    room = make_room(LAMP, AMBIENT, dict.fromkeys(range(3), (0.5, 0.5, 0.5)))
    room.solve(60)
    data, near, unknowns = room.evidence, room.near, room.unknowns
    count = unknowns.known
    known_logs = log_chroma(np.log(np.maximum(near.known, DARKEST)))
    known = np.where(near.known.max(axis=1) > 0, np.exp(known_logs[:, 0]), 0.0)
    arriving = near.shares @ np.exp(unknowns.z) + known
    parts = near.shares * np.exp(unknowns.z) / arriving[:, None]
    chroma = data.chroma - parts @ unknowns.chroma - (known / arriving)[:, None] * known_logs[:, 1:]
    nodes, shares_of_materials = materials_of(chroma)
    offsets = np.array([unknowns.offsets[data.rows][data.surfaces == f][0] for f in range(data.surfaces.max() + 1)])
    z, materials = unknowns.z.copy(), unknowns.materials[nodes]

    def value(z: Floats, materials: Floats, offsets: Floats) -> float:
        return level_objective(
            z, materials, offsets, near.shares, known, data.level, shares_of_materials, data.surfaces, data.regions,
            unknowns.mean + near.offset, near.deviation, unknowns.middle,
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
    albedos = np.log(1 / (1 + np.exp(-(shares_of_materials @ materials)))) + offsets[data.surfaces]
    usable, m = ~data.is_clipped, unknowns.middle
    lower, least, higher = (
        middle_objective(m + move, m, albedos[usable], chroma[usable]) for move in (-0.01, 0.0, 0.01)
    )
    assert abs((higher - lower) / (higher + lower - 2 * least)) * 0.005 < 0.01  # to a hundredth of a logit
    for cell in np.argsort(-near.shares.sum(0))[:12]:
        ends = [value(z + sign * 0.05 * np.eye(count)[cell], materials, offsets) for sign in (-1, 1)]
        slope, bend = (ends[1] - ends[0]) / 0.1, (ends[1] + ends[0] - 2 * best) / 0.05**2
        assert abs(slope / bend) < 0.02  # the minimum along this cell is nearer than 2 %


@pytest.mark.parametrize("known", [KNOWN, 4 * KNOWN])
def test_the_level_is_found_in_few_steps(known: Floats) -> None:
    """Where the brightest surface is far brighter than most, m goes a long way, and the light with it."""
    room = make_room(LAMP, AMBIENT, {0: (0.85, 0.85, 0.8), 1: (0.3, 0.3, 0.25), 2: (0.5, 0.4, 0.3)}, known)
    room.solve(8)
    soon = received(room.unknowns, room.near).mean()
    room.solve(24)
    assert soon == pytest.approx(received(room.unknowns, room.near).mean(), abs=0.03)  # a logarithm; .2 with m alone


def test_materials_of_no_patch_go_along_with_the_level() -> None:
    """A patch whose material no other has begins at the mean of the materials, not at one of seconds ago."""
    room = make_room(LAMP, AMBIENT, {0: (0.85, 0.85, 0.8), 1: (0.3, 0.3, 0.25), 2: (0.5, 0.4, 0.3)}, KNOWN)
    room.solve(8)
    unknowns, corner = room.unknowns, 0  # of the grid: far more saturated than any patch
    assert abs(unknowns.middle - LOGIT) > 0.1
    assert unknowns.materials[corner] == pytest.approx(unknowns.middle)


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
        patches.weights[used[LEAST_PATCHES:]] = 0.0
    elif case == "nothing but surface":
        patches.arrivals[used, :, :3], patches.arrivals[used, :, 3] = KNOWN, 1.0
    room.transport = Transport()
    room.transport.update(patches, NO_EMITTERS, patches.used, room.shell)
    return room


SPOILT = ("black", "all clipped", "noise", "seen from behind", "a speck", "nothing but surface", "one plane")


@pytest.mark.parametrize("case", SPOILT)
def test_the_solve_is_stable(case: str) -> None:
    """Finite light within what an 8-bit camera could have seen, a bounded condition."""
    room = spoilt(case)
    room.solve(25)
    unknowns = room.unknowns
    assert np.isfinite(unknowns.radiance).all()
    assert unknowns.radiance.max() < 1e5
    told = unknowns.solved()
    covariance, condition = told.covariance, told.condition
    assert np.isfinite(covariance).all()
    assert (np.diag(covariance) > 0).all()
    # A cell is known at least as well as beforehand.
    near = room.near
    assert (np.sqrt(np.diag(covariance)) <= 1.01 * near.deviation).all()
    assert condition < 1e7
    exact = np.linalg.cond(unknowns.curvature.astype(np.float64), 1)
    assert 0.1 * exact < condition < 1.001 * exact
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
    shell = Shell(np.eye(3), np.zeros(3), np.array([2.0, 3.0, 4.0]), 0.0, np.zeros((2, 3)))
    random = np.random.default_rng(5)
    points = random.uniform(0.1, 1.9, (50, 3))
    directions = DIRECTIONS[random.integers(0, len(DIRECTIONS), (50, 7))]
    cells, shares = shell.exits(np.broadcast_to(points[:, None], directions.shape), directions)
    with np.errstate(divide="ignore"):
        far = np.where(directions > 0, shell.high - points[:, None], -points[:, None]) / directions
    ends = points[:, None] + np.min(np.where(far > 0, far, np.inf), -1)[..., None] * directions
    # Bilinear shares give back a linear function, up to the outermost middles of a face.
    half = (shell.high - shell.low) / SIDE / 2
    is_across = (ends <= 1e-9) | (ends >= shell.high - 1e-9)
    expected = np.where(is_across, ends, np.clip(ends, half, shell.high - half))
    np.testing.assert_allclose((shares[..., None] * shell.centers[cells]).sum(axis=-2), expected, atol=1e-6)
    np.testing.assert_allclose(shares.sum(axis=-1), 1.0)
    assert shares.min() >= 0
    assert (cells // SIDE**2 == cells[..., :1] // SIDE**2).all()


def test_cells_of_a_closed_box_have_four_neighbours() -> None:
    counts = np.bincount(neighbours().ravel(), minlength=CELLS)
    np.testing.assert_array_equal(counts, 4)
    shell = Shell(np.eye(3), np.zeros(3), np.ones(3), 0.0, np.zeros((2, 3)))
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


def test_up_is_as_given_where_nothing_faces_up() -> None:
    walls = np.repeat([[1.0, 0, 0], [0, 1.0, 0]], 50, axis=0)
    np.testing.assert_allclose(upright(walls, UP), UP, atol=1e-6)


def test_the_box_holds_scan_cameras_and_a_ceiling() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0.5], [0, 1, 0.2]])
    shell = shell_of(points, np.tile(UP, (4, 1)), CAMERA[None], UP, PATCH_M**2)
    camera = shell.axes @ CAMERA
    assert (shell.low[:2] <= camera[:2] - BEHIND_M + 1e-9).all() or (camera[:2] - BEHIND_M > shell.low[:2]).all()
    assert (shell.high[:2] >= camera[:2] + BEHIND_M - 1e-9).all()
    assert shell.high[2] - shell.floor_m >= LEAST_HEIGHT_M - 1e-9
    again = shell_of(points + 0.01, np.tile(UP, (4, 1)), CAMERA[None], UP, PATCH_M**2, shell)
    assert again is shell  # noise moves nothing
    grown = shell_of(points, np.tile(UP, (4, 1)), CAMERA[None] + SIZE_M, UP, PATCH_M**2, shell)
    assert (grown.high[:2] > shell.high[:2]).all()
    assert (grown.low[:2] <= camera[:2] - BEHIND_M + 0.1).all()  # the first camera's place is remembered


def test_what_rays_meet() -> None:
    transport, shell = Transport(), Shell(np.eye(3), np.zeros(3), np.full(3, 4.0), 0.0, np.zeros((2, 3)))
    directions = np.array([[[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [0, 0, -1.0], [-1.0, 0, 0]]])
    of_surface = [[0.2, 0.3, 0.4, 1e-3], [0, 0, 0, -1e-3], [1, SATURATED, 0.95, 1e-3]]
    arrivals = np.array([[*of_surface, [0, 0, 0, 0], [0.4, 0.5, 0.6, -1e-3]]])  # the last only another light showed
    patches, middle = Patches(), np.array([[2.0, 2.0, 2.0]])
    patches.positions[:1], patches.weights[0], patches.traced_in[0] = middle, 1.0, 1
    patches.traced_normals[0], patches.arrivals[0] = [0.6, 0.0, 0.8], np.tile(arrivals[0], (RAYS // 5 + 1, 1))[:RAYS]
    transport.update(patches, NO_EMITTERS, np.array([0]), shell)
    met = meet(shell, transport.hidden, middle, directions, arrivals)
    (known, back, bright, free, outdated), shares = met.columns[0], met.shares[0]
    assert (known == -1).all()
    np.testing.assert_allclose(shares.sum(axis=-1), [0, 1, 1, 1, 1])
    back, bright = back[0], bright[0]
    np.testing.assert_array_equal(met.known[0, 0], [0.2, 0.3, 0.4])
    np.testing.assert_array_equal(met.known[0, 2], [1, SATURATED, 0.95])
    np.testing.assert_array_equal(met.is_saturated[0], [False, False, True, False, False])
    assert not transport.is_saturated[back]
    assert back >= CELLS
    assert transport.is_saturated[bright]
    np.testing.assert_allclose(transport.clipped[bright], [1, SATURATED, 0.95])
    cells, _ = shell.exits(np.array([2.0, 2.0, 2.0]), np.array([0.0, 0, -1.0]))
    np.testing.assert_array_equal(free, cells)
    np.testing.assert_array_equal(outdated, shell.exits(np.array([2.0, 2.0, 2.0]), np.array([-1.0, 0, 0]))[0])
    np.testing.assert_array_equal(met.known[0, 4], 0.0)
    assert transport.columns == CELLS + 2
    towards = hemisphere_weights(patches.traced_normals[:1])[0]
    of_each = np.bincount(np.arange(RAYS) % 5, towards)
    shares = transport.shares[0]
    wanted = [of_each[1], of_each[2], of_each[3] + of_each[4]]
    np.testing.assert_allclose([shares[back], shares[bright], shares[:CELLS].sum()], wanted, rtol=1e-5)
    lobes = towards[3::5] @ lobes_along(ray_directions()[3::5])
    np.testing.assert_allclose(transport.beyond[0].sum(axis=0), lobes, rtol=1e-4)  # surface lets nothing through
    np.testing.assert_allclose(transport.known[0], of_each[[0, 2]] @ arrivals[0, [0, 2], :3], rtol=1e-5)


def test_cells_beyond_the_most_share_one_of_their_kind() -> None:
    transport, shell = Transport(), Shell(np.eye(3), np.full(3, -50.0), np.full(3, 50.0), 0.0, np.zeros((2, 3)))
    patches, kinds = Patches(), np.arange(RAYS) % 2
    patches.weights[0], patches.traced_in[0], patches.traced_normals[0] = 1.0, 1, [0.0, 0.0, 1.0]
    away = np.linspace(5.0, 40.0, RAYS)
    patches.arrivals[0] = np.stack([*np.tile(kinds, (3, 1)), np.where(kinds, away, -away)], axis=1)
    transport.update(patches, NO_EMITTERS, np.array([0]), shell)
    assert transport.columns == COLUMNS - MOST_LAMPS
    arrivals = patches.arrivals[:1].astype(np.float64)
    met = meet(shell, transport.hidden, np.zeros((1, 3)), ray_directions()[None], arrivals)
    columns, above = met.columns[0, :, 0], ray_directions()[:, 2] > 0
    np.testing.assert_array_equal(transport.is_saturated[columns[above]], kinds[above] == 1)
    assert [len(np.unique(columns[above & (kinds == kind)])) for kind in (0, 1)] == [
        MOST_HIDDEN + 1,
        MOST_SATURATED + 1,
    ]
    shares = np.bincount(columns[above], hemisphere_weights(patches.traced_normals[:1])[0][above], COLUMNS)
    np.testing.assert_allclose(transport.shares[0], shares, atol=1e-6)


# ---- light from far away ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("towards", OPEN)
@pytest.mark.parametrize("with_indirect", [True, False])
def test_light_from_far_away_is_found(towards: tuple[float, float, float], with_indirect: bool) -> None:
    """Through the open sides of a corner, whose scanned sides are told to be wall."""
    known = KNOWN if with_indirect else np.zeros(3)
    room, truth = make_room(None, sky(np.array(towards)), known=known), sky(np.array(towards))(DIRECTIONS)
    unknowns, evidence, distant = Unknowns(), room.evidence, room.distant(with_indirect=with_indirect)
    for _ in range(25):
        step(unknowns, evidence, distant)
    light = distant_light(unknowns.solved(LOBES), 4)
    assert angle_deg(light.sh @ LUMINANCE, BASIS @ truth @ LUMINANCE) < 18  # seen: 4 to 17
    assert light.sh[0].mean() == pytest.approx((BASIS @ truth)[0].mean(), rel=0.4)
    assert light.spread_deg is not None
    assert light.valid == (light.spread_deg <= 25)
    assert light.std is not None
    assert np.isfinite(light.condition)


def test_lobes_that_patches_do_not_tell_apart_share_the_light() -> None:
    """Whichever was the brighter one at first."""
    room, unknowns = make_room(None, sky(np.array(OPEN[0])), known=KNOWN), Unknowns()
    distant = room.distant()
    first, second = np.argsort(distant.shares[:, :LOBES].sum(axis=0))[-2:]
    distant.shares[:, [first, second]] = distant.shares[:, [first, second]].mean(axis=1, keepdims=True)
    distant.offset[[first, second]] = distant.offset[[first, second]].mean()
    step(unknowns, room.evidence, distant)
    unknowns.z[first], unknowns.z[second] = unknowns.z[first] + 2, unknowns.z[second] - 2
    for _ in range(150):
        step(unknowns, room.evidence, distant)
    # Seen: .01. Of a normal distribution of the logarithm: 3.9 after 60 steps, the brighter one keeps the light.
    assert unknowns.z[first] == pytest.approx(unknowns.z[second], abs=0.1)


def test_where_nothing_is_known_light_comes_from_above() -> None:
    """The prior alone: a zenith e times as bright as a nadir, about gravity and not an axis of the world."""
    up = np.array([0.6, 0.0, 0.8])
    transport = make_room(None, sky(np.array(OPEN[0]))).transport
    distant = distant_sources(transport, np.ones(SIDES), up, np.zeros(0, np.int64), with_indirect=True)
    light = lobes_to_sh(2) @ np.exp(distant.offset[:LOBES])
    assert angle_deg(light, sh_basis(up[None], 2)[0]) < 3  # seen: 1.0
    assert np.ptp(distant.offset[:LOBES]) == pytest.approx(2 * weights.LOBE_UP, rel=0.1)
    assert distant.offset[LOBES:].max() <= 0.0


def test_before_a_solve_there_is_no_distant_light() -> None:
    light = distant_light(Unknowns().solved(), 3)
    assert not light.sh.any()
    assert light.std is None
    assert not light.valid


def test_a_closed_box_says_nothing_of_what_is_beyond() -> None:
    room = make_room(LAMP, AMBIENT)
    unknowns, evidence = Unknowns(), room.evidence
    closed = distant_sources(room.transport, np.ones(SIDES), room.shell.axes[2], evidence.rows, with_indirect=True)
    for _ in range(25):
        step(unknowns, evidence, closed)
    light = distant_light(unknowns.solved(LOBES), 4)
    assert not light.valid
    assert light.spread_deg is not None
    assert light.spread_deg > 60


def test_one_albedo_is_one_albedo() -> None:
    """Where it is known, the light of a white corner is known to its level."""
    room = make_room(None, sky(np.array(OPEN[0])), dict.fromkeys(range(3), (weights.GIVEN_ALBEDO,) * 3))
    truth = sky(np.array(OPEN[0]))(DIRECTIONS)
    unknowns, evidence, distant = Unknowns(), room.evidence, room.distant()
    for _ in range(25):
        step(unknowns, evidence, distant, Switches(albedos=False))
    used = unknowns.materials != Unknowns().materials
    assert used.any()
    given = np.log(weights.GIVEN_ALBEDO / (1 - weights.GIVEN_ALBEDO))
    assert np.abs(unknowns.materials[used] - given).max() < 0.1
    light = distant_light(unknowns.solved(LOBES), 4)
    assert angle_deg(light.sh @ LUMINANCE, BASIS @ truth @ LUMINANCE) < 6
