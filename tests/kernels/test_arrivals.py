"""What points meet along directions, against the float64 twin, and in a painted room."""

from __future__ import annotations

import numpy as np

from server.light.arrivals import RayGroup, begin_arrivals, trace_arrivals
from server.maths.sh import spherical_fibonacci
from server.opencl.engine import Engine
from server.volume.volume import Volume
from tests.reference.arrivals import trace_arrivals as twin
from tests.scenes.analytic import Floats
from tests.scenes.lanes import KINDS
from tests.scenes.lights import random_directions
from tests.scenes.painted_walls import VOXEL_M, Bools, paint, voxels_of
from tests.scenes.solids import SCENES, SIDE_M, fill_volume, floor, signed_distances
from tests.scenes.volumes import dense_voxels

COUNT, RAYS, SETS = 23, 37, 3  # fill no work-group and no vector
ROUNDING = 4e-3
"""Of a colour in 9, 9 and 8 bits of its root."""


def painted(engine: Engine, name: str, share: float) -> tuple[Volume, Floats, Bools, Bools]:
    """A scene whose voxels have colours of their own, and a share of them none: volume, colours, which have one, and
    which of a third that only another light showed.
    """
    random = np.random.default_rng(3)
    volume = fill_volume(engine, SCENES[name], VOXEL_M)
    colors = (random.integers(1, 256, (*voxels_of(volume), 3)) / 255.0) ** 2
    has_color = random.random(voxels_of(volume)) > share
    is_outdated = random.random(voxels_of(volume)) < 1 / 3
    paint(engine, volume, colors, has_color, is_outdated)
    return volume, colors, has_color, is_outdated


@KINDS
def test_matches_twin(device, kind) -> None:  # type: ignore[no-untyped-def]
    for number, name in enumerate(SCENES):
        engine = kind(device)
        volume, colors, has_color, is_outdated = painted(engine, name, 1 / 3)
        random = np.random.default_rng(number)
        points = random.uniform(0.05, 0.95, (COUNT, 3)) * SIDE_M
        normals = random_directions(COUNT, 4)
        sets = np.stack([spherical_fibonacci(RAYS) @ np.linalg.qr(random.normal(size=(3, 3)))[0] for _ in range(SETS)])
        found = trace_arrivals(engine, volume, RayGroup(points, normals, sets)).astype(np.float64)
        tsdf, weight, _ = dense_voxels(engine, volume)
        expected, facing = twin(
            points, normals, sets[np.arange(COUNT) % SETS], tsdf.astype(np.float64), weight.astype(np.float64),
            colors, has_color, is_outdated, volume.voxel_m, volume.truncation_m,
        )  # fmt: skip
        apart = np.abs(np.abs(found[..., 3]) - np.abs(expected[..., 3])) > 0.02 * volume.voxel_m
        assert apart.mean() < 0.002, name  # rays along the edge of a voxel; seen: 0
        other_side = ~apart & (np.abs(facing) > 0.02) & (np.sign(found[..., 3]) != np.sign(expected[..., 3]))
        assert not other_side.any(), name
        of_other_light = ~apart & ~other_side & (expected[..., 3] < 0) & expected[..., :3].any(axis=-1)
        assert of_other_light.sum() > 20
        both = of_other_light | ~apart & (found[..., 3] > 0) & (expected[..., 3] > 0)
        other_color = np.abs(found[both][:, :3] - expected[both][:, :3]).max(-1) > ROUNDING
        assert both.sum() > 50
        assert other_color.mean() < 0.005, name  # rays that leave a voxel within the walk's last step; seen: 0
        engine.close()


def test_a_point_meets_what_is_there(engine: Engine) -> None:
    """A floor: downwards its colour and distance, upwards nothing, and from below its back."""
    volume = fill_volume(engine, (floor(),), VOXEL_M)
    near = np.abs(signed_distances((floor(),), volume)) < 1.5 * VOXEL_M  # as integrate.cl colours them
    paint(engine, volume, np.full((*voxels_of(volume), 3), 0.25), near)
    middle = SIDE_M / 2
    directions = np.array([[[0.0, -1.0, 0.0], [0.0, 1.0, 0.0], [0.6, -0.8, 0.0]]])
    above = trace_arrivals(engine, volume, RayGroup(np.array([[middle, 0.4, middle]]), None, directions))[0]
    np.testing.assert_allclose(above[0], [0.25, 0.25, 0.25, 0.3], atol=VOXEL_M + 5e-3)
    np.testing.assert_array_equal(above[1], 0.0)
    np.testing.assert_allclose(above[2, 3], 0.3 / 0.8, atol=1.5 * VOXEL_M)
    below = trace_arrivals(engine, volume, RayGroup(np.array([[middle, 0.01, middle]]), None, -directions))[0]
    assert below[0, 3] < 0
    np.testing.assert_array_equal(below[0, :3], 0.0)


def test_directions_below_the_plane_are_skipped(engine: Engine) -> None:
    volume = fill_volume(engine, (floor(),), VOXEL_M)
    paint(engine, volume, np.full((*voxels_of(volume), 3), 0.5))
    point, down = np.array([[SIDE_M / 2, 0.4, SIDE_M / 2]]), np.array([[[0.0, -1.0, 0.0]]])
    assert trace_arrivals(engine, volume, RayGroup(point, np.array([[0.0, 1.0, 0.0]]), down))[0, 0, 3] == 0.0
    assert trace_arrivals(engine, volume, RayGroup(point, np.array([[0.0, -1.0, 0.0]]), down))[0, 0, 3] > 0.0


def test_rays_of_buried_surface_begin_clear_of_it(engine: Engine) -> None:
    """The mean place of bent surface lies behind it: its rays leave it, and do not meet it from its back."""
    volume = fill_volume(engine, (floor(),), VOXEL_M)
    paint(engine, volume, np.full((*voxels_of(volume), 3), 0.5))
    middle, up = SIDE_M / 2, np.array([[0.0, 1.0, 0.0]])
    directions = spherical_fibonacci(RAYS)[None]
    for depth in (0.0, 1.0, 2.0):
        point = np.array([[middle, 0.1 - depth * VOXEL_M, middle]])
        np.testing.assert_array_equal(trace_arrivals(engine, volume, RayGroup(point, up, directions))[..., 3], 0.0)


@KINDS
def test_groups_traced_at_once_are_as_alone(device, kind) -> None:  # type: ignore[no-untyped-def]
    engine = kind(device)
    volume, *_ = painted(engine, next(iter(SCENES)), 1 / 3)
    random = np.random.default_rng(5)
    groups = []
    for count, per_set, sets, on_surface in ((7, 37, 3, True), (COUNT, 1, COUNT, False), (1, 16, 1, False)):
        directions = random_directions(per_set * sets, count).reshape(sets, per_set, 3)
        normals = random_directions(count, 6) if on_surface else None
        groups.append(RayGroup(random.uniform(0.05, 0.95, (count, 3)) * SIDE_M, normals, directions))
    for some in (groups, groups[:2]):
        for group, together in zip(some, begin_arrivals(engine, volume, some).results(), strict=True):
            alone = trace_arrivals(engine, volume, group)
            assert together.shape == (*group.shape, 4)
            np.testing.assert_array_equal(together, alone)
            assert alone.any()
    engine.close()
