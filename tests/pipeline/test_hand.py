"""A hand put before a room: which of a person's depth is the hand, where it goes, and what counts as its silhouette."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from tests.bench.geometry.hybrid import agreement_m, silhouette
from tests.bench.truth.hand_frames import SEQUENCES, HandBefore, hand_pictures, nearest_part, reproject, skin_picture
from tests.data import data_folder

Floats = NDArray[np.float64]
CAMERA = CameraModel(width=640, height=480, fx=585.0, fy=500.0, cx=320.0, cy=240.0)
HAND_FX, HAND_CX, HAND_CY = 476.007, 313.683, 242.755
HAND = (slice(180, 280), slice(260, 380))
HAND_M, ARM_M, BODY_M, WALL_M = 0.4, 0.45, 0.9, 2.0


def person() -> Floats:
    """Depth as of the hand's camera: a hand in front, a body behind, a knee that the lower edge cuts off."""
    depth_m = np.zeros((480, 640))
    depth_m[100:, 200:500] = BODY_M
    depth_m[HAND] = HAND_M
    depth_m[380:, 100:400] = ARM_M
    depth_m[20:24, 20:24] = HAND_M  # a speck
    return depth_m


@dataclass
class Wall:
    """A grey wall."""

    frames: int = 8
    camera: CameraModel = CAMERA

    def __len__(self) -> int:
        return self.frames

    def __getitem__(self, index: int) -> RgbdFrame:
        depth = np.full((480, 640), round(WALL_M / self.camera.depth_scale_m), np.uint16)
        return RgbdFrame(index, index / 30, np.full((480, 640, 3), 128, np.uint8), depth, np.eye(4))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two pictures of the first sequence, 9 before 10, and one of the second."""
    for name, number, shift in ((SEQUENCES[0], 10, 30), (SEQUENCES[0], 9, 0), (SEQUENCES[1], 0, -30)):
        (tmp_path / name).mkdir(exist_ok=True)
        units = np.roll(np.rint(person() / 0.000125), shift, axis=1).astype(np.uint16)
        assert cv2.imwrite(str(tmp_path / name / f"{number}.png"), units)
    return tmp_path


def test_pictures_are_in_the_order_in_which_they_were_taken(folder: Path) -> None:
    names = [f"{path.parent.name}/{path.stem}" for path in hand_pictures(folder)]
    assert names == [f"{SEQUENCES[0]}/9", f"{SEQUENCES[0]}/10", f"{SEQUENCES[1]}/0"]


def test_the_hand_is_the_nearest_whole_piece() -> None:
    hand_m = nearest_part(person())
    expected = np.zeros_like(hand_m)
    expected[HAND] = HAND_M
    np.testing.assert_array_equal(hand_m, expected)


def test_a_hand_pixel_keeps_its_depth_and_its_direction() -> None:
    depth_m = np.zeros((480, 640))
    depth_m[200:300, 250:350] = 0.37
    moved = reproject(CAMERA, depth_m)
    assert set(np.unique(moved)) == {0.0, 0.37}
    v, u = np.nonzero(moved)
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    half = 0.51 / HAND_FX + 1 / CAMERA.fx  # rounded to a pixel of one camera, seen in pixels of the other
    assert x.min() == pytest.approx((249.5 - HAND_CX) / HAND_FX, abs=half)
    assert x.max() == pytest.approx((349.5 - HAND_CX) / HAND_FX, abs=half)
    assert y.min() == pytest.approx((199.5 - HAND_CY) / HAND_FX, abs=half)
    assert y.max() == pytest.approx((299.5 - HAND_CY) / HAND_FX, abs=half)


def test_the_hand_comes_is_held_and_goes(folder: Path) -> None:
    source = HandBefore(Wall(), folder, first=1, hold=2)
    assert source.frames_with_hand == range(1, 7)
    masks = [source.hand_m(index) > 0 for index in range(8)]
    assert not masks[0].any()
    assert not masks[7].any()
    np.testing.assert_array_equal(masks[1], masks[2])
    assert np.nonzero(masks[3])[1].mean() - np.nonzero(masks[1])[1].mean() == pytest.approx(30 * 585 / HAND_FX, abs=1)
    assert np.nonzero(masks[5])[1].mean() - np.nonzero(masks[1])[1].mean() == pytest.approx(-30 * 585 / HAND_FX, abs=1)
    assert HandBefore(Wall(4), folder, first=1, hold=2).frames_with_hand == range(1, 4)


def test_only_the_hand_is_changed(folder: Path) -> None:
    source, wall = HandBefore(Wall(), folder, first=1), Wall()[1]
    frame, mask = source[1], source.hand_m(1) > 0
    np.testing.assert_array_equal(frame.depth[~mask], wall.depth[~mask])
    np.testing.assert_array_equal(frame.color[~mask], wall.color[~mask])
    assert (frame.depth[mask] == round(HAND_M / CAMERA.depth_scale_m)).all()
    red, green, blue = frame.color[mask].mean(axis=0)
    assert red > green > blue
    np.testing.assert_array_equal(source[1].color, frame.color)  # the same noise each time
    np.testing.assert_array_equal(source[0].depth, wall.depth)


def test_skin_is_shaded_by_its_normals() -> None:
    """The lamp is up and to the left: what faces there is brighter."""
    v, u = np.mgrid[:480, :640]
    mask = (np.abs(u - 320) < 60) & (np.abs(v - 240) < 60)
    for slope in ((u - 320) / 585, (v - 240) / 585):
        shaded = [
            skin_picture(CAMERA, np.where(mask, 0.5 + sign * slope, 0), np.random.default_rng(0))[mask].mean()
            for sign in (-1, 1)
        ]
        assert shaded[0] > shaded[1] + 10


def test_a_worn_hand_has_lost_its_rim_and_casts_a_shadow(folder: Path) -> None:
    """Structured light of a projector 7.5 cm to the right: the shadow lies to the left, in the colour all is there."""
    worn, whole = (HandBefore(Wall(), folder, first=1, worn=flag) for flag in (True, False))
    mask, lost = worn.hand_m(1) > 0, worn[1].depth == 0
    inner = cv2.erode(mask.astype(np.uint8), np.ones((9, 9))) > 0
    assert not (lost & inner).any()
    assert 0.01 < (lost & mask).sum() / mask.sum() < 0.2
    np.testing.assert_allclose(worn[1].color.astype(float), whole[1].color, atol=20)  # but for its noise
    v, u = np.nonzero(lost & ~mask)
    columns = np.nonzero(mask.any(axis=0))[0]
    width_px = 585 * 0.075 * (1 / HAND_M - 1 / WALL_M)
    assert u.max() < columns.min()
    assert columns.min() - u.min() == pytest.approx(width_px, abs=2)
    assert set(v) == set(np.nonzero(mask.any(axis=1))[0])


def test_what_counts_as_the_silhouette() -> None:
    """Hand seen, 1.5 lambda off, lost; beside it the wall, a ghost, one too far away, one where nothing is known."""
    hand_m = np.array([0.5, 0.5, 0.5, 0.0, 0.0, 0.0, 0.0])
    near = agreement_m(np.array(0.5), 0.01)
    seen_m = np.array([0.5 + 0.5 * near, 0.5 + 1.5 * near, 0.0, 2.0, 0.5, 1.5, 0.5])
    without_m = np.array([2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 0.0])
    shown = silhouette(seen_m, without_m, hand_m, 0.01, 0.6)
    assert shown.tolist() == [True, False, False, False, True, False, True]


@pytest.mark.data
def test_every_picture_of_the_data_set_has_a_hand() -> None:
    source = HandBefore(Wall(60), data_folder("hand_depth_sr305"), first=0)
    assert len(source.frames_with_hand) >= 15
    for index in source.frames_with_hand:
        hand_m = source.hand_m(index)
        mask = hand_m > 0
        assert 0.01 < mask.mean() < 0.2, index  # seen: 0.09
        assert np.ptp(hand_m[mask]) < 0.25, index
