"""Arches, bowls, roofs and shafts against signed functions of their own, root finding and closed forms."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import brentq

from client.synthetic.lighting.bake import bake
from client.synthetic.lighting.harmonics import sphere_directions
from client.synthetic.solids.carved import Carved
from client.synthetic.solids.charts import atlas
from client.synthetic.solids.polyhedra import Solid, box, rotation_about
from client.synthetic.solids.prisms import frustum, gable
from client.synthetic.solids.round import Cylinder

TURN = rotation_about("y", 30)
FOOT = np.array([0.2, -0.1, 0.3])
UP = np.array([0.0, 1, 0])
MIDDLE = FOOT + 0.2 * UP
BOUNDARY = 1e-7
"""A hit nearer to the surface than this is on it."""


def local(points: np.ndarray) -> np.ndarray:
    return ((points - FOOT) @ TURN).T


def arch_sign(points: np.ndarray) -> np.ndarray:
    x, y, z = local(points)
    block = np.max([np.abs(x) - 0.5, -y, y - 0.5, np.abs(z) - 0.2], axis=0)
    return np.maximum(block, 0.3 - np.hypot(x, y))


def bowl_sign(points: np.ndarray) -> np.ndarray:
    x, y, z = local(points)
    away = np.hypot(x, z)
    return np.maximum(np.max([away - 0.5, -y, y - 0.4], axis=0), -np.maximum(away - 0.35, 0.1 - y))


def gable_sign(points: np.ndarray) -> np.ndarray:
    x, y, z = local(points)
    slope = (y / 0.4 + np.abs(z) / 0.3 - 1) / math.hypot(1 / 0.4, 1 / 0.3)
    return np.max([slope, -y, np.abs(x) - 0.5], axis=0)


def shaft_sign(points: np.ndarray) -> np.ndarray:
    x, y, z = local(points)
    half = (0.4 - 0.25 * y / 0.6) * math.cos(math.pi / 6)
    sides = [x * math.sin(a) + z * math.cos(a) - half for a in np.arange(6) * math.pi / 3]
    return np.max([*sides, -y, y - 0.6], axis=0)


def spire_sign(points: np.ndarray) -> np.ndarray:
    x, y, z = local(points)
    half = 0.4 * (1 - y / 0.6) * math.sqrt(0.5)
    return np.max([np.abs(x) - half, np.abs(z) - half, -y], axis=0)


def _arch() -> Carved:
    middle = FOOT + TURN @ (0, 0.25, 0)
    hole = Cylinder(FOOT - 0.4 * TURN[:, 2], TURN[:, 2], 0.8, 0.3)
    return Carved(box(tuple(middle), (1, 0.5, 0.4), TURN), hole)


def _bowl() -> Carved:
    return Carved(Cylinder(FOOT, UP, 0.4, 0.5), Cylinder(FOOT + 0.1 * UP, UP, 1.0, 0.35))


SOLIDS: dict[str, tuple[Solid, Callable[[np.ndarray], np.ndarray]]] = {
    "arch": (_arch(), arch_sign),
    "bowl": (_bowl(), bowl_sign),
    "gable": (gable(tuple(FOOT), (1, 0.4, 0.6), TURN), gable_sign),
    "shaft": (frustum(tuple(FOOT), 6, (0.4, 0.15), 0.6, TURN), shaft_sign),
    "spire": (frustum(tuple(FOOT), 4, (0.4, 0), 0.6, TURN), spire_sign),
}
EACH = pytest.mark.parametrize("name", SOLIDS)
ORIGINS = {"far": (2.0, 1.2, -1.5), "above": (0.25, 2.0, 0.25), "low": (-1.5, 0.05, 0.4), "within": (0.2, 0.05, 0.3)}


def rays_from(origin: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
    """Directions of many lengths, most of them towards the solids."""
    random = np.random.default_rng(seed)
    targets = MIDDLE + random.normal(0, 0.35, (count, 3))
    return (targets - origin) * random.uniform(0.4, 2, (count, 1))


@EACH
@pytest.mark.parametrize("origin", ["far", "above", "low"])
def test_first_hit_by_root_finding(name: str, origin: str) -> None:
    solid, sign = SOLIDS[name]
    start = np.array(ORIGINS[origin])
    directions = rays_from(start, 150)
    found = solid.intersect(start, directions)
    steps = np.linspace(0, 8, 4001)
    compared = 0
    for direction, t in zip(directions, found, strict=True):
        values = sign(start + steps[:, None] * direction)
        inside = np.flatnonzero(values < -BOUNDARY)
        if not inside.size:
            # The ray may still cut a corner between two steps.
            assert not np.isfinite(t) or sign((start + (t + 1e-3) * direction)[None])[0] > -0.004
            continue
        first = inside[0]
        root = brentq(lambda s, d=direction: float(sign((start + s * d)[None])[0]), steps[first - 1], steps[first])
        assert t <= root + 1e-9
        if t < root - 1e-9:  # a corner that the steps have missed
            assert abs(sign((start + t * direction)[None])[0]) < BOUNDARY
            assert root - t > 1e-4
            continue
        compared += 1
    assert compared > 30


@EACH
def test_hits_are_on_the_surface_with_the_way_to_them_free(name: str) -> None:
    solid, sign = SOLIDS[name]
    for origin in ("far", "above", "low", "within"):
        start = np.array(ORIGINS[origin])
        if sign(start[None])[0] < 0:
            continue
        directions = rays_from(start, 2000, 1)
        t = solid.intersect(start, directions)
        hit = np.isfinite(t)
        np.testing.assert_allclose(sign(start + t[hit, None] * directions[hit]), 0, atol=1e-9)
        along = start + np.linspace(1e-6, 1 - 1e-9, 200)[:, None, None] * np.where(hit, t, 8)[:, None] * directions
        assert sign(along.reshape(-1, 3)).min() > -1e-9


@EACH
def test_normals_by_finite_differences(name: str) -> None:
    solid, sign = SOLIDS[name]
    points = surface_points(solid, 2000)
    step = 1e-6 * np.eye(3)
    slope = np.stack([sign(points + d) - sign(points - d) for d in step], axis=1)
    length = np.linalg.norm(slope, axis=1, keepdims=True)
    # At an edge the two sides of the difference lie on different faces.
    once_more = np.stack([sign(points + 2 * d) - sign(points - 2 * d) for d in step], axis=1) / 2
    smooth = np.abs(once_more - slope).max(axis=1) < 1e-3 * length[:, 0]
    assert smooth.mean() > 0.98
    np.testing.assert_allclose(solid.normals(points)[smooth], (slope / length)[smooth], atol=2e-3)


@EACH
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_blocks_agrees_with_intersect(name: str, dtype: type) -> None:
    solid, sign = SOLIDS[name]
    random = np.random.default_rng(3)
    points = MIDDLE + random.uniform(-0.7, 0.7, (150, 3))
    points = points[sign(points) > 0.01]
    directions = sphere_directions(500)
    blocked = solid.blocks(points.astype(dtype), directions.astype(dtype))
    expected = np.array([np.isfinite(solid.intersect(point, directions)) for point in points])
    assert 0.05 < expected.mean() < 0.9
    assert np.mean(blocked != expected) <= (0 if dtype is np.float64 else 1e-3)


@EACH
def test_contains_and_bounds(name: str) -> None:
    solid, sign = SOLIDS[name]
    points = FOOT + np.random.default_rng(4).uniform(-0.8, 0.8, (20_000, 3))
    inside = sign(points) < 0
    np.testing.assert_array_equal(solid.contains(points), inside)
    center, radius = solid.bounds
    assert np.linalg.norm(points[inside] - center, axis=1).max() <= radius


@EACH
def test_charts_cover_the_surface(name: str) -> None:
    solid, _ = SOLIDS[name]
    points = surface_points(solid, 3000)
    part = solid.part(points)
    assert len(np.unique(part)) >= 5
    for number in np.unique(part):
        here = points[part == number]
        s, t = solid.charts[number].coordinates(here)
        assert min(s.min(), t.min()) > -1e-9
        assert max(s.max(), t.max()) < 1 + 1e-9
        again, normals = solid.charts[number].point(s, t)
        flipped = isinstance(solid, Carved) and solid.inwards(int(number))
        np.testing.assert_allclose(again, here, atol=1e-7)
        np.testing.assert_allclose(-normals if flipped else normals, solid.normals(here), atol=1e-6)
        if isinstance(solid, Carved):
            assert not solid.absent(here, int(number)).any()


def test_a_hole_is_absent_from_the_faces_it_pierces() -> None:
    arch = _arch()
    front = FOOT + np.array([(0, 0.1, 0.2), (0.1, 0.2, 0.2), (0.4, 0.1, 0.2), (0, 0.4, 0.2)]) @ TURN.T
    part = int(arch.part(front[-1:])[0])
    np.testing.assert_array_equal(arch.absent(front, part), [True, True, False, False])


def test_light_at_the_bottom_of_a_bowl_in_closed_form() -> None:
    """From the middle of the bottom the sky is a disc of angular radius a: sin^2 a of the cosine is left of it."""
    bowl = _bowl()
    grids = atlas([bowl.charts], 0.12)  # seven samples across the bottom: one in its middle
    table = bake([bowl], grids, sphere_directions(20_000).astype(np.float32))
    bottom = FOOT + 0.1 * UP
    number = int(bowl.part(bottom[None])[0])
    lost = grids[0][number].interpolate(table, bottom[None])[0]
    sine = math.sin(math.atan2(0.35, 0.3))
    assert lost[0] == pytest.approx(0.2820948 * (1 - sine**2), rel=5e-3)
    cosine = math.sqrt(1 - sine**2)
    assert lost[1] == pytest.approx(0.4886025 * 2 / 3 * cosine**3, rel=5e-3)


def test_the_outside_of_a_bowl_is_not_shadowed_by_it() -> None:
    bowl = _bowl()
    grids = atlas([bowl.charts], 0.1)
    table = bake([bowl], grids, sphere_directions(2000).astype(np.float32))
    side = grids[0][0]
    assert not table[side.offset : side.offset + side.size].any()


def surface_points(solid: Solid, count: int) -> np.ndarray:
    """[n, 3] where rays from all around meet it."""
    random = np.random.default_rng(2)
    points = []
    for origin in ((2.0, 1.2, -1.5), (-1.5, -1.0, 1.0), (0.5, 2.0, 2.0), (0.22, 0.8, 0.28)):
        start = np.array(origin)
        targets = MIDDLE + random.normal(0, 0.3, (count // 4, 3))
        t = solid.intersect(start, targets - start)
        points.append((start + t[:, None] * (targets - start))[np.isfinite(t)])
    return np.concatenate(points)
