"""Meshes that are refused, each with one line: damaged, too large, of another kind."""

from __future__ import annotations

import json
import struct
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
import trimesh

from server.scene.limits import MAX_TRIANGLES
from server.scene.mesh import MeshError, load_mesh
from tests.scenes.gltf_files import QUAD_UV, TWO, Gltf, Json, assert_well_formed


@pytest.mark.parametrize("format", ["glb", "gltf", "obj", "ply", "stl"])
def test_empty_file_says_so(format: str) -> None:
    with pytest.raises(MeshError, match=f"the {format} file is empty"):
        load_mesh(b"", format)


NOISE = np.random.default_rng(0).integers(0, 256, 4000, np.uint8).tobytes()


@pytest.mark.parametrize("format", ["glb", "gltf", "obj", "ply", "stl"])
@pytest.mark.parametrize("data", [b"", b"hello\n", b"{}", NOISE, b"glTF", b"ply\n", b"solid x\n", b"f 1 2 3\n"])
def test_not_a_mesh(data: bytes, format: str) -> None:
    with pytest.raises(MeshError) as caught:
        load_mesh(data, format)
    assert "\n" not in str(caught.value)
    assert 10 < len(str(caught.value)) < 250


@pytest.mark.parametrize("format", ["glb", "ply", "stl"])
def test_truncated(format: str) -> None:
    data = trimesh.creation.icosphere(subdivisions=2).export(file_type=format)
    for share in (0.3, 0.9):
        with pytest.raises(MeshError):
            load_mesh(data[: int(len(data) * share)], format)


def test_unknown_format() -> None:
    with pytest.raises(MeshError, match="'fbx' is not supported"):
        load_mesh(b"", "fbx")


def test_points_only() -> None:
    cloud = trimesh.PointCloud(np.random.default_rng(0).random((50, 3)))
    with pytest.raises(MeshError, match="no triangles"):
        load_mesh(cloud.export(file_type="ply"), "ply")


def test_too_many_triangles_by_repetition() -> None:
    """A small file whose scene repeats one mesh thousands of times."""
    count = 2000
    file = Gltf()
    file.quad()
    file.header["meshes"][0]["primitives"][0]["indices"] = file.accessor(np.tile(TWO[:3], count))
    repeats = MAX_TRIANGLES // count + 1
    file.nodes({"children": list(range(1, repeats + 1))}, *({"mesh": 0} for _ in range(repeats)))
    with pytest.raises(MeshError, match=f"more than {MAX_TRIANGLES}"):
        load_mesh(file.glb(), "glb")


def test_ten_million_triangles_are_refused_by_their_header() -> None:
    """Before anything is read: what follows the header is not even there."""
    text = b"ply\nformat binary_little_endian 1.0\nelement vertex 5000000\nproperty float x\nelement face 10000000\n"
    files = {"ply": text + b"property list uchar int vertex_indices\nend_header\n"}
    files["stl"] = bytes(80) + struct.pack("<I", 10_000_000)
    for format, data in files.items():
        with pytest.raises(MeshError, match=f"10000000 triangles.*more than {MAX_TRIANGLES}.*simplify"):
            load_mesh(data, format)


def test_accessor_bomb() -> None:
    file = Gltf()
    primitive = file.quad()
    file.header["accessors"].append({"count": 10**10, "componentType": 5126, "type": "VEC3"})
    primitive["attributes"]["POSITION"] = len(file.header["accessors"]) - 1
    with pytest.raises(MeshError, match=f"more than {MAX_TRIANGLES}"):
        load_mesh(file.glb(), "glb")
    primitive["attributes"]["POSITION"] = 0
    with pytest.raises(MeshError, match="accessors"):
        load_mesh(file.glb(), "glb")


def test_an_accessor_of_less_than_nothing() -> None:
    """Counts that cancel out in the sum."""
    file = Gltf()
    file.quad()
    file.header["accessors"].append({"count": -3, "componentType": 5126, "type": "VEC3"})
    with pytest.raises(MeshError, match="accessors"):
        load_mesh(file.glb(), "glb")


def test_many_primitives_of_the_same_bytes() -> None:
    file = Gltf()
    primitive = file.quad()
    primitive["attributes"]["POSITION"] = file.accessor(np.zeros((4000, 3), np.float32))
    file.header["meshes"][0]["primitives"] = [primitive] * (3 * MAX_TRIANGLES // 4000 + 1)
    with pytest.raises(MeshError, match=f"more than {MAX_TRIANGLES}"):
        load_mesh(file.glb(), "glb")


@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression"])
def test_compressed(name: str) -> None:
    file = Gltf()
    file.quad()
    file.header["extensionsUsed"] = [name]
    with pytest.raises(MeshError, match=f"{name}.*without compression"):
        load_mesh(file.glb(), "glb")


def test_external_buffer() -> None:
    file = Gltf()
    file.quad()
    file.gltf()
    file.header["buffers"] = [{"byteLength": len(file.binary), "uri": "../../etc/passwd"}]
    with pytest.raises(MeshError, match="another file"):
        load_mesh(json.dumps(file.header).encode(), "gltf")


@pytest.mark.parametrize(
    ("nodes", "words"),
    [
        ([{"mesh": 0, "children": [0]}], "circle|two parents"),
        ([{"mesh": 0, "children": [1]}, {"children": [0]}], "circle"),
        ([{"children": [1, 2]}, {"children": [2]}, {"mesh": 0}], "two parents"),
        ([{"mesh": 0, "children": [9]}], "child 9"),
        ([{"children": [i + 1]} for i in range(400)] + [{"mesh": 0}], "levels deep"),
    ],
)
def test_scene_graph_that_is_no_tree(nodes: list[Json], words: str) -> None:
    file = Gltf()
    file.quad()
    file.nodes(*nodes)
    with pytest.raises(MeshError, match=words):
        load_mesh(file.glb(), "glb")


@pytest.mark.parametrize("damage", ["accessors", "meshes", "nodes", "bufferViews", "materials", "textures"])
@pytest.mark.parametrize("value", [[], {}, None, [None], [{}], 7, "x"])
def test_damaged_gltf_never_ends_in_a_traceback(damage: str, value: Any) -> None:
    file = Gltf()
    file.quad(file.texture(np.zeros((4, 4, 3), np.uint8)), TEXCOORD_0=QUAD_UV)
    file.header[damage] = value
    with suppress(MeshError):
        assert_well_formed(load_mesh(file.glb(), "glb"))
