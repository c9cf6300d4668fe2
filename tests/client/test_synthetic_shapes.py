"""Ray intersections against closed forms and against the solids' own signed distances, written here anew."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from client.synthetic.solids.polyhedra import Solid, box, rotation_about, wedge
from client.synthetic.solids.round import Capsule, Cylinder, Sphere
from client.synthetic.solids.shell import Opening, Shell

TILT = rotation_about("y", 30) @ rotation_about("z", 50)
AXIS = np.array([2.0, 3, 6]) / 7
CENTER = np.array([0.2, -0.1, 0.3])


def box_distance(points: np.ndarray) -> np.ndarray:
    q = np.abs((points - CENTER) @ TILT) - np.array([0.4, 0.6, 1.0]) / 2
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)


def sphere_distance(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points - CENTER, axis=1) - 0.4


def cylinder_distance(points: np.ndarray) -> np.ndarray:
    height = (points - CENTER) @ AXIS
    off_axis = np.linalg.norm(points - CENTER - height[:, None] * AXIS, axis=1)
    q = np.stack([off_axis - 0.2, np.abs(height - 0.35) - 0.35], axis=1)
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)


def capsule_distance(points: np.ndarray) -> np.ndarray:
    height = np.clip((points - CENTER) @ AXIS, 0, 0.5)
    return np.linalg.norm(points - CENTER - height[:, None] * AXIS, axis=1) - 0.15


def wedge_distance(points: np.ndarray) -> np.ndarray:
    """Exact in sign, and zero on the surface; not a length."""
    x, y, z = ((points - CENTER) @ TILT).T
    ramp = (y - 0.3 * (x + 0.4) / 0.8) * 0.8 / np.hypot(0.8, 0.3)
    return np.max([ramp, x - 0.4, -y, np.abs(z) - 0.25], axis=0)


SOLIDS: dict[str, tuple[Solid, Callable[[np.ndarray], np.ndarray]]] = {
    "box": (box(tuple(CENTER), (0.4, 0.6, 1.0), TILT), box_distance),
    "sphere": (Sphere(CENTER, 0.4), sphere_distance),
    "cylinder": (Cylinder(CENTER, AXIS, 0.7, 0.2), cylinder_distance),
    "capsule": (Capsule(CENTER, CENTER + 0.5 * AXIS, 0.15), capsule_distance),
    "wedge": (wedge(tuple(CENTER), (0.8, 0.3, 0.5), TILT), wedge_distance),
}
EACH = pytest.mark.parametrize("name", SOLIDS)


def rays_from(origin: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
    """Directions of many lengths, most of them towards the solids."""
    random = np.random.default_rng(seed)
    targets = CENTER + random.normal(0, 0.4, (count, 3))
    return (targets - origin) * random.uniform(0.2, 3, (count, 1))


@EACH
@pytest.mark.parametrize("origin", [(2.0, 1, -1.5), (0.3, 3, 0.3), (-4, 0, 0)])
def test_first_hit_is_where_the_distance_becomes_zero(name: str, origin: tuple[float, float, float]) -> None:
    solid, distance = SOLIDS[name]
    start = np.array(origin)
    directions = rays_from(start, 3000)
    t = solid.intersect(start, directions)
    hit = np.isfinite(t)
    assert 0.1 < hit.mean() < 0.95
    np.testing.assert_allclose(distance(start + t[hit, None] * directions[hit]), 0, atol=1e-12)
    steps = np.linspace(0, 1, 400)[:, None, None]
    until = np.where(hit, t * (1 - 1e-9), 5 * np.linalg.norm(start - CENTER) / np.linalg.norm(directions, axis=1))
    along = start + steps * until[:, None] * directions
    assert distance(along.reshape(-1, 3)).min() > -1e-9  # outside all the way, for misses too


def test_closed_forms() -> None:
    origin, ahead = np.array([0.0, 0, -5]), np.array([[0, 0, 1.0], [0, 0, 2.0], [0, 0, -1.0]])
    np.testing.assert_allclose(Sphere(np.zeros(3), 1).intersect(origin, ahead), (4, 2, np.inf))
    np.testing.assert_allclose(box((0, 0, 0), (2, 2, 3)).intersect(origin, ahead), (3.5, 1.75, np.inf))
    np.testing.assert_allclose(
        Cylinder(np.zeros(3), np.array([0, 1.0, 0]), 1, 1).intersect(np.array([0, 0.5, -5]), ahead), (4, 2, np.inf)
    )
    np.testing.assert_allclose(
        Cylinder(np.zeros(3), np.array([0, 0, 1.0]), 1, 1).intersect(origin, ahead), (5, 2.5, np.inf)
    )
    np.testing.assert_allclose(Capsule(np.zeros(3), np.array([0, 0, 1.0]), 1).intersect(origin, ahead), (4, 2, np.inf))
    grazing = np.array([[0, 1e-9, 1.0]])
    assert np.isinf(Sphere(np.array([0, 1.1, 0]), 1).intersect(origin, grazing)).all()


@EACH
def test_normals_are_the_slope_of_the_distance(name: str) -> None:
    solid, distance = SOLIDS[name]
    start = np.array([2.0, 1, -1.5])
    directions = rays_from(start, 2000)
    t = solid.intersect(start, directions)
    points = (start + t[:, None] * directions)[np.isfinite(t)]
    normals = solid.normals(points)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)
    assert distance(points + 1e-3 * normals).min() > 0.9e-3
    assert distance(points - 1e-4 * normals).max() < 0


@EACH
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_blocks_agrees_with_intersect(name: str, dtype: type) -> None:
    solid, distance = SOLIDS[name]
    random = np.random.default_rng(3)
    points = CENTER + random.normal(0, 1, (60, 3))
    points = points[distance(points) > 0.01]
    directions = random.normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    blocked = solid.blocks(points.astype(dtype), directions.astype(dtype))
    expected = np.array([np.isfinite(solid.intersect(point, directions)) for point in points])
    assert expected.any()
    assert np.mean(blocked != expected) <= (0 if dtype is np.float64 else 1e-3)


@EACH
def test_contains_and_bounds(name: str) -> None:
    solid, distance = SOLIDS[name]
    points = CENTER + np.random.default_rng(4).uniform(-1, 1, (20_000, 3))
    inside = distance(points) < 0
    np.testing.assert_array_equal(solid.contains(points), inside)
    center, radius = solid.bounds
    assert np.linalg.norm(points[inside] - center, axis=1).max() <= radius


@EACH
def test_a_convex_solid_does_not_block_its_own_upper_side(name: str) -> None:
    solid, _ = SOLIDS[name]
    start = np.array([2.0, 1, -1.5])
    directions = rays_from(start, 500)
    t = solid.intersect(start, directions)
    points = (start + t[:, None] * directions)[np.isfinite(t)]
    normals = solid.normals(points)
    outward = normals + 0.9 * np.random.default_rng(5).uniform(-0.5, 0.5, normals.shape)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    blocked = [
        solid.blocks(p[None] + 1e-9 * n, d[None])[0, 0] for p, n, d in zip(points, normals, outward, strict=True)
    ]
    assert not any(blocked)


@EACH
def test_charts_cover_the_surface(name: str) -> None:
    solid, _ = SOLIDS[name]
    start = np.array([-1.5, -2, 1.0])
    directions = rays_from(start, 2000)
    t = solid.intersect(start, directions)
    points = (start + t[:, None] * directions)[np.isfinite(t)]
    part = solid.part(points)
    for number in np.unique(part):
        here = points[part == number]
        s, u = solid.charts[number].coordinates(here)
        assert min(s.min(), u.min()) > -1e-9
        assert max(s.max(), u.max()) < 1 + 1e-9
        again, normals = solid.charts[number].point(s, u)
        np.testing.assert_allclose(again, here, atol=1e-7)
        np.testing.assert_allclose(normals, solid.normals(here), atol=1e-6)


def shell() -> Shell:
    openings = (Opening(5, (-2.0, 0.0), (2.0, 2.6)), Opening(3, (-1.3, -1.0), (0.1, 0.2)))
    return Shell(np.array([-2, 0, -1.5]), np.array([2, 2.6, 1.5]), openings)


def test_shell_is_met_from_inside_but_not_in_its_openings() -> None:
    room, origin = shell(), np.array([0.0, 1.3, 0.0])
    down, back, front, up, to_window = np.array([[0, -1.0, 0], [0, 0, -1], [0, 0, 1], [0.5, 1, 0.5], [-0.5, 1, -0.1]])
    t = room.intersect(origin, np.stack([down, back, front, up, to_window]))
    np.testing.assert_allclose(t, (1.3, 1.5, np.inf, 1.3, np.inf))
    points = origin + t[[0, 1, 3], None] * np.stack([down, back, up])
    np.testing.assert_array_equal(room.normals(points), [(0, 1, 0), (0, 0, 1), (0, -1, 0)])


def test_shell_blocks_as_it_intersects() -> None:
    room, random = shell(), np.random.default_rng(6)
    points = random.uniform((-1.9, 0.1, -1.4), (1.9, 2.5, 1.4), (50, 3))
    directions = random.normal(size=(800, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = np.array([np.isfinite(room.intersect(point, directions)) for point in points])
    np.testing.assert_array_equal(room.blocks(points, directions), expected)
    assert 0.3 < expected.mean() < 0.95


def test_shell_knows_where_its_walls_are_not() -> None:
    room = shell()
    points = np.array([(0, 1, 1.5), (-0.5, 2.6, 0), (1, 2.6, 0), (0, 0, 0)])
    np.testing.assert_array_equal(room.absent(points), [True, True, False, False])
