"""The stage set: its geometry against triangles, its light against brute force, its looks, and its guests."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from client.errors import SourceError
from client.synthetic.lighting.harmonics import basis, sphere_directions
from client.synthetic.scenes.appearance import APPEARANCES, StageSurface, along_surface
from client.synthetic.scenes.guests import GUESTS
from client.synthetic.solids.polyhedra import Polyhedron, Solid
from client.synthetic.solids.round import Cylinder
from client.synthetic.solids.tessellate import TOLERANCE_M, triangles_of
from client.synthetic.source import SyntheticSource, open_synthetic

ROUND = 360
"""Frames of one walk around."""


@cache
def stage(more: str = "") -> SyntheticSource:
    return open_synthetic(f"synthetic:stage?size=96x72&frames={ROUND}{more}")


def rays_of(source: SyntheticSource, index: int) -> tuple[np.ndarray, np.ndarray]:
    """The camera's place, and [h, w, 3] rays whose lengths are depths."""
    camera, pose = source.camera, source.pose(index)
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
    return pose[:3, 3], rays @ pose[:3, :3].T


def first_hits(
    vertices: np.ndarray, faces: np.ndarray, origin: np.ndarray, rays: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Moeller and Trumbore's test of [n, 3] rays with all triangles: [n] distance (inf: none), and its triangle."""
    a = vertices[faces[:, 0]]
    ab, ac = vertices[faces[:, 1]] - a, vertices[faces[:, 2]] - a
    start = origin - a
    q = np.cross(start, ab)
    up = (ac * q).sum(axis=1)
    distance, owner = np.full(len(rays), np.inf), np.zeros(len(rays), int)
    for k, ray in enumerate(rays):
        p = np.cross(ray, ac)
        determinant = (ab * p).sum(axis=1)
        inverse = 1 / np.where(np.abs(determinant) < 1e-15, np.inf, determinant)
        u, v, t = (start * p).sum(axis=1) * inverse, q @ ray * inverse, up * inverse
        hit = (u > -1e-9) & (v > -1e-9) & (u + v < 1 + 1e-9) & (t > 1e-6)
        if hit.any():
            nearest = np.where(hit, t, np.inf).argmin()
            distance[k], owner[k] = t[nearest], nearest
    return distance, owner


@pytest.mark.parametrize("index", [0, 130, 250])
def test_geometry_is_that_of_its_triangles(index: int) -> None:
    source = stage("&with=ball")
    mesh = triangles_of([*source.scene.solids, *(guest.solid for guest in source.guests)])
    truth, (origin, rays) = source.truth(index), rays_of(source, index)
    chosen = np.random.default_rng(index).choice(truth.depth_m.size, 250, replace=False)
    exact, rays = truth.depth_m.ravel()[chosen], rays.reshape(-1, 3)[chosen]
    distance, owner = first_hits(mesh.vertices, mesh.faces, origin, rays)
    seen = exact > 0
    assert np.mean(seen != np.isfinite(distance)) < 0.01  # outlines of round things
    both = seen & np.isfinite(distance)
    assert both.sum() > 60
    slope = np.abs((truth.normals.reshape(-1, 3)[chosen] * rays).sum(axis=1))
    error_m = np.abs(exact - distance)[both] * slope[both]  # across the surface
    assert np.mean(error_m < 2 * TOLERANCE_M) > 0.97
    assert np.median(error_m) < 1e-6
    a, b, c = (mesh.vertices[mesh.faces[owner[both], k]] for k in range(3))
    flat = np.cross(b - a, c - a)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    cosine = (flat * truth.normals.reshape(-1, 3)[chosen][both]).sum(axis=1)
    assert np.mean(cosine > np.cos(np.radians(5))) > 0.97  # outwards, and nowhere far off


def test_triangles_lie_on_the_surfaces_and_are_closed() -> None:
    solids = [*stage().scene.solids, *(guest.solid for guest in GUESTS["both"])]
    for solid in solids:
        mesh = triangles_of([solid])
        np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-9)
        a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
        middle = (a + b + c) / 3
        outward = np.cross(b - a, c - a)
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        assert not solid.contains(middle + 2 * TOLERANCE_M * outward).any()
        assert solid.contains(middle - 2 * TOLERANCE_M * outward).all()
        # The integral of the position through a closed surface is three times its volume, wherever the origin is.
        area = np.cross(b - a, c - a)
        volume = (area * middle).sum() / 6
        assert (area * (middle + 10)).sum() / 6 == pytest.approx(volume, rel=1e-9)
        assert volume > 0


def test_normals_by_finite_differences() -> None:
    source = open_synthetic(f"synthetic:stage?size=320x240&frames={ROUND}")
    truth, (origin, rays) = source.truth(40), rays_of(source, 40)
    points = origin + truth.depth_m[..., None].astype(float) * rays
    here = points[1:-1, 1:-1]
    across = [points[1:-1, 2:] - here, points[2:, 1:-1] - here]
    same = np.ones(here.shape[:2], bool)
    for shifted in (truth.normals[1:-1, 2:], truth.normals[2:, 1:-1]):
        same &= (np.abs(shifted - truth.normals[1:-1, 1:-1]).max(axis=-1) < 1e-6) & truth.visible[1:-1, 1:-1]
    normals = np.cross(across[1], across[0])
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    cosine = (normals * truth.normals[1:-1, 1:-1]).sum(axis=-1)[same]
    assert same.sum() > 10_000
    assert np.mean(cosine > np.cos(np.radians(0.1))) > 0.97  # the rest: two faces of the same direction


