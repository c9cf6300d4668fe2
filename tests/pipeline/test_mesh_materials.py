"""Colours and materials of meshes: factors, vertex colours, roughness and metalness."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from server.scene.materials import MATTE
from server.scene.mesh import load_mesh
from tests.scenes.gltf_files import QUAD, QUAD_UV, Gltf, Json, linear


def test_no_colour_is_grey() -> None:
    file = Gltf()
    file.quad()
    np.testing.assert_allclose(load_mesh(file.glb(), "glb").vertex_colors, 0.8)


def test_base_color_factor_is_linear() -> None:
    file = Gltf()
    file.quad({"baseColorFactor": [0.9433962, 0.0123, 0.5, 1.0]})
    np.testing.assert_allclose(load_mesh(file.glb(), "glb").vertex_colors[0], [0.9433962, 0.0123, 0.5], rtol=1e-6)


def test_roughness_and_metalness_are_read() -> None:
    picture = np.tile(np.array([1, 2, 3], np.uint8), (4, 4, 1))
    file = Gltf()
    reference = file.texture(picture)["baseColorTexture"]
    material = {"roughnessFactor": 0.25, "metallicFactor": 0.5, "metallicRoughnessTexture": reference | {"texCoord": 1}}
    file.quad(material, TEXCOORD_1=QUAD_UV)
    mesh = load_mesh(file.glb(), "glb")
    (found,) = mesh.materials
    assert (found.roughness, found.metalness, found.color_texture) == (0.25, 0.5, None)
    assert found.surface_texture is not None
    np.testing.assert_array_equal(found.surface_texture.image, picture)
    assert mesh.uv is not None
    np.testing.assert_allclose(np.sort(mesh.uv[:, 2:], axis=0), np.sort(QUAD_UV, axis=0))
    assert not mesh.uv[:, :2].any()


@pytest.mark.parametrize(
    ("values", "expected"), [({}, (1.0, 1.0)), ({"roughnessFactor": 9, "metallicFactor": -1}, (1, 0))]
)
def test_what_a_gltf_material_leaves_unsaid(values: Json, expected: tuple[float, float]) -> None:
    """glTF's own defaults where there is a material; matte where there is none."""
    file = Gltf()
    file.quad(values)
    (found,) = load_mesh(file.glb(), "glb").materials
    assert (found.roughness, found.metalness) == expected
    plain = Gltf()
    plain.quad()
    for mesh in (load_mesh(plain.glb(), "glb"), load_mesh(trimesh.creation.box().export(file_type="ply"), "ply")):
        assert mesh.materials == (MATTE,)
        assert (MATTE.roughness, MATTE.metalness) == (1.0, 0.0)


def test_parts_keep_their_materials() -> None:
    file = Gltf()
    first = file.quad({"roughnessFactor": 0.1})
    file.header["materials"] += [{"pbrMetallicRoughness": {"roughnessFactor": r}} for r in (0.2, 0.3)]
    file.header["meshes"][0]["primitives"] = [first | {"material": m} for m in (2, 0, 2)]
    mesh = load_mesh(file.glb(), "glb")
    assert [m.roughness for m in mesh.materials] == [0.3, 0.1]
    np.testing.assert_array_equal(mesh.material_of, [0, 0, 1, 1, 0, 0])


@pytest.mark.parametrize("material", [None, {"baseColorFactor": [0.5, 0.5, 1, 1]}])
def test_gltf_vertex_colors(material: Json | None) -> None:
    colors = np.array([[255, 0, 0], [0, 128, 0], [10, 10, 10], [255, 255, 255]], np.uint8)
    file = Gltf()
    file.quad(material, COLOR_0=np.hstack([colors, np.full((4, 1), 255, np.uint8)]))
    mesh = load_mesh(file.glb(), "glb")
    factor = np.ones(3) if material is None else np.array([0.5, 0.5, 1])
    order = [int(np.flatnonzero((v == QUAD).all(axis=1))[0]) for v in mesh.vertices]
    np.testing.assert_allclose(mesh.vertex_colors, (linear(colors / 255) * factor)[order], atol=1e-6)


def test_ply_vertex_colors_are_srgb() -> None:
    box = trimesh.creation.box()
    box.visual.vertex_colors = np.tile(np.array([188, 64, 0, 255], np.uint8), (8, 1))
    mesh = load_mesh(box.export(file_type="ply"), "ply")
    np.testing.assert_allclose(mesh.vertex_colors, np.tile(linear(np.array([188, 64, 0]) / 255), (24, 1)), atol=1e-6)


def test_ply_face_colors_split_vertices() -> None:
    box = trimesh.creation.box()
    colors = np.arange(12 * 3).reshape(12, 3).astype(np.uint8) * 6
    box.visual.face_colors = np.hstack([colors, np.full((12, 1), 255, np.uint8)])
    mesh = load_mesh(box.export(file_type="ply"), "ply")
    found = mesh.vertex_colors[mesh.triangles]
    np.testing.assert_allclose(found, np.repeat(linear(colors / 255)[:, None], 3, axis=1), atol=1e-6)
