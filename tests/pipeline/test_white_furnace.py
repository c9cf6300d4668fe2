"""White furnace: a white open scene under an even sky of radiance 1 shades to 1, in every configuration.

"Shades" is what the pipeline does with a light: the transfer of a sample times the light's coefficients, here those of
the even sky. "Open" is a scene no part of which hides the sky from another: a convex body. With exact geometry, and
reconstructed from depth pictures quantised as a sensor's, where what voxels, normals and rays do wrong would show.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Any, get_args

import numpy as np
import pytest
import trimesh
from scipy import ndimage

from protocol.frames import CameraModel
from protocol.limits import MAX_SH_BANDS
from protocol.messages import Preset, Wishes
from server.client_session import ClientSession
from server.light.light_estimation import LEAST_FLATNESS
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.pipeline import FrameResult
from server.quality.settings import THESIS_REACH_M, WHOLE_ROOM_M
from server.scene.placement import Placement
from server.transfer.radiance_transfer import direction_sets, transfer_radiance
from server.transfer.sampling import PRESETS
from server.volume.raycast import LABEL_STATIC
from tests.scenes.analytic import Shape, plane, sphere
from tests.scenes.furnace import BOUNDS, CAMERA, VOXEL_M, frames, reconstruct
from tests.scenes.lights import random_directions, uniform
from tests.scenes.meshes import shape_of
from tests.scenes.plain_light import PLAIN_LIGHT
from tests.scenes.solids import HalfSpace, ball, fill_volume, points_on, upload_surface

STRIDES = {name: PRESETS[name].stride for name in ("rm", "reg4", "reg8")}
"""Presets that differ in what one frame traces; the others add what earlier frames found."""
BODIES: dict[str, Shape] = {
    "floor": plane((0, 0.2, 1.2), (0.1, -1.0, -0.8)),
    "wall": plane((0, 0, 1.3), (0.45, 0.2, -1.0)),
    "ball": sphere((0, 0, 1.2), 0.4),
}
RAYS, REACHES_M = (81, 169, 32), (WHOLE_ROOM_M, THESIS_REACH_M)


def configurations() -> Iterator[tuple[str, int, int, float]]:
    """Preset, rays, bands, length of rays."""
    for preset, rays, bands, ray_length_m in product(STRIDES, RAYS, range(2, MAX_SH_BANDS + 1), REACHES_M):
        # Every pixel is slow, and bands depend neither on it nor on how far rays go.
        if (STRIDES[preset] > 1 or bands in (2, 4, MAX_SH_BANDS)) and (ray_length_m == WHOLE_ROOM_M or bands == 4):
            yield preset, rays, bands, ray_length_m


@pytest.mark.parametrize("body", BODIES)
def test_reconstructed_scene_shades_to_one(engine: Engine, body: str) -> None:
    volume, surface = reconstruct(engine, BODIES[body])
    static = ndimage.minimum_filter(engine.download(surface.labels) == LABEL_STATIC, 3)  # as the estimator wants it
    assert static.mean() > 0.15
    wrong = {}
    for preset, rays, bands, ray_length_m in configurations():
        stride = STRIDES[preset]
        transfer = transfer_radiance(engine, CAMERA, volume, surface, stride, direction_sets(rays, bands), ray_length_m)
        shaded = engine.download(transfer.coefficients).astype(float) @ uniform(bands=bands)[:, 0]
        error = np.abs(shaded - 1)[static[stride // 2 :: stride, stride // 2 :: stride]]
        flat = engine.download(transfer.flatness)[static[stride // 2 :: stride, stride // 2 :: stride]]
        assert (flat >= LEAST_FLATNESS).sum() > 25
        # Every sample that the light is estimated from, and of the others (outlines) all but one in a hundred.
        if error[flat >= LEAST_FLATNESS].max() > 0.01 or np.quantile(error, 0.99) > 0.01:
            wrong[preset, rays, bands, ray_length_m] = error[flat >= LEAST_FLATNESS].max(), np.quantile(error, 0.99)
    assert not wrong


def test_exact_scene_shades_to_one(engine: Engine) -> None:
    """Exact voxels, points and normals: not 1 % but rounding, at every sample, for walls of any direction and balls."""
    random = np.random.default_rng(2)
    walls = [HalfSpace(random.uniform(0.4, 0.56, 3), normal) for normal in random_directions(4, 3)]
    for solid in (*walls, ball((0.48, 0.5, 0.47), 0.3)):
        volume = fill_volume(engine, (solid,), 0.01)
        points, normals = points_on((solid,), 24 * 24, 4, ((0.1,) * 3, (0.86,) * 3))
        blocks = [np.repeat(np.repeat(a.reshape(24, 24, 3), 4, 0), 4, 1) for a in (points, normals)]
        surface = upload_surface(engine, *blocks, np.ones((96, 96), bool))
        camera = CameraModel(width=96, height=96, fx=90.0, fy=90.0, cx=48.0, cy=48.0)
        for preset, rays, bands, ray_length_m in configurations():
            if STRIDES[preset] == 4:
                transfer = transfer_radiance(
                    engine, camera, volume, surface, 4, direction_sets(rays, bands), ray_length_m
                )
                shaded = engine.download(transfer.coefficients).astype(float) @ uniform(bands=bands)[:, 0]
                np.testing.assert_allclose(shaded, 1.0, rtol=1e-6)


def test_every_preset_that_exists_is_covered() -> None:
    assert set(PRESETS) <= set(get_args(Preset))
    assert set(STRIDES.values()) == {preset.stride for preset in PRESETS.values()}
    assert Wishes().rays in RAYS


@pytest.mark.parametrize("preset", PRESETS)
def test_far_object_changes_no_pixel(device: Device, preset: str) -> None:
    """The whole spine, with an object that neither is seen nor shadows anything: the camera's bytes come back."""
    random = np.random.default_rng(1)
    color = random.integers(60, 220, (CAMERA.height, CAMERA.width, 3), np.uint8)
    asked: Any = {"preset": preset, "plan": "everything"}
    wishes = Wishes(volume_m=BOUNDS, voxel_m=VOXEL_M, ray_length_m=2.0, **asked)
    pipeline = ClientSession(device, CAMERA, wishes)
    pipeline.place_object(
        "far", shape_of(trimesh.creation.icosphere(radius=0.2)), Placement(position_m=(0.0, 5.0, -60.0))
    )
    for frame in frames(BODIES["wall"], color):
        result = pipeline.process(frame)
    pipeline.close()
    assert "shadow_real" in result.plan.run  # it was not spared by the plan
    np.testing.assert_array_equal(result.color, color)


def test_white_scene_tells_the_even_sky(device: Device) -> None:
    """The furnace backwards: a picture that is the same everywhere is explained by an even sky, where one albedo is
    assumed."""
    code = 188  # linear 0.5029: white times the assumed albedo
    pipeline = ClientSession(device, CAMERA, Wishes(volume_m=BOUNDS, voxel_m=VOXEL_M, **PLAIN_LIGHT))
    result: FrameResult | Any = None
    for frame in frames(BODIES["ball"], np.full((CAMERA.height, CAMERA.width, 3), code, np.uint8)):
        result = pipeline.process(replace(frame))
    pipeline.close()
    sh = np.array(result.light.sh)
    np.testing.assert_allclose(sh[0], uniform()[0] * 0.5029 / 0.5, rtol=0.002)  # seen: 0.0007
    assert np.abs(sh[1:]).max() < 0.02 * sh[0].max()
