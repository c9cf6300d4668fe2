"""`--scene`: the file read back by trimesh and as JSON, against places and lights that are known."""

from __future__ import annotations

import io
import json
import math
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from client.cli import run_command
from client.objects.object_file import pack_mesh
from client.results.bright_parts import BrightPart, solid_angles, split
from client.results.gltf_scene import PlacedObject, scene_glb
from server.light.panorama import panorama_directions
from tests.client.gltf_scenes import CAMERA, GLTF_FROM_WORLD, SQUARE, cube_glb, square

HEIGHT, WIDTH = 128, 256


def placed(format_: str, data: bytes, matrix: NDArray[np.float64], name: str = "cube") -> PlacedObject:
    return PlacedObject(name, Path(f"{name}.{format_}"), format_, data, matrix)  # type: ignore[arg-type]


def poses(count: int = 3) -> list[tuple[float, NDArray[np.float64]]]:
    """world_from_camera of a camera at (i, -2, 1) that looks along world +y."""
    path = []
    for i in range(count):
        pose = np.eye(4)
        pose[:3, :3] = np.stack([[1, 0, 0], [0, 0, -1], [0, 1, 0]], axis=1)
        pose[:3, 3] = (i, -2, 1)
        path.append((10 + 0.5 * i, pose))
    return path


def document_of(data: bytes) -> tuple[dict[str, Any], bytes]:
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def values(document: dict[str, Any], body: bytes, accessor: int) -> NDArray[Any]:
    """The numbers of a float32 accessor."""
    entry = document["accessors"][accessor]
    view = document["bufferViews"][entry["bufferView"]]
    assert entry["componentType"] == 5126
    columns = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[entry["type"]]
    found = np.frombuffer(body, np.float32, entry["count"] * columns, view["byteOffset"])
    return found.reshape(entry["count"], columns)


def corners(scene: trimesh.Scene, count: int) -> NDArray[np.float64]:
    """Vertices in the file's axes of the mesh with this number of triangles."""
    for name in scene.graph.nodes_geometry:
        matrix, geometry = scene.graph[name]
        mesh = scene.geometry[geometry]
        if len(mesh.faces) == count:
            return trimesh.transform_points(mesh.vertices, matrix)
    raise AssertionError(f"no mesh with {count} triangles")


def test_scan_and_objects_stand_where_they_are_in_axes_of_gltf() -> None:
    turn = np.eye(4)
    turn[:3, :3] = 0.2 * Rotation.from_euler("zx", [30, 90], degrees=True).as_matrix()
    turn[:3, 3] = (0.3, 1.0, 0.0)
    data = scene_glb(square(), [placed("glb", cube_glb(), turn)], [], poses(), CAMERA, "scene.hdr")
    scene = trimesh.load(io.BytesIO(data), file_type="glb", process=False)
    np.testing.assert_allclose(corners(scene, 2), SQUARE @ GLTF_FROM_WORLD.T, atol=1e-6)
    cube = trimesh.load(io.BytesIO(cube_glb()), file_type="glb").to_geometry().vertices
    in_world = cube @ turn[:3, :3].T + turn[:3, 3]
    np.testing.assert_allclose(
        np.sort(corners(scene, 12), axis=0), np.sort(in_world @ GLTF_FROM_WORLD.T, axis=0), atol=1e-6
    )
    assert corners(scene, 12)[:, 1].min() == pytest.approx(0, abs=1e-6)  # it stands on the floor, +y up


def test_materials_and_textures_of_objects_are_kept_with_several_of_them() -> None:
    shifted = np.eye(4)
    shifted[0, 3] = 5
    textured = cube_glb(pytest.importorskip("PIL.Image").new("RGB", (4, 4), (255, 0, 0)))
    cubes = [placed("glb", textured, np.eye(4)), placed("glb", textured, shifted)]
    scene = trimesh.load(io.BytesIO(scene_glb(square(), cubes, [], poses(), CAMERA, "scene.hdr")), file_type="glb")
    found = [mesh for mesh in scene.geometry.values() if len(mesh.faces) == 12]
    assert len(found) == 2
    for mesh in found:
        assert mesh.visual.material.roughnessFactor == 0.25
        assert mesh.visual.material.baseColorTexture.getpixel((1, 1)) == (255, 0, 0)


