"""The default volume: around what is seen, the same every time."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from client.errors import SourceError
from client.sources.volume import MARGIN_M, default_volume, default_voxel
from protocol.frames import CameraModel, DepthCamera, RgbdFrame

CAMERA = CameraModel(width=64, height=48, fx=50, fy=50, cx=31.5, cy=23.5)


@dataclass
class Wall:
    """A wall at `depth_m` before a camera that moves 1 m to the right a frame."""

    depth_m: float = 2.0
    has_poses: bool = True
    name: str = "wall"
    camera: CameraModel = CAMERA
    fps: float = 30.0
    up: None = None
    read: list[int] = field(default_factory=list)

    def __len__(self) -> int:
        return 100

    def __getitem__(self, index: int) -> RgbdFrame:
        self.read.append(index)
        pose = np.eye(4)
        pose[0, 3] = index
        depth = np.full((48, 64), round(self.depth_m * 1000), np.uint16)
        color = np.zeros((48, 64, 3), np.uint8)
        return RgbdFrame(index, index / 30, color, depth, pose if self.has_poses else None)


def test_wall_of_one_frame() -> None:
    x0, y0, z0, x1, y1, z1 = default_volume(Wall(), range(1))
    half_width, half_height = 2 * 31.5 / 50, 2 * 23.5 / 50
    assert (x0, x1) == pytest.approx((-half_width - MARGIN_M, half_width + MARGIN_M), abs=0.13)  # 1 % cut, coarse steps
    assert (y0, y1) == pytest.approx((-half_height - MARGIN_M, half_height + MARGIN_M), abs=0.13)
    assert (z0, z1) == pytest.approx((1.75, 2.25), abs=1e-9)  # flat: as thick as the smallest volume


def test_camera_that_looks_along_x() -> None:
    class Turned(Wall):
        def __getitem__(self, index: int) -> RgbdFrame:
            frame = super().__getitem__(index)
            frame.world_from_camera[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # z of the camera is x of the world
            return frame

    straight, turned = default_volume(Wall(), range(1)), default_volume(Turned(), range(1))
    assert (turned[0], turned[3]) == (straight[2], straight[5])
    assert (turned[1], turned[4]) == (straight[1], straight[4])
    assert (turned[2], turned[5]) == pytest.approx((-straight[3], -straight[0]), abs=1e-9)


def test_depth_of_another_lens_lies_where_that_lens_sees_it() -> None:
    aside = (1.0, 0.0, 0.0, 0.5, 0.0, 1.0, 0.0, -0.25, 0.0, 0.0, 1.0, 0.125, 0.0, 0.0, 0.0, 1.0)
    lens = DepthCamera(width=64, height=48, fx=50, fy=50, cx=31.5, cy=23.5, color_from_depth=aside)
    color = CameraModel(width=640, height=480, fx=700, fy=700, cx=300, cy=200, depth=lens)
    moved = np.array(default_volume(Wall(), range(1))) + np.tile((0.5, -0.25, 0.125), 2)
    assert default_volume(Wall(camera=color), range(1)) == pytest.approx(moved, abs=1e-3)


def test_frames_are_spread_and_counted() -> None:
    wall = Wall()
    volume = default_volume(wall, range(10, 60))
    assert len(wall.read) == 12
    assert (wall.read[0], wall.read[-1]) == (10, 59)
    assert volume[0] > 8
    assert volume[3] < 61
    assert volume == default_volume(Wall(), range(10, 60))


def test_without_poses_only_the_first_frame_counts() -> None:
    wall = Wall(has_poses=False)
    assert default_volume(wall, range(10, 60)) == default_volume(Wall(), range(1))
    assert wall.read == [10]


def test_far_depth_is_not_trusted() -> None:
    with pytest.raises(SourceError, match="no depth within 5 m"):
        default_volume(Wall(depth_m=6.0), range(3))


@pytest.mark.parametrize(
    ("side_m", "voxel_m"), [(0.5, 0.004), (1.024, 0.004), (1.03, 0.0045), (2.0, 0.008), (2.56, 0.01), (2.5601, 0.0105)]
)
def test_voxel_is_rounded_up_to_half_millimetres(side_m: float, voxel_m: float) -> None:
    assert default_voxel((0.0, 0.0, 0.0, 0.3, side_m, 0.4)) == voxel_m
