"""Several calibrated cameras into one volume: the order of their pictures is no matter, within stated bounds."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from server.opencl.device import Device
from tests.bench.geometry.interleaving import NOISE, VOXEL_M, fuse_in_order, orders, stations
from tests.bench.truth.rooms import LIVING_ROOM

Floats = NDArray[np.float64]
FEW, MANY = 4, 30
"""Pictures of each of three cameras: fewer and more than the 64 that a voxel's mean remembers."""


def depths(device: Device, pictures: int, noise: float) -> list[list[Floats]]:
    return [fuse_in_order(device, stations(), order, noise) for order in orders(pictures).values()]


def test_the_cameras_differ_and_see_each_others_surface() -> None:
    placed = stations()
    assert len({(s.camera.width, s.camera.fx) for s in placed}) == 3
    assert len({tuple(s.world_from_camera[:3, 2]) for s in placed}) == 3


@pytest.mark.parametrize("noise", [0.0, NOISE])
def test_below_saturation_the_order_is_no_matter(device: Device, noise: float) -> None:
    """A mean of few enough pictures has no order: what is left is rounding, and what late bricks have not seen."""
    for camera, found in enumerate(zip(*depths(device, FEW, noise), strict=True)):
        stack = np.stack(found)
        seen = (stack > 0).all(0)
        assert seen.mean() > 0.6  # the volume ends below the ceiling
        assert ((stack > 0).any(0) & ~seen).mean() < 1e-4  # seen: 0
        spread = np.ptp(stack, axis=0)[seen] / VOXEL_M
        assert np.quantile(spread, 0.99) < 1e-4  # seen: 0
        assert (spread > 0.1).mean() < 1e-4  # seen: 0
        true = LIVING_ROOM.depth_m(stations()[camera].camera, stations()[camera].world_from_camera)
        assert np.median(np.abs(stack - true)[:, seen]) < (0.2 if noise else 0.02) * VOXEL_M


def test_a_mean_that_forgets_depends_a_little_on_the_order(device: Device) -> None:
    """90 pictures, of which a voxel remembers 64: 99 % of pixels within 0.15 voxels over all orders."""
    for found in zip(*depths(device, MANY, NOISE), strict=True):
        stack = np.stack(found)
        seen = (stack > 0).all(0)
        spread = np.ptp(stack, axis=0)[seen] / VOXEL_M
        assert spread.max() > 0
        assert np.median(spread) < 0.015  # seen: 0.006
        assert np.quantile(spread, 0.99) < 0.08  # seen: 0.033
        assert (spread > 1).mean() < 5e-4  # edges, seen past or not


def test_a_camera_beside_its_place_does_not_destroy_what_others_see(device: Device) -> None:
    """2 cm off, 1.3 voxels: the surface is a compromise, not gone."""
    order = orders(10)["ABCABC"]
    right = fuse_in_order(device, stations(), order, 0.0)[0]
    wrong = fuse_in_order(device, stations(offset_m=0.02), order, 0.0)[0]
    both = (right > 0) & (wrong > 0)
    assert both.mean() > 0.99 * (right > 0).mean()
    moved = np.abs(right - wrong)[both] / VOXEL_M
    assert 0.02 < np.median(moved) < 0.5
    assert np.quantile(moved, 0.99) < 1.0
