"""Everything that a run writes, opened by programs of others: glTF, PLY, HDR, EXR and the trajectory."""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from client.cli import run_command
from client.options.source import open_source
from server.opencl.device import Device
from server.scene.vase import vase_glb
from tests.client.gltf_scenes import cube_glb
from tests.client.gltf_validator import validated

SOURCE = "synthetic:table?size=96x72"
FRAMES = 3


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory, device: Device) -> Path:  # noqa: ARG001
    folder = tmp_path_factory.mktemp("run")
    (folder / "cube.glb").write_bytes(cube_glb())
    words = ["run", SOURCE, "--frames", f"0:{FRAMES}", "--out", str(folder / "out"), "--scene", "--mesh"]
    words += ["--object", f"{folder / 'cube.glb'}@0.05,0,0,0.2", "--panorama-out", str(folder / "out" / "room.exr")]
    assert run_command(words) == 0
    return folder / "out"


def picture_by_ffmpeg(path: Path) -> NDArray[np.float16]:
    """[h, w, 3] linear RGB."""
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
    assert frame.format.name == "gbrpf16le"
    planes = [np.frombuffer(plane, np.float16).reshape(frame.height, -1)[:, : frame.width] for plane in frame.planes]
    return np.stack([planes[2], planes[0], planes[1]], axis=-1)


def test_khronos_finds_no_fault_in_the_scene(out: Path) -> None:
    info = validated(out / "scene.glb")["info"]
    assert sorted(info["extensionsUsed"]) == ["KHR_lights_punctual", "KHR_materials_unlit"]
    assert info["animationCount"] == 1
    assert info["totalTriangleCount"] > 12


def test_khronos_finds_no_fault_in_the_mesh(out: Path) -> None:
    scan = trimesh.load(out / "mesh.ply", force="mesh", process=False)
    assert validated(out / "mesh.glb")["info"]["totalTriangleCount"] == len(scan.faces) > 100


def test_khronos_finds_no_fault_in_the_vase(tmp_path: Path) -> None:
    (tmp_path / "vase.glb").write_bytes(vase_glb())
    validated(tmp_path / "vase.glb")


def test_the_validator_can_find_a_fault(tmp_path: Path) -> None:
    data = vase_glb().replace(b'"version":"2.0"', b'"version":"7.5"')
    assert data != vase_glb()
    (tmp_path / "vase.glb").write_bytes(data)
    with pytest.raises(AssertionError, match="VERSION"):
        validated(tmp_path / "vase.glb")


def test_opencv_reads_the_light_beside_the_scene(out: Path) -> None:
    picture = cv2.imread(str(out / "scene.hdr"), cv2.IMREAD_UNCHANGED)
    assert picture.shape == (512, 1024, 3)
    assert np.isfinite(picture).all()
    assert picture.max() > 0


def test_ffmpeg_reads_the_panorama(out: Path) -> None:
    picture = picture_by_ffmpeg(out / "room.exr")
    assert picture.shape == (512, 1024, 3)
    assert np.isfinite(picture).all()
    assert picture.max() > 0


def test_evo_reads_the_trajectory(out: Path) -> None:
    pytest.importorskip("evo", reason="evo is not installed: make install-bench")
    from evo.tools.file_interface import read_tum_trajectory_file

    read = read_tum_trajectory_file(str(out / "trajectory.txt"))
    source = open_source(SOURCE)
    assert read.num_poses == FRAMES
    expected = np.array([source[index].world_from_camera for index in range(FRAMES)])
    np.testing.assert_allclose(np.array(read.poses_se3), expected, atol=1e-5)