def light_by_force(solids: list[Solid], point: np.ndarray, normal: np.ndarray, sh: np.ndarray) -> np.ndarray:
    """[3] light arriving over pi at a point: rays lifted off the surface, through every solid, its own too."""
    directions = sphere_directions(8000)
    above = directions[directions @ normal > 0]
    nearest = np.min([solid.intersect(point + 2e-5 * normal, above) for solid in solids], axis=0)
    seen = above[np.isinf(nearest)]
    return (basis(seen) * (seen @ normal)[:, None]).sum(axis=0) * 4 / len(directions) @ sh


def shading_errors(source: SyntheticSource, index: int, chosen: np.ndarray) -> np.ndarray:
    """Relative error of the light arriving at pixels [n]."""
    truth, (origin, rays) = source.truth(index), rays_of(source, index)
    solids = [*source.scene.solids, *(guest.solid for guest in source.guests)]
    points = (origin + truth.depth_m[..., None].astype(float) * rays).reshape(-1, 3)
    got = (truth.radiance / np.maximum(truth.albedo, 1e-9)).reshape(-1, 3)
    normals = truth.normals.reshape(-1, 3).astype(float)
    errors = []
    for pixel in chosen:
        expected = light_by_force(solids, points[pixel], normals[pixel], truth.sh)
        errors.append(np.abs(got[pixel] - expected).max() / max(expected.max(), 0.05))
    return np.array(errors)


@pytest.mark.parametrize(("light", "index"), [(1, 20), (5, 200)])
def test_shading_against_brute_force(light: int, index: int) -> None:
    source = stage(f"&light={light}")
    visible = np.flatnonzero(source.truth(index).visible)
    errors = shading_errors(source, index, np.random.default_rng(index).choice(visible, 60, replace=False))
    assert np.median(errors) < 0.006  # of which the brute force's own noise is the most
    assert np.percentile(errors, 90) < 0.04


def test_shading_on_and_around_the_ball_against_brute_force() -> None:
    source, bare = stage("&with=ball&light=7"), stage("&light=7")
    truth, before = source.truth(10), bare.truth(10)
    on_ball = np.flatnonzero(truth.guest)
    darker = np.flatnonzero(((before.radiance - truth.radiance).max(axis=-1) > 0.03) & ~truth.guest)
    random = np.random.default_rng(0)
    for pixels in (on_ball, darker):
        errors = shading_errors(source, 10, random.choice(pixels, 20, replace=False))
        assert np.median(errors) < 0.01
        assert np.percentile(errors, 90) < 0.06


def test_the_gate_lets_light_through_and_shadows() -> None:
    """In the passage the sky is seen through both openings; the vault above it and the legs take the rest."""
    source = stage()
    solids = source.scene.solids
    site = np.array([-0.1, 1e-5, 0.03])
    along, up = np.array([np.sin(np.radians(28)), 0, np.cos(np.radians(28))]), np.array([0, 1.0, 0])
    slanting = along + 0.6 * up
    crosswise = np.cross(up, along)
    blocked = np.isfinite(
        np.min(
            [s.intersect(site, np.array([up, along + 0.02 * up, crosswise + 0.3 * up, slanting])) for s in solids], 0
        )
    )
    assert list(blocked[:3]) == [True, False, True]
    within = light_by_force(solids, site, up, source.truth(0).sh).max()
    beside = light_by_force(solids, np.array([0.02, 1e-5, 0.2]), up, source.truth(0).sh).max()
    assert 0.05 < within / beside < 0.6


@pytest.mark.parametrize("look", APPEARANCES)
def test_a_look_changes_colours_and_nothing_else(look: str) -> None:
    plain, covered = stage().truth(70), stage(f"&texture={look}").truth(70)
    np.testing.assert_array_equal(plain.depth_m, covered.depth_m)
    np.testing.assert_array_equal(plain.normals, covered.normals)
    np.testing.assert_array_equal(plain.sh, covered.sh)
    seen = plain.visible
    albedo = covered.albedo[seen]
    assert albedo.min() > 0.02
    assert albedo.max() <= 0.8
    if look != "paper":
        assert np.abs(albedo - plain.albedo[seen]).max() > 0.3
        assert albedo.std() > 0.1
    light = (plain.radiance / np.maximum(plain.albedo, 1e-9))[seen]
    np.testing.assert_allclose((covered.radiance / np.maximum(covered.albedo, 1e-9))[seen], light, rtol=1e-6)


