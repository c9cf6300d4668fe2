"""The visibility state of voxels and its validation cameras (thesis 6.1.2)."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.engine import Engine
from server.transfer.radiance_transfer import Transfer, direction_sets, transfer_radiance
from server.transfer.visibility_state import LEAST_OPEN, VisibilityState
from server.volume.raycast import Surface
from server.volume.volume import BRICK, Volume
from tests.scenes.analytic import look_at
from tests.scenes.solids import Scene, ball, download4, fill_volume, floor, signed_distances
from tests.scenes.volumes import fill, seen_surface

VOXEL_M = 0.02
REACH_M = 0.1
CAMERA = CameraModel(width=93, height=62, fx=80.0, fy=80.0, cx=47.5, cy=31.5)
VIEW = look_at((0.3, 0.75, 0.1), (0.5, 0.1, 0.5))
UP = np.array([0.0, 1.0, 0.0])
SCENE: Scene = (floor(0.11), ball((0.5, 0.21, 0.5), 0.1))  # no surface on the border of two voxels


def surface_of(engine: Engine, volume: Volume) -> Surface:
    return seen_surface(engine, volume, CAMERA, VIEW)


def transfer_of(engine: Engine, volume: Volume, surface: Surface, state: VisibilityState | None) -> Transfer:
    return transfer_radiance(engine, CAMERA, volume, surface, 4, direction_sets(81, 4), REACH_M, None, state)


def open_voxels(engine: Engine, state: VisibilityState, volume: Volume) -> NDArray[np.bool_]:
    """[z, y, x]."""
    bits = np.unpackbits(engine.download(state.bits).view(np.uint8), bitorder="little")
    return bits.reshape([BRICK * n for n in volume.bricks[::-1]]).astype(bool)


def voxels_of(surface: Surface, engine: Engine) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """[rows, cols, 3] the voxel (x, y, z) of each sample, and whether there is surface."""
    points = download4(engine, surface.positions)[2::4, 2::4].astype(float)
    return (points[..., :3] / VOXEL_M).astype(int), points[..., 3] > 0


def change(engine: Engine, volume: Volume, scene: Scene) -> None:
    signed_m = signed_distances(scene, volume)
    fill(engine, volume, np.clip(signed_m / volume.truncation_m, -1, 1), signed_m > -volume.truncation_m)


def test_voxels_are_open_where_all_their_samples_are(engine: Engine) -> None:
    volume = fill_volume(engine, SCENE, VOXEL_M)
    state = VisibilityState(engine, volume, CAMERA, UP)
    surface = surface_of(engine, volume)
    transfer = transfer_of(engine, volume, surface, None)
    state.learn(surface, CAMERA, 4, transfer.openness)
    openness = engine.download(transfer.openness)
    voxels, here = voxels_of(surface, engine)
    here &= openness >= 0
    expected = np.zeros_like(open_voxels(engine, state, volume))
    for value, which in ((True, openness >= LEAST_OPEN), (False, here & (openness < LEAST_OPEN))):
        x, y, z = voxels[which & here].T
        expected[z, y, x] = value
    assert 50 < expected.sum() < here.sum()
    np.testing.assert_array_equal(open_voxels(engine, state, volume), expected)


def test_open_voxels_need_no_rays_and_others_are_as_before(engine: Engine) -> None:
    """What is known to be open shades as open; its error is at most what LEAST_OPEN allows."""
    volume = fill_volume(engine, SCENE, VOXEL_M)
    state = VisibilityState(engine, volume, CAMERA, UP)
    surface = surface_of(engine, volume)
    before = engine.download(transfer_of(engine, volume, surface, state).openness).copy()
    state.learn(surface, CAMERA, 4, transfer_of(engine, volume, surface, state).openness)
    everywhere = np.ones([BRICK * n for n in volume.bricks[::-1]])
    fill(engine, volume, -everywhere, everywhere)  # unannounced: all rays would now be blocked
    after = engine.download(transfer_of(engine, volume, surface, state).openness)
    voxels, here = voxels_of(surface, engine)
    x, y, z = voxels.reshape(-1, 3).clip(0, 47).T
    known = open_voxels(engine, state, volume)[z, y, x].reshape(here.shape) & here
    assert known.sum() > 50
    np.testing.assert_array_equal(after[known], 1.0)
    assert (before[known] >= LEAST_OPEN).all()
    np.testing.assert_array_equal(after[here & ~known], 0.0)


def test_nothing_changes_nothing(engine: Engine) -> None:
    volume = fill_volume(engine, SCENE, VOXEL_M)
    state = VisibilityState(engine, volume, CAMERA, UP)
    for step in range(4):
        stale = state.validate(look_at((0.3 + 0.02 * step, 0.75, 0.1), (0.5, 0.1, 0.5)), REACH_M)
        assert not stale.any()


@pytest.mark.parametrize("ray_length_m", [0.1, 1000.0])
def test_a_change_forgets_what_is_in_reach(engine: Engine, ray_length_m: float) -> None:
    """A ball comes and goes: voxels that a ray connects with it are forgotten, those far away are kept."""
    volume = fill_volume(engine, (floor(0.11),), VOXEL_M)
    state = VisibilityState(engine, volume, CAMERA, UP)
    surface = surface_of(engine, volume)
    state.validate(VIEW, ray_length_m)
    state.learn(surface, CAMERA, 4, transfer_of(engine, volume, surface, state).openness)
    known = open_voxels(engine, state, volume)
    assert known.sum() > 100
    body = ball((0.5, 0.16, 0.5), 0.06)
    for scene in ((floor(0.11), body), (floor(0.11),)):
        change(engine, volume, scene)
        stale = state.validate(VIEW, ray_length_m)
        assert stale.any()
        left = open_voxels(engine, state, volume)
        z, y, x = np.nonzero(known)
        points = (np.stack([x, y, z], -1) + 0.5) * VOXEL_M
        near = body.distance(points) < ray_length_m - 2 * VOXEL_M
        assert near.sum() > 10
        assert not left[z, y, x][near].any()
        forgotten = stale.repeat(BRICK, 0).repeat(BRICK, 1).repeat(BRICK, 2)
        np.testing.assert_array_equal(left, known & ~forgotten)
        assert left.any() == (ray_length_m < 1)
        state.learn(surface, CAMERA, 4, transfer_of(engine, volume, surface, state).openness)


def test_a_volume_too_large_is_refused(engine: Engine) -> None:
    volume = Volume(engine, (0.0, 0.0, 0.0, 6.0, 6.0, 6.0), 0.008)
    with pytest.raises(ValueError, match="voxel"):
        VisibilityState(engine, volume, CAMERA, UP)
