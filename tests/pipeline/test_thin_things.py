"""Rods of two and three pixels before a wall: the hybrid geometry buffer keeps them, in the same frame."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from server.opencl.device import Device
from tests.bench.truth.rods import EYE_M, ROD_Z_M, SIZE_M, RodsBefore, measure_rods, thickness_m
from tests.bench.truth.rooms import CAMERA

QVGA = msgspec.structs.replace(CAMERA, width=320, height=240, fx=262.5, fy=262.5, cx=159.5, cy=119.5)
VOXEL_M = 0.02
BRIGHT = (2.0, False)
"""Two pixels wide, told from the wall by the picture."""
AS_THE_WALL = (3.0, True)
"""As bright as the wall: of its 5 x 5 neighbours, D'' then needs three columns of the rod to keep it (eq. 4.4)."""


def rods(width_px: float, same_color: bool, speed_m: float) -> RodsBefore:
    return RodsBefore(thickness_m(width_px, QVGA), QVGA, speed_m, same_color, frames=13)


def test_the_rods_are_as_wide_as_said() -> None:
    source = rods(2.0, False, 0.0)
    on_rods = source.on_rods(0)  # upright there, in the middle of the picture's height
    assert on_rods[120].sum() == pytest.approx(4 * 2, abs=4)
    assert source.depth_m(0)[120][on_rods[120]].min() == pytest.approx(ROD_Z_M - EYE_M[2])
    assert np.median(source.depth_m(0)) == pytest.approx(SIZE_M[2] - EYE_M[2])
    assert (source[0].color[on_rods].mean() - source[0].color[~on_rods].mean()) > 50
    assert not np.array_equal(rods(2.0, False, 0.03).on_rods(9), source.on_rods(9))


@pytest.mark.parametrize(("width_px", "same_color"), [BRIGHT, AS_THE_WALL])
def test_rods_that_stand(device: Device, width_px: float, same_color: bool) -> None:
    """The volume's voxels are wider than the rods, and fatten them."""
    found = measure_rods(device, rods(width_px, same_color, 0.0), VOXEL_M, first=10)
    assert min(found.kept["hybrid"]) > 0.98
    assert max(found.added["hybrid"]) < 0.01
    assert min(found.kept["sensor"]) == 1
    assert max(found.kept["plain"]) < 0.95
    assert min(found.added["plain"]) > 0.2


@pytest.mark.parametrize(("width_px", "same_color"), [BRIGHT, AS_THE_WALL])
def test_rods_that_move(device: Device, width_px: float, same_color: bool) -> None:
    """2.5 cm a frame, more than their width: the volume never has them."""
    found = measure_rods(device, rods(width_px, same_color, 0.025), VOXEL_M, first=4)
    assert min(found.kept["hybrid"]) > 0.98
    assert max(found.added["hybrid"]) < 0.01
    assert max(found.kept["plain"]) < 0.01  # seen: 0.0014