def test_an_object_without_materials_keeps_its_colours(tmp_path: Path) -> None:
    box = trimesh.creation.box((1, 1, 1))
    box.visual.vertex_colors = np.tile(np.array([188, 0, 0, 255], np.uint8), (len(box.vertices), 1))
    box.export(tmp_path / "box.ply")
    format_, data = pack_mesh(tmp_path / "box.ply")
    document, body = document_of(
        scene_glb(square(), [placed(format_, data, np.eye(4))], [], poses(), CAMERA, "scene.hdr")
    )
    node = next(node for node in document["nodes"] if node.get("name") == "cube" and "mesh" in node)
    color = values(document, body, document["meshes"][node["mesh"]]["primitives"][0]["attributes"]["COLOR_0"])
    np.testing.assert_allclose(color, np.tile([0.503, 0, 0], (len(color), 1)), atol=0.001)  # linear, as glTF has it


def test_the_scan_is_unlit_and_linear() -> None:
    document, body = document_of(scene_glb(square(), [], [], poses(), CAMERA, "scene.hdr"))
    primitive = document["meshes"][0]["primitives"][0]
    assert "KHR_materials_unlit" in document["materials"][primitive["material"]]["extensions"]
    np.testing.assert_allclose(values(document, body, primitive["attributes"]["COLOR_0"]), 0.2159, atol=1e-4)
    lengths = np.linalg.norm(values(document, body, primitive["attributes"]["NORMAL"]), axis=1)
    np.testing.assert_allclose(lengths, 1, atol=1e-6)


def test_lights_shine_from_where_they_are() -> None:
    """A light shines along its node's -z; `direction` is in the axes of the picture, which are glTF's."""
    towards = np.array([0.6, 0.64, -0.48])
    part = BrightPart((0.6, 0.64, -0.48), (2.0, 4.0, 1.0))
    document, _ = document_of(scene_glb(square(), [], [part], poses(), CAMERA, "scene.hdr"))
    (light,) = document["extensions"]["KHR_lights_punctual"]["lights"]
    assert (light["type"], light["intensity"], light["color"]) == ("directional", 4.0, [0.5, 1.0, 0.25])
    assert "KHR_lights_punctual" in document["extensionsUsed"]
    node = next(n for n in document["nodes"] if "KHR_lights_punctual" in n.get("extensions", {}))
    shines = GLTF_FROM_WORLD @ Rotation.from_quat(node["rotation"]).as_matrix() @ (0, 0, -1)
    np.testing.assert_allclose(shines, -towards, atol=1e-9)


def test_the_camera_moves_along_the_path() -> None:
    document, body = document_of(scene_glb(square(), [], [], [*poses(), poses()[2]], CAMERA, "scene.hdr"))
    (lens,) = document["cameras"]
    assert math.tan(lens["perspective"]["yfov"] / 2) == pytest.approx(24 / 66)
    assert lens["perspective"]["aspectRatio"] == pytest.approx((64 / 60) / (48 / 66))
    (animation,) = document["animations"]
    tracks = {channel["target"]["path"]: animation["samplers"][channel["sampler"]] for channel in animation["channels"]}
    times = values(document, body, tracks["translation"]["input"]).ravel()
    np.testing.assert_allclose(times, [0, 0.5, 1.0])  # the frame that came twice is there once
    np.testing.assert_allclose(values(document, body, tracks["translation"]["output"])[:, 0], [0, 1, 2])
    turn = Rotation.from_quat(values(document, body, tracks["rotation"]["output"])[1]).as_matrix()
    np.testing.assert_allclose(GLTF_FROM_WORLD @ turn @ (0, 0, -1), (0, 0, -1), atol=1e-6)  # it looks along glTF's -z
    np.testing.assert_allclose(GLTF_FROM_WORLD @ turn @ (0, 1, 0), (0, 1, 0), atol=1e-6)


