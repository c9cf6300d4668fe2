"""Vectorised kernels give the same with eight neighbours a work-item (processors) and with one (GPUs)."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.volume.volume import Volume
from tests.scenes.analytic import look, look_at, room, sphere
from tests.scenes.fused_scenes import CAMERA
from tests.scenes.lanes import Narrow, Wide
from tests.scenes.volumes import cast, fuse

SCENE = [room((-0.9, -0.9, -0.3), (0.95, 0.9, 2.2)), sphere((0.1, 0.2, 1.2), 0.4)]
VIEWS = [np.eye(4), look_at((0.4, -0.3, -0.2), (-0.2, 0.2, 1.4)), look_at((0.3, 0.2, 0.1), (-0.3, -0.2, 1.9))]


def reconstruct(engine: Engine) -> tuple[Volume, tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]]:
    volume = Volume(engine, (-1.0, -1.0, 0.0, 1.0, 1.0, 2.4), 0.04)
    color = np.random.default_rng(1).random((CAMERA.height, CAMERA.width, 3))
    for view in VIEWS:
        fuse(engine, volume, CAMERA, view, look(SCENE, CAMERA, view).depth_m, color)
    return volume, cast(engine, volume, CAMERA, look_at((0.2, -0.1, -0.1), (-0.1, 0.1, 1.4)))


def test_one_lane_and_eight_agree(device: Device) -> None:
    engines = Narrow(device), Wide(device)
    (narrow, narrow_cast), (wide, wide_cast) = (reconstruct(engine) for engine in engines)
    a, b = narrow.download_bricks(), wide.download_bricks()
    np.testing.assert_array_equal(a.indices, b.indices)
    # The same operations in the same order; compilers may contract some of them into one rounding.
    same = (a.weight == b.weight) & (np.abs(a.tsdf - b.tsdf) < 1e-5)
    assert same.mean() > 0.9999
    assert (np.abs(a.colors - b.colors) < 0.01).mean() > 0.999
    np.testing.assert_array_equal(engines[0].download(narrow.solid), engines[1].download(wide.solid))
    used = [np.sort(slots[slots > 0]) for slots in (engines[0].download(v.slots_device) for v in (narrow, wide))]
    np.testing.assert_array_equal(*used)
    np.testing.assert_array_equal(*(v.octets.get()[used[0]] for v in (narrow, wide)))
    (hits, depth, normals), (wide_hits, wide_depth, wide_normals) = narrow_cast, wide_cast
    assert hits.mean() > 0.5
    assert (hits == wide_hits).mean() > 0.999
    both = hits & wide_hits
    assert np.quantile(np.abs(depth - wide_depth)[both], 0.999) < 1e-5
    assert np.quantile(np.abs(normals - wide_normals)[both], 0.999) < 1e-4
    for engine in engines:
        engine.close()


@pytest.mark.parametrize("width", [8, 9, 15, 16, 17])
def test_pictures_whose_rows_lanes_do_not_fill(device: Device, width: int) -> None:
    camera = CameraModel(width=width, height=11, fx=12.0, fy=12.0, cx=width / 2, cy=5.0)
    found = []
    for kind in (Narrow, Wide):
        engine = kind(device)
        volume = Volume(engine, (-1.0, -1.0, 0.0, 1.0, 1.0, 2.4), 0.04)
        fuse(engine, volume, camera, np.eye(4), look(SCENE, camera, np.eye(4)).depth_m)
        found.append(cast(engine, volume, camera, np.eye(4)))
        engine.close()
    np.testing.assert_array_equal(found[0][0], found[1][0])
    np.testing.assert_allclose(found[0][1], found[1][1], atol=1e-5)
