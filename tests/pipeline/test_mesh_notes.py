"""What of a mesh is left out with a note."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from server.scene.mesh import MeshError, load_mesh
from tests.scenes.gltf_files import QUAD_UV, Gltf, Json, assert_well_formed


def test_unreadable_texture_is_noted() -> None:
    file = Gltf()
    material = file.texture(np.zeros((4, 4, 3), np.uint8))
    file.binary = file.binary[:40] + b"\xff" * (len(file.binary) - 40)
    file.quad(material | {"baseColorFactor": [0.1, 0.2, 0.3, 1]}, TEXCOORD_0=QUAD_UV)
    mesh = load_mesh(file.glb(), "glb")
    assert any("image 0" in note for note in mesh.notes)
    np.testing.assert_allclose(mesh.vertex_colors[0], [0.1, 0.2, 0.3], rtol=1e-6)
    assert mesh.materials[0].color_texture is None


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        ({"materials": 7}, "material that does not exist"),
        ({"textures": 7}, "texture that does not exist"),
        ({"images": 7}, "image 7 could not be read"),
    ],
)
def test_broken_references_are_noted(broken: Json, words: str) -> None:
    file = Gltf()
    material = file.texture(np.zeros((4, 4, 3), np.uint8))
    if "textures" in broken:
        material["baseColorTexture"]["index"] = 7
    if "images" in broken:
        file.header["textures"][0]["source"] = 7
    primitive = file.quad(material, TEXCOORD_0=QUAD_UV)
    if "materials" in broken:
        primitive["material"] = 7
    mesh = load_mesh(file.glb(), "glb")
    assert_well_formed(mesh)
    assert len(mesh.notes) == 1
    assert words in mesh.notes[0]


def test_texture_without_coordinates_is_noted_and_left_out() -> None:
    file = Gltf()
    file.quad(file.texture(np.zeros((4, 4, 3), np.uint8)) | {"baseColorFactor": [0.1, 0.2, 0.3, 1]})
    mesh = load_mesh(file.glb(), "glb")
    assert mesh.notes == ("1 parts have a texture but no coordinates for it; they keep the plain colour",)
    assert mesh.materials[0].color_texture is None
    np.testing.assert_allclose(mesh.vertex_colors[0], [0.1, 0.2, 0.3], rtol=1e-6)


def test_parts_that_are_no_triangles_are_noted() -> None:
    file = Gltf()
    primitive = file.quad()
    file.header["meshes"][0]["primitives"].append(primitive | {"mode": 1, "attributes": dict(primitive["attributes"])})
    mesh = load_mesh(file.glb(), "glb")
    assert len(mesh.triangles) == 2
    assert mesh.notes == ("1 parts are points, lines or fans and were not read",)


def test_extensions_that_are_needed_and_not_read_are_noted() -> None:
    file = Gltf()
    file.quad()
    file.header["extensionsRequired"] = ["KHR_texture_transform", "KHR_something_new"]
    assert load_mesh(file.glb(), "glb").notes == (
        "the file needs KHR_something_new, which is not read: it may look wrong",
    )


@pytest.mark.parametrize("notes", [["a\nb " * 100] * 30, 7, "x", {"a": 1}, [None]])
def test_notes_inside_the_file_stay_short(notes: Any) -> None:
    file = Gltf()
    file.quad()
    file.header["asset"]["extras"] = {"notes": notes}
    with suppress(MeshError):
        found = load_mesh(file.glb(), "glb").notes
        assert len(found) <= 8
        assert all(len(note) <= 200 and "\n" not in note for note in found)


def test_transparent_materials_are_noted() -> None:
    file = Gltf()
    file.quad({})
    file.header["materials"][0]["alphaMode"] = "BLEND"
    assert any("transparent" in note for note in load_mesh(file.glb(), "glb").notes)


def test_obj_without_its_materials_says_so() -> None:
    obj = b"mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl red\nf 1 2 3\n"
    mesh = load_mesh(obj, "obj")
    assert any("materials" in note for note in mesh.notes)
    np.testing.assert_allclose(mesh.vertex_colors, 0.8)


def ply(vertices: str, faces: str, count: int, face_count: int) -> bytes:
    header = f"ply\nformat ascii 1.0\nelement vertex {count}\n" + "".join(f"property float {a}\n" for a in "xyz")
    header += f"element face {face_count}\nproperty list uchar int vertex_indices\nend_header\n"
    return (header + vertices + faces).encode()


SQUARE = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n"


@pytest.mark.parametrize(
    ("fifth", "face", "reason"),
    [
        ("nan 0 0\n", "3 0 1 4\n", "not finite"),
        ("inf 0 0\n", "3 0 1 4\n", "not finite"),
        ("1e30 0 0\n", "3 0 1 4\n", "not finite"),
        ("0.5 0 0\n", "3 0 1 4\n", "without area"),
        ("9 9 9\n", "3 0 4 4\n", "without area"),
        ("9 9 9\n", "3 0 1 7\n", "do not exist"),
        ("9 9 9\n", "3 0 1 -2\n", "do not exist"),
    ],
)
def test_bad_triangles_are_dropped_and_noted(fifth: str, face: str, reason: str) -> None:
    mesh = load_mesh(ply(SQUARE + fifth, "3 0 1 2\n" + face + "3 0 2 3\n", 5, 3), "ply")
    assert_well_formed(mesh)
    assert len(mesh.triangles) == 2
    assert len(mesh.vertices) == 4
    assert len(mesh.notes) == 1
    assert reason in mesh.notes[0]


def test_nothing_left_is_refused() -> None:
    with pytest.raises(MeshError, match="no triangles") as caught:
        load_mesh(ply("0 0 0\n1 0 0\n2 0 0\n", "3 0 1 2\n", 3, 1), "ply")
    assert "without area" in str(caught.value)
