"""Readers of data-set folders: every layout, and every way in which one can be damaged."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from client.errors import SourceError
from client.options.source import open_source
from tests.client import folders
from tests.data import data_folder

LAYOUTS = {
    "seven_scenes": folders.seven_scenes,
    "redwood": folders.redwood,
    "tum": folders.tum,
    "ground_truth": folders.ground_truth,
}


def error_of(spec: object, index: int = 0) -> str:
    """The one line with which opening, or reading a frame, is refused."""
    with pytest.raises(SourceError) as caught:
        open_source(str(spec))[index]
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_gives_its_frames(layout: str, tmp_path: Path) -> None:
    source = open_source(str(LAYOUTS[layout](tmp_path / layout)))
    assert len(source) == 3
    assert source.name == layout
    assert source.has_poses
    for index in (0, 2):
        frame = source[index]
        expected_depth = folders.depth_of(index)
        expected_depth[1, 1] = 0  # 65535 is a mark, not a distance
        assert frame.index == index
        np.testing.assert_array_equal(frame.depth, expected_depth)
        assert frame.depth.dtype == np.uint16
        np.testing.assert_allclose(frame.world_from_camera, folders.pose_of(index), atol=1e-6)
        tolerance = 6 if layout == "redwood" else 0  # JPEG
        difference = np.abs(frame.color.astype(int) - folders.color_of(index))
        assert np.median(difference) <= tolerance
        assert difference.max() <= 3 * tolerance


@pytest.mark.parametrize("layout", LAYOUTS)
def test_frames_count_from_the_end_too(layout: str, tmp_path: Path) -> None:
    source = open_source(str(LAYOUTS[layout](tmp_path / layout)))
    assert source[-1].index == 2
    with pytest.raises(IndexError):
        source[3]


def test_cameras(tmp_path: Path) -> None:
    for name, make in LAYOUTS.items():
        camera = open_source(str(make(tmp_path / name))).camera
        assert (camera.width, camera.height) == (32, 24)
        if name == "tum":  # the set's own calibration of freiburg1
            assert (camera.fx, camera.fy, camera.cx, camera.cy) == (517.3, 516.5, 318.6, 255.3)
            assert camera.distortion == (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
            assert camera.depth_scale_m == 1 / 5000
        else:
            assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30, 31, 15.5, 11.5)
            assert not camera.is_distorted
            assert camera.depth_scale_m == (0.0005 if name == "ground_truth" else 0.001)


def test_up_and_rate(tmp_path: Path) -> None:
    truth = open_source(str(folders.ground_truth(tmp_path / "g")))
    assert truth.up == (0.0, -1.0, 0.0)
    assert truth.fps == pytest.approx(25)
    tum = open_source(str(folders.tum(tmp_path / "t")))
    assert tum.up is None
    assert tum.fps == pytest.approx(10)


def test_seven_scenes_without_a_data_folder_and_without_intrinsics(tmp_path: Path) -> None:
    folder = folders.seven_scenes(tmp_path / "flat", inner=".")
    (folder / "camera-intrinsics.txt").unlink()
    camera = open_source(str(folder)).camera
    assert (camera.fx, camera.cx, camera.cy) == (585, 16, 12)


def test_tum_takes_the_nearest_in_time(tmp_path: Path) -> None:
    folder = folders.tum(tmp_path / "t")
    (folder / "depth.txt").write_text("100.105 depth/1.png\n100.119 depth/2.png\n100.25 depth/0.png\n")
    source = open_source(str(folder))
    assert len(source) == 1  # the second depth is nearer to no picture, the third is too far from all
    assert source[0].timestamp_s == pytest.approx(100.1)
    assert source[0].depth[5, 5] == folders.depth_of(1)[5, 5]


def test_tum_calibration_beside_the_lists(tmp_path: Path) -> None:
    folder = folders.tum(tmp_path / "t")
    (folder / "calibration.txt").write_text("30 31 15.5 11.5\n")
    camera = open_source(str(folder)).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.is_distorted) == (30, 31, 15.5, 11.5, False)
    (folder / "calibration.txt").write_text("30 31 15.5\n")
    assert "calibration.txt" in error_of(folder)


def test_without_poses(tmp_path: Path) -> None:
    for file in (folders.seven_scenes(tmp_path / "s") / "data").glob("*.pose.txt"):
        file.unlink()
    (folders.redwood(tmp_path / "r") / "trajectory.log").unlink()
    (folders.tum(tmp_path / "t") / "groundtruth.txt").unlink()
    for name in "srt":
        source = open_source(str(tmp_path / name))
        assert not source.has_poses
        assert source[1].world_from_camera is None


def test_linear_pictures_keep_sixteen_bits(tmp_path: Path) -> None:
    source = open_source(str(folders.ground_truth(tmp_path / "g", encoding="linear16")))
    assert source.camera.color_encoding == "linear16"
    np.testing.assert_array_equal(source[1].color, folders.color_of(1, np.uint16))


def test_unknown_folder_says_what_was_looked_for(tmp_path: Path) -> None:
    text = error_of(tmp_path)
    for word in ("meta.json", "rgb.txt", "frame-NNNNNN", "camera_primesense.json", str(tmp_path)):
        assert word in text


def test_nothing_there(tmp_path: Path) -> None:
    assert "no such folder" in error_of(tmp_path / "nowhere")
    assert "OAK" in error_of("oak")


@pytest.mark.parametrize("keep", [0, 60, 300])
def test_truncated_picture_is_named(keep: int, tmp_path: Path) -> None:
    folder = folders.seven_scenes(tmp_path / "s")
    file = folder / "data" / "frame-000001.color.png"
    file.write_bytes(file.read_bytes()[:keep])
    assert "frame-000001.color.png" in error_of(folder, 1)


def test_truncated_jpeg_is_named(tmp_path: Path) -> None:
    folder = folders.redwood(tmp_path / "r")
    file = folder / "color" / "00002.jpg"
    data = file.read_bytes()
    file.write_bytes(data[: len(data) * 2 // 3])
    assert "00002.jpg" in error_of(folder, 2)
    assert "truncated" in error_of(folder, 2)


def test_damaged_png_is_named(tmp_path: Path) -> None:
    folder = folders.redwood(tmp_path / "r")
    file = folder / "depth" / "00001.png"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 0x55
    file.write_bytes(bytes(data))
    assert "00001.png" in error_of(folder, 1)


def test_picture_that_is_none(tmp_path: Path) -> None:
    folder = folders.redwood(tmp_path / "r")
    (folder / "depth" / "00001.png").write_text("hello")
    assert "neither a PNG nor a JPEG" in error_of(folder, 1)


def test_depth_of_eight_bits(tmp_path: Path) -> None:
    folder = folders.redwood(tmp_path / "r")
    folders.write_picture(folder / "depth" / "00001.png", folders.depth_of(1).astype(np.uint8))
    assert "16 bits" in error_of(folder, 1)


def test_sizes_that_differ_are_not_resized(tmp_path: Path) -> None:
    folder = folders.redwood(tmp_path / "r")
    folders.write_picture(folder / "color" / "00001.jpg", folders.color_of(1)[:, :16])
    assert "16x24" in error_of(folder, 1)
    folders.write_picture(folder / "depth" / "00001.png", folders.depth_of(1)[:, :16])
    assert "the camera is 32x24" in error_of(folder, 1)


@pytest.mark.parametrize(
    ("entry", "value", "words"),
    [((0, 0), np.nan, "NaN"), ((0, 0), 1.1, "rotation"), ((1, 1), -1.0, "rotation"), ((3, 3), 2.0, "last row")],
)
def test_pose_that_is_none(entry: tuple[int, int], value: float, words: str, tmp_path: Path) -> None:
    folder = folders.seven_scenes(tmp_path / "s")
    pose = folders.pose_of(0)
    pose[entry] = value
    np.savetxt(folder / "data" / "frame-000001.pose.txt", pose)
    text = error_of(folder, 1)
    assert "frame-000001.pose.txt" in text
    assert words in text


def test_text_in_place_of_a_pose(tmp_path: Path) -> None:
    folder = folders.seven_scenes(tmp_path / "s")
    (folder / "data" / "frame-000001.pose.txt").write_text("1 0 0 zero")
    assert "'zero' is not a number" in error_of(folder, 1)


def test_missing_pose_is_named(tmp_path: Path) -> None:
    folder = folders.seven_scenes(tmp_path / "s")
    (folder / "data" / "frame-000001.pose.txt").unlink()
    assert "frame-000001.pose.txt" in error_of(folder)


def test_trajectory_that_is_too_short(tmp_path: Path) -> None:
    folder = folders.redwood(tmp_path / "r")
    lines = (folder / "trajectory.log").read_text().splitlines()
    (folder / "trajectory.log").write_text("\n".join(lines[:10]))
    assert "no pose for frame 2" in error_of(folder)
    (folder / "trajectory.log").write_text("\n".join(lines[:12]))
    assert "blocks of 5 lines" in error_of(folder)


def test_quaternion_of_length_zero(tmp_path: Path) -> None:
    folder = folders.tum(tmp_path / "t")
    (folder / "groundtruth.txt").write_text("100.0 0 0 0 0 0 0 0\n")
    assert "groundtruth.txt, line 1" in error_of(folder)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("camera", {"width": 32}, "camera needs"),
        ("color_encoding", "srgb16", "color_encoding"),
        ("depth", "../nowhere", "missing"),
        ("frames", 7, "picture 000003"),
        ("frames", 0, "positive"),
        ("up", [0, 0, 0], "up must be"),
        ("exposures", [1.0, 2.0], "exposures must be 3 numbers"),
        ("exposures", [1.0, "2", 3.0], "exposures must be"),
        ("exposures", [1.0, True, 3.0], "exposures must be"),
        ("exposures", 1.0, "exposures must be"),
        ("exposures", [1, 10**400, 1], "no float holds"),
        ("depth_scale_m", -1, "depth_scale_m"),
        ("poses", "none.txt", "none.txt"),
    ],
)
def test_meta_with_a_wrong_entry(key: str, value: object, words: str, tmp_path: Path) -> None:
    folder = folders.ground_truth(tmp_path / "g")
    meta = json.loads((folder / "meta.json").read_text())
    (folder / "meta.json").write_text(json.dumps(meta | {key: value}))
    assert words in error_of(folder)


def test_exposures_of_a_set(tmp_path: Path) -> None:
    """As its meta.json lists them; without a list linear pictures are of one exposure, others of an unknown one."""
    for name, encoding, without in (("g", "srgb8", None), ("l", "linear16", 1.0)):
        folder = folders.ground_truth(tmp_path / name / "set", encoding=encoding)
        source = open_source(str(folder))
        assert [source[i].exposure for i in range(3)] == [without] * 3
        meta = json.loads((folder / "meta.json").read_text())
        (folder / "meta.json").write_text(json.dumps(meta | {"exposures": [2, None, 0.5]}))
        source = open_source(str(folder))
        assert [source[i].exposure for i in range(3)] == [2.0, None, 0.5]


def with_camera(folder: Path, **more: object) -> Path:
    """The folder, with more said of its camera."""
    meta = json.loads((folder / "meta.json").read_text())
    meta["camera"] |= more
    (folder / "meta.json").write_text(json.dumps(meta))
    return folder


def test_meta_with_a_depth_lens(tmp_path: Path) -> None:
    matrix = [1, 0, 0, 0.05, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    lens = {"width": 16, "height": 12, "fx": 15.0, "fy": 15.5, "cx": 7.5, "cy": 5.5, "color_from_depth": matrix}
    folder = with_camera(folders.ground_truth(tmp_path / "g"), distortion=[0.1, 0, 0, 0, 0], depth=lens)
    for i in range(3):
        folders.write_picture(tmp_path / "shared_depth" / f"{i:06d}.png", np.full((12, 16), 500 + i, np.uint16))
    source = open_source(str(folder))
    assert source.camera.distortion == (0.1, 0, 0, 0, 0)
    assert source.camera.depth is not None
    assert source.camera.color_from_depth[0, 3] == 0.05
    assert source[1].depth.shape == (12, 16)
    assert source[1].color.shape == (folders.HEIGHT, folders.WIDTH, 3)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"distortion": [0.1, 0, 0, 0]}, "of length 5, got 4"),
        ({"depth": {"width": 16}}, "missing required field"),
        ({"depth": {"width": 16, "height": 12, "fx": 15, "fy": 15, "cx": 7, "cy": 5, "scale": 2}}, "unknown field"),
        ({"depth": {"width": 16, "height": 12, "fx": -15, "fy": 15, "cx": 7, "cy": 5}}, "camera.depth.fx"),
        ({"depth": {"width": 16, "height": 13, "fx": 15, "fy": 15, "cx": 7, "cy": 5}}, "the depth lens is 16x13"),
    ],
)
def test_meta_with_a_wrong_lens(more: dict[str, object], words: str, tmp_path: Path) -> None:
    assert words in error_of(with_camera(folders.ground_truth(tmp_path / "g"), **more))


def test_meta_that_is_no_json(tmp_path: Path) -> None:
    folder = folders.ground_truth(tmp_path / "g")
    (folder / "meta.json").write_text('{"camera": ')
    assert "is not JSON" in error_of(folder)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "count", "focal", "encoding"),
    [
        ("rgbd_7scenes_redkitchen", 200, 585.0, "srgb8"),
        ("rgbd_livingroom1_synth", 211, 525.0, "srgb8"),
        ("rgbd_redwood5", 5, 525.0, "srgb8"),
        ("mitsuba_track_clean", 100, 525.0, "srgb8"),
        ("mitsuba_track_noisy", 100, 525.0, "srgb8"),
        ("mitsuba_room/key_white_direct", 6, 262.5, "linear16"),
        ("mitsuba_room/studio_tex_gi", 6, 262.5, "linear16"),
    ],
)
def test_public_sets(name: str, count: int, focal: float, encoding: str) -> None:
    source = open_source(str(data_folder(name)))
    assert (len(source), source.camera.fx, source.camera.color_encoding) == (count, focal, encoding)
    for index in (0, len(source) - 1):
        frame = source[index]
        assert frame.color.shape == (source.camera.height, source.camera.width, 3)
        assert 0.3 < np.median(frame.depth[frame.depth > 0]) * source.camera.depth_scale_m < 5
        assert frame.depth.max() < 65535
        assert frame.world_from_camera is not None


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "step", "limit_m"), [("rgbd_7scenes_redkitchen", 1, 0.006), ("mitsuba_track_clean", 5, 0.002)]
)
def test_poses_carry_one_frame_onto_another(name: str, step: int, limit_m: float) -> None:
    """Conventions as a whole: depth, intrinsics and world_from_camera agree between two views."""
    source = open_source(str(data_folder(name)))
    first, second = source[10], source[10 + step]
    camera, scale = source.camera, source.camera.depth_scale_m
    v, u = np.mgrid[20 : camera.height - 20 : 7, 20 : camera.width - 20 : 7]
    z = first.depth[v, u] * scale
    v, u, z = (a[z > 0] for a in (v, u, z))
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z, np.ones_like(z)])
    moved = np.linalg.inv(second.world_from_camera) @ first.world_from_camera @ points
    x, y = moved[:2] / moved[2] * [[camera.fx], [camera.fy]] + [[camera.cx], [camera.cy]]
    x, y = x.round().astype(int), y.round().astype(int)
    inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    seen = second.depth[y[inside], x[inside]] * scale
    error = np.abs(seen - moved[2, inside])[seen > 0]
    assert len(error) > 1000
    assert np.median(error) < limit_m


@pytest.mark.data
def test_a_folder_in_no_known_layout() -> None:
    assert "is no data set" in error_of(data_folder("hand_depth_sr305"))
