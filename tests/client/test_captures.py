"""Captures of other programs: poses, depth, intrinsics and times against the synthetic scene they were written from."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from client.errors import SourceError
from client.options.source import open_source
from client.sources.files.ros_pictures import color_of, depth_of, is_color, is_depth
from client.sources.frame_source import Source
from tests.client import captures
from tests.client.captures import UNSURE, Scene
from tests.client.ros_bags import ros_bag

COUNT = 3
FORMATS: dict[str, Callable[[Path, Scene], Path]] = {
    "plain": captures.plain,
    "plain_opengl": lambda path, scene: captures.plain(path, scene, camera_axes="opengl"),
    "stray": captures.stray,
    "arkit_scenes": captures.arkit_scenes,
    "record3d.r3d": captures.record3d,
    "scannet.sens": captures.scannet,
    "scannet_two_lenses.sens": lambda path, scene: captures.scannet(path, scene, shift_m=0.05),
    "ros_mcap": ros_bag,
    "ros_sqlite": lambda path, scene: ros_bag(path, scene, storage="sqlite3", path="odometry", depth="32FC1"),
}
FULL_DEPTH = {"arkit_scenes", "ros_mcap", "ros_sqlite"}
SURE = {"scannet.sens", "scannet_two_lenses.sens", "ros_mcap", "ros_sqlite"}
LOSSY = {"stray": 12, "record3d.r3d": 6, "scannet.sens": 6, "scannet_two_lenses.sens": 6}
"""Format -> accepted median difference of colour by its codec."""
LIBRARIES = {"record3d": "imagecodecs", "ros": "rosbags"}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(COUNT)


def written(name: str, folder: Path, scene: Scene) -> Path:
    """The capture, written with its library, which is an extra."""
    for start, library in LIBRARIES.items():
        if name.startswith(start):
            pytest.importorskip(library)
    return FORMATS[name](folder / name, scene)


def error_of(path: Path, index: int = 0) -> str:
    with pytest.raises(SourceError) as caught:
        open_source(str(path))[index]
    assert "\n" not in str(caught.value)
    return str(caught.value)


def points_in_world(source: Source, index: int) -> tuple[np.ndarray, np.ndarray]:
    """([n, 3] metres, [n] pixel numbers) by the source's own intrinsics and pose."""
    frame, camera = source[index], source.camera
    lens = camera.depth_lens
    v, u = np.nonzero(frame.depth)
    z = frame.depth[v, u] * camera.depth_scale_m
    points = np.stack([(u - lens.cx) / lens.fx * z, (v - lens.cy) / lens.fy * z, z, np.ones_like(z)])
    world = frame.world_from_camera @ camera.color_from_depth @ points
    return world[:3].T, v * lens.width + u


@pytest.mark.parametrize("name", FORMATS)
def test_a_capture_is_the_scene_it_was_written_from(name: str, tmp_path: Path, scene: Scene) -> None:
    source = open_source(str(written(name, tmp_path, scene)))
    assert len(source) == COUNT
    assert source.has_poses
    # ARKitScenes' names have whole milliseconds: up to 1 ms in the 67 ms of three frames.
    assert source.fps == pytest.approx(30, rel=0.015 if name == "arkit_scenes" else 1e-3)
    camera = source.camera
    for field in ("width", "height", "fx", "fy", "cx", "cy"):
        assert getattr(camera, field) == pytest.approx(getattr(scene.camera, field), abs=1e-4), field
    for i in (2, 0, 1):
        frame = source[i]
        assert frame.index == i
        assert frame.timestamp_s == pytest.approx(scene.times_s[i], abs=5.1e-4 if name == "arkit_scenes" else 1e-6)
        np.testing.assert_allclose(frame.world_from_camera, scene.pose(i), atol=2e-6)
        apart = np.abs(frame.color.astype(int) - scene.frames[i].color)
        assert np.median(apart) <= LOSSY.get(name, 0)
        expected = (scene.frames[i].depth if name in FULL_DEPTH else scene.small_depth(i)).copy()
        if name not in SURE:
            assert expected[UNSURE].any()
            expected[UNSURE] = 0
        np.testing.assert_array_equal(frame.depth, expected)


