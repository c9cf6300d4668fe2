"""A camera with two lenses through the geometry half of the spine: the surface is where the scene is."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from protocol.frames import RgbdFrame
from protocol.messages import Wishes
from server.geometry.geometry import Geometry
from server.opencl.engine import Engine
from server.volume.bounds import bounds_seen
from tests.scenes.analytic import look
from tests.scenes.lenses import BALL, CAMERA, LENS, ROOM, WORLD_FROM_COLOR, is_seen_by_both, moved, seen_by_depth
from tests.scenes.volumes import vectors

VOXEL_M = 0.02
SCENE = [ROOM, BALL]


def frame() -> RgbdFrame:
    color = np.full((CAMERA.height, CAMERA.width, 3), 120, np.uint8)
    return RgbdFrame(0, 0.0, color, seen_by_depth(CAMERA, SCENE, WORLD_FROM_COLOR), WORLD_FROM_COLOR)


def test_the_surface_is_where_the_scene_is(engine: Engine) -> None:
    wishes = Wishes(volume_m=(-1.7, -1.3, -0.6, 1.7, 1.3, 1.4), voxel_m=VOXEL_M)
    result = Geometry(engine, CAMERA, wishes).scan(frame())
    positions = vectors(engine.download(result.surface.positions))
    truth = look(SCENE, CAMERA, WORLD_FROM_COLOR)
    volume_from_world = result.volume_from_camera @ np.linalg.inv(WORLD_FROM_COLOR)
    expected = truth.points @ volume_from_world[:3, :3].T + volume_from_world[:3, 3]
    inner = is_seen_by_both(CAMERA, SCENE, WORLD_FROM_COLOR) & truth.is_continuous
    assert inner.mean() > 0.5
    assert (positions[inner][:, 3] > 0).mean() > 0.97
    off = np.linalg.norm(positions[..., :3] - expected, axis=-1)[inner & (positions[..., 3] > 0)]
    assert np.median(off) < 0.15 * VOXEL_M
    assert np.percentile(off, 95) < 0.2 * VOXEL_M  # seen: 0.06 voxels


def test_the_default_bounds_hold_what_is_seen() -> None:
    bounds = np.array(bounds_seen(CAMERA, frame(), WORLD_FROM_COLOR))
    truth = look(SCENE, CAMERA, WORLD_FROM_COLOR)
    seen = truth.points[is_seen_by_both(CAMERA, SCENE, WORLD_FROM_COLOR)]
    assert ((seen > bounds[:3]) & (seen < bounds[3:])).all(-1).mean() > 0.97
    assert (bounds[3:] - bounds[:3] < np.ptp(seen, axis=0) + 0.8).all()


def test_the_default_bounds_move_with_the_depth_lens() -> None:
    bounds = [
        np.array(bounds_seen(replace(CAMERA, depth=replace(LENS, color_from_depth=at)), frame(), np.eye(4)))
        for at in (moved((0, 0, 0)), moved((0.5, -0.25, 0.125)))
    ]
    np.testing.assert_allclose(bounds[1] - bounds[0], np.tile((0.5, -0.25, 0.125), 2), atol=1e-6)


def test_depth_of_the_colour_picture_s_size_is_refused(engine: Engine) -> None:
    geometry = Geometry(engine, CAMERA, Wishes())
    wrong = RgbdFrame(0, 0.0, frame().color, np.ones((CAMERA.height, CAMERA.width), np.uint16), WORLD_FROM_COLOR)
    with pytest.raises(ValueError, match="depth 160x120; the camera has 160x120 and 80x60"):
        geometry.scan(wrong)
    with pytest.raises(ValueError, match="depth 80x60; the camera has 160x120 and 160x120"):
        Geometry(engine, replace(CAMERA, depth=None), Wishes()).scan(frame())
