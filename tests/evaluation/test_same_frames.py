"""The benchmark of the same frames in other volumes, from other origins and with noise: its counts, and that the
kitchen's light stays."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.frames import RgbdFrame
from server.opencl.device import Device
from tests.bench.light.same_frames import (
    Lights,
    moved_frames,
    moved_volume,
    noisy_frames,
    same_frames_part,
    turns_between,
)
from tests.bench.report.run import Run
from tests.data import data_folder
from tests.scenes.lights import lobe


def lights_along(directions: dict[int, tuple[float, float, float]], spread_deg: float) -> Lights:
    return {index: (lobe(way), spread_deg) for index, way in directions.items()}


def test_turns_are_of_frames_that_both_have_and_shares_of_the_lesser_spread() -> None:
    some = lights_along({0: (0, 0, 1), 1: (0, 0, 1), 2: (0, 1, 0)}, 20.0)
    others = lights_along({1: (0, 0, 1), 2: (0, 1, 1), 3: (1, 0, 0)}, 30.0)
    turns, shares = turns_between([(some, others)])
    assert turns == pytest.approx([0.0, 45.0], abs=1e-4)
    assert shares == pytest.approx([0.0, 45 / 20], abs=1e-4)


def test_noise_is_of_one_code_and_another_in_each_frame() -> None:
    picture = np.full((40, 50, 3), 7, np.uint8)
    picture[0] = 0
    frames = {i: RgbdFrame(i, 0.0, picture, np.zeros((40, 50), np.uint16), None, 1.0) for i in (3, 5)}
    noisy = noisy_frames(frames, 1)
    codes = [noisy[i].color.astype(int) - picture for i in (3, 5)]
    assert all(set(np.unique(change[1:])) == {-1, 0, 1} for change in codes)
    assert all(change[0].min() == 0 for change in codes)
    assert (codes[0] != codes[1]).any()


def test_camera_and_volume_move_together() -> None:
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    frame = RgbdFrame(4, 0.0, np.zeros((2, 3, 3), np.uint8), np.zeros((2, 3), np.uint16), pose, 1.0)
    moved = moved_frames({4: frame}, 0.25)[4]
    assert moved.world_from_camera is not None
    np.testing.assert_array_equal(np.array(moved.world_from_camera)[:3, 3], 0.25)
    np.testing.assert_array_equal(np.array(moved.world_from_camera)[:3, :3], pose[:3, :3])
    assert pose[0, 3] == 0
    assert moved_volume((0.0, 1.0, 2.0, 3.0, 4.0, 5.0), 0.25) == (0.25, 1.25, 2.25, 3.25, 4.25, 5.25)


def test_the_kitchens_light_stays(device: Device) -> None:
    """Volume, origin, voxels, half a voxel, noise, a frame less: by less than its spread, and by few degrees."""
    data_folder("rgbd_7scenes_redkitchen")
    part = same_frames_part(Run(device, quick=True, say=lambda _text: None))
    of_spread = {row.name: row.value for row in part.rows if row.name.endswith("of its spread")}
    turns = {row.name: row.value for row in part.rows if row.name.endswith("light turns by, at most")}
    assert (len(of_spread), len(turns)) == (6, 6)
    assert max(of_spread.values()) < 60, of_spread  # seen: 2 to 43; 236 where lobes had many minima
    frame_less = turns.pop("kitchen, the same frames, a frame left out: light turns by, at most")
    assert frame_less < 5  # seen: 2.9
    shifted = turns.pop("kitchen, the same frames, half a voxel's shift: light turns by, at most")
    assert shifted < 7.5  # seen: 5.4; 8.4 where a solution hung on those before
    moved = turns.pop("kitchen, the same frames, another origin: light turns by, at most")
    assert moved < 11  # seen: 8.3
    assert max(turns.values()) < 6, turns  # seen: 1.8 to 4.4
