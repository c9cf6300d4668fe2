"""The volume's colours as a camera sees them, against the float64 twin and a painted wall."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from protocol.frames import CameraModel
from server.opencl.engine import Engine
from server.volume.raycast import Surface
from server.volume.view_colors import view_colors
from server.volume.volume import Volume
from tests.reference.view_colors import view_colors as twin
from tests.scenes.painted_walls import paint
from tests.scenes.solids import download4, float4
from tests.scenes.volumes import allocate_everywhere

VOXEL_M = 0.02
SIZE = 5 * 8
CAMERA = CameraModel(width=37, height=29, fx=30.0, fy=30.0, cx=18.0, cy=14.0)


def looked_at(
    engine: Engine, points: np.ndarray, is_surface: np.ndarray, volume: Volume, camera: CameraModel
) -> np.ndarray:
    positions = engine.workspace.upload("test_positions", float4(points, is_surface.astype(np.float32)))
    return download4(engine, view_colors(engine, camera, Surface(positions, positions, positions), volume))


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_colors_match_twin(engine: Engine, share: float) -> None:
    """Within the quantisation of colours (8 or 9 bits of a root) and float32 rounding."""
    rng = np.random.default_rng(3)
    volume = Volume(engine, (0, 0, 0, *[SIZE * VOXEL_M] * 3), VOXEL_M)
    allocate_everywhere(volume)
    colors = rng.random((SIZE, SIZE, SIZE, 3))
    has_color = rng.random((SIZE, SIZE, SIZE)) < share
    paint(engine, volume, colors, has_color)
    points = rng.uniform(-0.01, SIZE * VOXEL_M + 0.01, (CAMERA.height, CAMERA.width, 3))
    is_surface = rng.random(points.shape[:2]) < 0.9
    found = looked_at(engine, points, is_surface, volume, CAMERA)
    expected = twin(points.astype(np.float32).reshape(-1, 3).astype(float), colors, has_color, VOXEL_M)
    expected = np.where(is_surface[..., None], expected.reshape(*points.shape[:2], 4), 0.0)
    np.testing.assert_allclose(found, expected, atol=6e-3)
    assert (found[..., 3] > 0).any() == (share > 0)


def test_bricks_that_are_not_there_have_no_colour(engine: Engine) -> None:
    volume = Volume(engine, (0, 0, 0, *[SIZE * VOXEL_M] * 3), VOXEL_M)
    camera = replace(CAMERA, width=8, height=8)
    points = np.full((8, 8, 3), 0.4)
    assert not looked_at(engine, points, np.ones((8, 8), bool), volume, camera).any()
