"""By how much virtual objects change what a point of real surface sends: against the float64 twin."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.frames import CameraModel
from server.input.measure import intrinsics
from server.maths.rigid import inverse_rigid
from server.opencl.engine import Engine, float16, int4
from server.opencl.program import with_headers
from server.opencl.structs import CHANGED_PARAMETERS, struct_text
from tests.reference.changed import Floats, change_at
from tests.scenes.analytic import look_at
from tests.scenes.own_kernel import own_kernel
from tests.scenes.solids import float4

SOURCE = """
#include "changed.clh"
kernel void look_up(const ChangedParameters p, global const float4 *positions, global const float4 *ratio,
                    const int count, global const float4 *points, const float tolerance_m, const int is_nearest,
                    global float *result) {
    const int i = get_global_id(0);
    if (i >= count) return;
    const Changed changed = make_changed(p, positions, ratio);
    const float3 at = points[i].xyz;
    vstore3(is_nearest ? nearest_change(changed, at, tolerance_m) : change_at(changed, at, tolerance_m), i, result);
}
"""
WIDTH, HEIGHT, TOLERANCE_M = 48, 37, 0.03
CAMERA = CameraModel(width=WIDTH, height=HEIGHT, fx=40.0, fy=41.0, cx=23.0, cy=18.5)
VIEW = look_at((0.4, 0.9, 1.4), (0.5, 0.5, 0.2))
"""volume_from_camera."""


def rolling_surface(random: np.random.Generator) -> Floats:
    """[h, w, 4] points that the pixels show, with a step in depth; a tenth shows nothing."""
    row, col = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    depth = 1.2 + 0.1 * np.sin(col / 5) + 0.3 * (row > 20)
    at = np.stack([(col - CAMERA.cx) / CAMERA.fx * depth, (row - CAMERA.cy) / CAMERA.fy * depth, depth], -1)
    points = at @ VIEW[:3, :3].T + VIEW[:3, 3]
    return np.concatenate([points, random.random((HEIGHT, WIDTH, 1)) > 0.1], -1)


@pytest.mark.parametrize("is_nearest", [False, True])
@pytest.mark.parametrize("stride", [1, 4, 5])
def test_as_the_twin(engine: Engine, stride: int, is_nearest: bool) -> None:
    """Points on what pixels show, off it by some centimetres, behind the camera and outside the picture."""
    random = np.random.default_rng(stride)
    positions, cells = rolling_surface(random), (HEIGHT // stride, WIDTH // stride)
    ratio = np.concatenate([random.uniform(0.2, 1.0, (*cells, 3)), random.random((*cells, 1)) > 0.1], -1)
    near = positions.reshape(-1, 4)[random.integers(0, WIDTH * HEIGHT, 3000), :3] + random.normal(0, 0.03, (3000, 3))
    points = np.concatenate([near, random.uniform(-2, 3, (500, 3))]).astype(np.float32).astype(float)
    kernel = own_kernel(engine.device, struct_text() + with_headers(SOURCE, "look_up.cl"), "look_up")
    space = engine.workspace
    result = space.array("test_result", (len(points), 3), np.float32)
    engine.launch(
        kernel,
        (len(points),),
        CHANGED_PARAMETERS(
            camera_from_volume=float16(inverse_rigid(VIEW)),
            intrinsics=intrinsics(CAMERA),
            grid=int4(cells[1], cells[0], stride, WIDTH),
        ),
        space.upload("test_positions", float4(positions[..., :3], positions[..., 3])),
        space.upload("test_ratio", float4(ratio[..., :3], ratio[..., 3])),
        len(points),
        space.upload("test_points", float4(points)),
        TOLERANCE_M,
        int(is_nearest),
        result,
    )
    exact = positions.astype(np.float32).astype(float), ratio.astype(np.float32).astype(float)
    twin = change_at(CAMERA, inverse_rigid(VIEW), *exact, stride, points, TOLERANCE_M, is_nearest=is_nearest)
    apart = np.abs(engine.download(result) - twin).max(axis=1)
    assert 0.3 < (twin != 1).any(axis=1).mean() < 0.95
    assert (apart > 1e-4).mean() < 0.002  # a sample at the limit of what is near enough