def sky(lamp: tuple[float, float, float], radiance: float, within_deg: float) -> NDArray[np.float64]:
    """A white sky of radiance 0.5 with a lamp in one direction."""
    towards = panorama_directions(HEIGHT, WIDTH).reshape(HEIGHT, WIDTH, 3)
    picture = np.full((HEIGHT, WIDTH, 3), 0.5)
    picture[towards @ np.array(lamp) > math.cos(math.radians(within_deg))] = (radiance, radiance / 2, radiance / 4)
    return picture


@pytest.mark.parametrize("lamp", [(0.6, 0.64, -0.48), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)])
def test_a_lamp_becomes_one_light_and_no_light_is_lost(lamp: tuple[float, float, float]) -> None:
    """Also at the left and right edge of the picture, and at its pole."""
    picture = sky(lamp, 200.0, 8.0)
    lights, rest = split(picture)
    assert len(lights) == 1
    assert np.degrees(np.arccos(min(1.0, np.dot(lights[0].direction, lamp)))) < 1.0
    weight = solid_angles(HEIGHT, WIDTH)[..., None]
    assert weight.sum() == pytest.approx(4 * math.pi)
    total = (picture * weight).sum(axis=(0, 1))
    np.testing.assert_allclose((rest * weight).sum(axis=(0, 1)) + lights[0].irradiance, total, rtol=1e-9)
    solid = 2 * math.pi * (1 - math.cos(math.radians(8)))
    assert lights[0].irradiance[0] == pytest.approx(200 * solid, rel=0.1)  # the lamp's edge in pixels of 1.4 degrees
    assert rest.max() < 0.05 * picture.max()


def test_soft_light_has_a_light_and_uniform_light_none() -> None:
    assert split(np.full((HEIGHT, WIDTH, 3), 0.7))[0] == []
    towards = panorama_directions(HEIGHT, WIDTH).reshape(HEIGHT, WIDTH, 3)
    soft = np.repeat(1 + 0.9 * towards[..., 1:2], 3, axis=2)
    lights, rest = split(soft)
    assert [round(x, 3) + 0.0 for x in lights[0].direction] == [0, 1, 0]
    assert rest.min() > 0


def test_run_writes_the_scene_and_the_light_beside_it(tmp_path: Path) -> None:
    (tmp_path / "cube.glb").write_bytes(cube_glb())
    out = tmp_path / "out"
    words = ["run", "synthetic:table?size=96x72", "--frames", "0:2", "--out", str(out), "--scene"]
    assert run_command([*words, "--object", f"{tmp_path / 'cube.glb'}@0.05,0,0,0.2", "--preset", "art8"]) == 0
    scene = trimesh.load(io.BytesIO((out / "scene.glb").read_bytes()), file_type="glb")
    cube = corners(scene, 12)
    np.testing.assert_allclose(cube.min(axis=0)[1], 0, atol=1e-6)  # on the table, whose top is at height 0
    assert np.ptp(cube, axis=0)[1] == pytest.approx(0.2, abs=1e-6)
    longest = max(np.linalg.norm(cube - corner, axis=1).max() for corner in cube)
    assert longest == pytest.approx(0.2 * math.sqrt(3), abs=1e-6)
    document, _ = document_of((out / "scene.glb").read_bytes())
    assert document["asset"]["extras"]["environment"] == "scene.hdr"
    assert [node["name"] for node in document["nodes"] if "camera" in node] == ["camera"]
    picture = cv2.imread(str(out / "scene.hdr"), cv2.IMREAD_UNCHANGED)
    assert picture.shape == (512, 1024, 3)
    assert np.isfinite(picture).all()