def test_patterns_keep_their_size_along_every_surface() -> None:
    """A short way along a wall, a roof or around a column is as long in the pattern's coordinates."""
    random = np.random.default_rng(0)
    source, compared = stage(), 0
    for solid in [body.solid for body in source.scene.bodies if isinstance(body.solid, Polyhedron | Cylinder)]:
        covering = StageSurface("wall", 1, solid, np.eye(3))
        start = np.array([0.6, 1.0, 0.9])
        directions = solid.bounds[0] + random.normal(0, 0.3 * solid.bounds[1], (40, 3)) - start
        t = solid.intersect(start, directions)
        points = (start + t[:, None] * directions)[np.isfinite(t)]
        normals = solid.normals(points)
        step = np.cross(normals, random.normal(size=normals.shape))
        step *= 1e-6 / np.linalg.norm(step, axis=1, keepdims=True)
        here, there = (np.stack(along_surface(covering, p)) for p in (points - step / 2, points + step / 2))
        np.testing.assert_allclose(np.linalg.norm(there - here, axis=0), 1e-6, rtol=1e-3)
        compared += len(points)
    assert compared > 500


def test_looks_are_as_they_are_called() -> None:
    albedo = {look: (truth := stage(f"&texture={look}").truth(70)).albedo[truth.visible] for look in APPEARANCES}
    assert np.ptp(albedo["paper"]) == 0
    saturation = {look: np.median(np.ptp(a, axis=1) / a.max(axis=1)) for look, a in albedo.items()}
    assert saturation["market"] > 0.5 > saturation["brick"] > saturation["checker"] - 1e-9
    dark, bright = np.percentile(albedo["checker"], (10, 90))
    assert bright / dark > 8


@pytest.mark.parametrize("look", APPEARANCES)
def test_nothing_clips(look: str) -> None:
    for light in (0, 3, 6):
        for index in (0, 180):
            radiance = stage(f"&texture={look}&light={light}").truth(index).radiance
            assert radiance.max() < 1
            assert radiance.min() >= 0


def test_same_frame_same_bytes_whatever_came_before() -> None:
    one, other = (open_synthetic("synthetic:stage?size=64x48&texture=town&with=ball") for _ in range(2))
    for index in (3, 40, 17):
        one[index]
    np.testing.assert_array_equal(one[25].color, other[25].color)
    np.testing.assert_array_equal(one[25].depth, other[25].depth)


def test_the_camera_walks_around_or_stands() -> None:
    poses = np.array([stage().pose(index) for index in range(ROUND)])
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert 0.005 < steps.min() <= steps.max() < 0.05
    azimuths = np.unwrap(np.arctan2(poses[:, 0, 3], poses[:, 2, 3]))
    assert azimuths[-1] - azimuths[0] == pytest.approx(2 * np.pi, rel=0.01)
    still = stage("&still=1")
    np.testing.assert_array_equal(still.pose(0), still.pose(300))
    np.testing.assert_array_equal(still.pose(0), stage().pose(0))


def test_everything_stands_in_the_picture_all_the_way() -> None:
    for index in range(0, ROUND, 45):
        visible = stage().truth(index).visible
        assert 0.2 < visible.mean() < 0.7
        assert not visible[0].any()


@pytest.mark.parametrize("index", [0, 200])
def test_a_guest_changes_only_what_it_touches(index: int) -> None:
    bare, with_ball = stage("&texture=town").truth(index), stage("&texture=town&with=ball").truth(index)
    elsewhere = ~with_ball.guest
    assert not bare.guest.any()
    np.testing.assert_array_equal(bare.depth_m[elsewhere], with_ball.depth_m[elsewhere])
    np.testing.assert_array_equal(bare.albedo[elsewhere], with_ball.albedo[elsewhere])
    taken = (bare.radiance - with_ball.radiance)[elsewhere]
    assert taken.min() > -1e-12  # a shadow only takes light away, but for the last bits of its sums
    assert taken.max() > (0.1 if index == 0 else 0.005)
    untouched = (np.abs(taken) < 1e-12).all(axis=1)
    assert untouched.mean() > 0.3
    if index == 0:
        (ball,) = GUESTS["ball"]
        np.testing.assert_allclose(with_ball.albedo[with_ball.guest], np.tile(ball.albedo, (with_ball.guest.sum(), 1)))
        assert (with_ball.depth_m[with_ball.guest] < bare.depth_m[with_ball.guest]).all()


def test_guests_stand_on_the_ground_clear_of_the_buildings() -> None:
    solids = stage().scene.solids
    for guest in GUESTS["both"]:
        mesh = triangles_of([guest.solid])
        assert mesh.vertices[:, 1].min() == pytest.approx(0, abs=1e-12)
        assert not any(solid.contains(mesh.vertices).any() for solid in solids)


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("texture=moon", "paper"),
        ("texture=1", "market"),
        ("with=cat", "ball"),
        ("still=2", "0 to 1"),
        ("way=1", "with"),
    ],
)
def test_wrong_specs(query: str, words: str) -> None:
    with pytest.raises(SourceError, match=words):
        open_synthetic(f"synthetic:stage?{query}")


def test_other_scenes_have_no_guests() -> None:
    with pytest.raises(SourceError, match="'with'"):
        open_synthetic("synthetic:table?with=ball")