@pytest.mark.parametrize("name", ["plain", "stray", "record3d.r3d", "scannet.sens"])
def test_a_smaller_depth_has_the_lens_of_the_picture(name: str, tmp_path: Path, scene: Scene) -> None:
    """The lens has the picture's field of view: pixel 0 of depth covers pixels 0 and 1 of colour."""
    lens = open_source(str(written(name, tmp_path, scene))).camera.depth_lens
    assert (lens.width, lens.height) == (scene.camera.width // 2, scene.camera.height // 2)
    assert lens.fx == pytest.approx(scene.camera.fx / 2, abs=1e-4)
    left_edge = (-0.5 - lens.cx) / lens.fx
    assert left_edge == pytest.approx((-0.5 - scene.camera.cx) / scene.camera.fx, abs=1e-6)


def test_points_of_two_lenses_stand_where_the_scene_is(tmp_path: Path, scene: Scene) -> None:
    """The pose of ScanNet is the depth camera's; with colour 5 cm beside it the surface stays where it is."""
    together = open_source(str(captures.scannet(tmp_path / "a.sens", scene)))
    apart = open_source(str(captures.scannet(tmp_path / "b.sens", scene, shift_m=0.05)))
    first, pixels = points_in_world(together, 1)
    second, same = points_in_world(apart, 1)
    np.testing.assert_array_equal(pixels, same)
    np.testing.assert_allclose(second - first, np.tile(scene.pose(1)[:3, 0] * 0.05, (len(first), 1)), atol=1e-5)


def test_large_colour_is_reduced_with_its_intrinsics(tmp_path: Path, scene: Scene) -> None:
    folder = captures.plain(tmp_path / "p", scene)
    values = json.loads((folder / "intrinsics.json").read_text())
    for i, frame in enumerate(scene.frames):
        captures.png(folder / "color" / f"{i:06d}.png", np.kron(frame.color, np.ones((10, 10, 1), np.uint8)))
    large = {k: values[k] * 10 for k in ("width", "height", "fx", "fy")}
    large |= {k: (values[k] + 0.5) * 10 - 0.5 for k in ("cx", "cy")}
    (folder / "intrinsics.json").write_text(json.dumps(values | large))
    source = open_source(str(folder))
    assert (source.camera.width, source.camera.height) == (640, 480)
    assert source.camera.fx == pytest.approx(scene.camera.fx * 5)
    assert source.camera.cx == pytest.approx((scene.camera.cx + 0.5) * 5 - 0.5)
    np.testing.assert_array_equal(source[0].color[2::5, 2::5], scene.frames[0].color)


def test_frames_without_a_pose_are_left_out_and_said(
    tmp_path: Path, scene: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    source = open_source(str(captures.scannet(tmp_path / "s.sens", scene, lost=[1])))
    assert len(source) == COUNT - 1
    np.testing.assert_allclose(source[1].world_from_camera, scene.pose(2), atol=2e-6)
    assert "tracking was lost in 1 of 3 frames" in capsys.readouterr().err


def test_poses_between_two_are_interpolated(tmp_path: Path, scene: Scene) -> None:
    folder = captures.arkit_scenes(tmp_path / "a", scene)
    lines = (folder / "lowres_wide.traj").read_text().splitlines()
    (folder / "lowres_wide.traj").write_text("\n".join([lines[0], lines[2]]))
    source = open_source(str(folder))
    assert len(source) == COUNT
    np.testing.assert_allclose(source[1].world_from_camera, scene.pose(1), atol=1e-3)
    (folder / "lowres_wide.traj").write_text(lines[1])
    assert len(open_source(str(folder))) == 1


def test_a_bag_says_what_it_took(tmp_path: Path, scene: Scene, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rosbags")
    bag = ros_bag(tmp_path / "bag", scene)
    open_source(str(bag))
    said = capsys.readouterr().err
    assert "colour /camera/color/image_raw, depth /camera/aligned_depth_to_color/image_raw" in said
    assert "odom > base_link > camera_color_optical_frame (/tf, /tf_static)" in said
    alone = open_source(str(next(bag.glob("*.mcap"))))
    np.testing.assert_allclose(alone[1].world_from_camera, scene.pose(1), atol=2e-6)


def test_a_bag_is_read_on_any_thread(tmp_path: Path, scene: Scene) -> None:
    """As `stream` does; SQLite refuses other threads than the one that opened the file."""
    pytest.importorskip("rosbags")
    source = open_source(str(ros_bag(tmp_path / "bag", scene, storage="sqlite3")))
    with ThreadPoolExecutor(2) as threads:
        for i, frame in enumerate(threads.map(source.__getitem__, range(COUNT))):
            np.testing.assert_array_equal(frame.depth, scene.frames[i].depth)


def test_a_bag_without_a_path_is_tracked(tmp_path: Path, scene: Scene) -> None:
    pytest.importorskip("rosbags")
    source = open_source(str(ros_bag(tmp_path / "bag", scene, path="none")))
    assert len(source) == COUNT
    assert not source.has_poses
    assert source.up is None


def test_a_rectified_picture_has_the_projection_and_a_raw_one_the_distortion(tmp_path: Path, scene: Scene) -> None:
    pytest.importorskip("rosbags")
    rectified = open_source(str(ros_bag(tmp_path / "a", scene, picture="image_rect_color", distortion=0.1))).camera
    assert not rectified.is_distorted
    assert rectified.fx == pytest.approx(scene.camera.fx)
    raw = open_source(str(ros_bag(tmp_path / "b", scene, distortion=0.1))).camera
    assert raw.distortion == (0.1, 0, 0, 0, 0)
    assert raw.fx == pytest.approx(scene.camera.fx + 0.9)


def test_compressed_pictures_of_ros(scene: Scene) -> None:
    """A JPEG, and the PNG behind twelve bytes of compressed_depth_image_transport."""
    frame = scene.frames[0]
    color = SimpleNamespace(
        format="rgb8; jpeg compressed bgr8", data=np.frombuffer(captures.jpeg(frame.color), np.uint8)
    )
    packed = bytes(12) + cv2.imencode(".png", frame.depth)[1].tobytes()
    depth = SimpleNamespace(format="16UC1; compressedDepth png", data=np.frombuffer(packed, np.uint8))
    assert (is_color(color), is_depth(color), is_color(depth), is_depth(depth)) == (True, False, False, True)
    assert np.median(np.abs(color_of(color, "colour").astype(int) - frame.color)) <= 6
    np.testing.assert_array_equal(depth_of(depth, "depth"), frame.depth)
    with pytest.raises(SourceError, match="no PNG of 16 bits"):
        depth_of(SimpleNamespace(format="16UC1; compressedDepth", data=np.zeros(40, np.uint8)), "depth")


def test_what_a_bag_lacks_is_said(tmp_path: Path, scene: Scene) -> None:
    pytest.importorskip("rosbags")
    assert "has no camera_info" in error_of(ros_bag(tmp_path / "a", scene, info=False))
    assert "not aligned to colour" in error_of(ros_bag(tmp_path / "b", scene, depth_frame="camera_depth_optical_frame"))


@pytest.mark.parametrize(("name", "library"), [("r.r3d", "imagecodecs"), ("b.mcap", "rosbags")])
def test_without_the_extra_one_line_says_what_installs_it(
    name: str, library: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = "record3d" if library == "imagecodecs" else "ros_bag"
    monkeypatch.setattr(f"client.sources.files.{module}.find_spec", lambda _name: None)
    file = tmp_path / name
    if name.endswith("r3d"):
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr("metadata", "{}")
    else:
        file.write_bytes(b"\x89MCAP0\r\n" + bytes(64))
    assert f"make install-import, or pip install {library}" in error_of(file)


def test_a_recording_of_an_azure_kinect_is_told_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "a.mkv").write_bytes(b"\x1aE\xdf\xa3" + bytes(100))
    with pytest.raises(SourceError, match=r"a\.mkv: Matroska, .* convert it to a plain folder"):
        open_source(str(tmp_path / "a.mkv"))


def test_what_is_in_no_format_is_told_what_was_looked_for(tmp_path: Path) -> None:
    file = tmp_path / "movie.bin"
    file.write_bytes(b"hello, this is nothing")
    for word in ("Record3D", "ScanNet", "ROS 2 bag", "stream --record"):
        assert word in error_of(file)
    (tmp_path / "empty").mkdir()
    for word in ("intrinsics.json", "Stray Scanner", "ARKitScenes"):
        assert word in error_of(tmp_path / "empty")


@pytest.mark.parametrize("name", ["record3d.r3d", "scannet.sens", "ros_mcap"])
@pytest.mark.parametrize("part", [0.1, 0.5, 0.9])
def test_a_truncated_file_is_one_line(name: str, part: float, tmp_path: Path, scene: Scene) -> None:
    path = written(name, tmp_path, scene)
    file = next(path.glob("*.mcap")) if path.is_dir() else path
    file.write_bytes(file.read_bytes()[: int(part * file.stat().st_size)])
    assert str(file.name if not path.is_dir() else path) in error_of(path, COUNT - 1)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"fx": "wide"}, "needs the numbers"),
        ({"width": 64}, "64x96"),
        ({"fz": 1}, "'fz' is no field"),
        ({"camera_axes": "maya"}, "opencv or opengl"),
        ({"up": [0, 0, 0]}, "not all zero"),
        ({"color_from_depth": [1, 2]}, "16 numbers"),
        ({"depth_scale_m": -1}, "depth_scale_m"),
    ],
)
def test_intrinsics_with_a_wrong_field(fields: dict[str, object], words: str, tmp_path: Path, scene: Scene) -> None:
    assert words in error_of(captures.plain(tmp_path / "p", scene, **fields))
