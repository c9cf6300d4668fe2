"""Reading meshes: what comes out of each format, what is dropped, what is refused."""

from __future__ import annotations

import base64
import json
import struct
from contextlib import suppress
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from server.scene import gltf_pictures
from server.scene.limits import MAX_TRIANGLES
from server.scene.materials import MATTE, Beyond, Texture
from server.scene.mesh import Mesh, MeshError, load_mesh
from tests.data import data_folder
from tests.meshes import public_mesh

QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
QUAD_UV = np.array([[0.25, 0.75], [0.75, 0.75], [0.75, 0.25], [0.25, 0.25]], np.float32)
TWO = np.array([0, 1, 2, 0, 2, 3], np.uint32)

Json = dict[str, Any]


class Gltf:
    """A glTF file put together by hand."""

    def __init__(self) -> None:
        self.header: Json = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": [], "scene": 0}
        self.binary = b""

    def view(self, content: bytes) -> int:
        self.header["bufferViews"].append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(content)})
        self.binary += content + b"\0" * (-len(content) % 4)
        return len(self.header["bufferViews"]) - 1

    def accessor(self, values: NDArray[Any]) -> int:
        kinds = {"float32": 5126, "uint32": 5125, "uint16": 5123, "uint8": 5121}
        shapes = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4"}
        entry = {"bufferView": self.view(values.tobytes()), "count": len(values)}
        entry |= {"componentType": kinds[str(values.dtype)], "type": shapes[values.shape[1:]]}
        self.header["accessors"].append(entry)
        return len(self.header["accessors"]) - 1

    def quad(self, material: Json | None = None, **attributes: NDArray[Any]) -> Json:
        """One mesh, a square in the xy plane; returns its primitive."""
        primitive: Json = {"attributes": {"POSITION": self.accessor(QUAD)}, "indices": self.accessor(TWO)}
        primitive["attributes"] |= {name: self.accessor(values) for name, values in attributes.items()}
        if material is not None:
            self.header["materials"] = [{"pbrMetallicRoughness": material}]
            primitive["material"] = 0
        self.header |= {"meshes": [{"primitives": [primitive]}]}
        self.nodes({"mesh": 0})
        return primitive

    def texture(self, picture: NDArray[np.uint8], kind: str = ".png") -> Json:
        """A base colour texture of an RGB picture."""
        done, encoded = cv2.imencode(kind, cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
        assert done
        mime = {".png": "image/png", ".jpg": "image/jpeg"}[kind]
        self.header["images"] = [{"bufferView": self.view(encoded.tobytes()), "mimeType": mime}]
        self.header["textures"] = [{"source": 0}]
        return {"baseColorTexture": {"index": 0}}

    def nodes(self, *nodes: Json, roots: tuple[int, ...] = (0,)) -> None:
        self.header |= {"nodes": list(nodes), "scenes": [{"nodes": list(roots)}]}

    def glb(self) -> bytes:
        self.header["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(self.header).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
        chunks += struct.pack("<II", len(self.binary), 0x004E4942) + self.binary
        return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks

    def gltf(self) -> bytes:
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.binary).decode()
        self.header["buffers"] = [{"byteLength": len(self.binary), "uri": uri}]
        return json.dumps(self.header).encode()


def linear(srgb: Any) -> NDArray[np.float64]:
    srgb = np.asarray(srgb, np.float64)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def assert_well_formed(mesh: Mesh) -> None:
    for array, dtype in (
        (mesh.vertices, np.float32),
        (mesh.triangles, np.int32),
        (mesh.vertex_colors, np.float32),
        (mesh.normals, np.float32),
    ):
        assert array.dtype == dtype
        assert array.shape[1] == 3
        assert np.isfinite(array).all()
    assert len(mesh.vertices) == len(mesh.vertex_colors) == len(mesh.normals)
    assert set(np.unique(mesh.triangles)) == set(range(len(mesh.vertices)))
    assert mesh.vertex_colors.min() >= 0
    assert mesh.vertex_colors.max() <= 1
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)


# ---- formats -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("format", "up"), [("ply", "z"), ("stl", "z"), ("obj", "y"), ("glb", "y")])
def test_formats_agree(format: str, up: str) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    data = ball.export(file_type=format)
    mesh = load_mesh(data.encode() if isinstance(data, str) else data, format)
    assert_well_formed(mesh)
    assert mesh.up_axis == up
    assert len(mesh.triangles) == len(ball.faces)
    assert len(mesh.vertices) == len(ball.vertices)
    a, b, c = (mesh.vertices[mesh.triangles[:, k]].astype(np.float64) for k in range(3))
    volume = (a * np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(ball.volume, rel=1e-5)  # the triangles still face outwards
    angle = np.degrees(np.arccos(np.clip((mesh.normals * mesh.vertices).sum(axis=1), -1, 1)))
    assert angle.max() < 1.0


def test_gltf_with_embedded_buffer() -> None:
    file = Gltf()
    file.quad()
    assert_well_formed(load_mesh(file.gltf(), "gltf"))
    np.testing.assert_array_equal(load_mesh(file.gltf(), "gltf").vertices, load_mesh(file.glb(), "glb").vertices)


def test_scene_graph_is_applied() -> None:
    file = Gltf()
    file.quad()
    turn = {"rotation": [0, 0, np.sin(np.pi / 4), np.cos(np.pi / 4)], "translation": [10, 0, 0]}  # x to y
    file.nodes({"children": [1, 2], "scale": [2, 2, 2]}, {"mesh": 0} | turn, {"mesh": 0, "translation": [0, 0, 5]})
    mesh = load_mesh(file.glb(), "glb")
    assert_well_formed(mesh)
    places = {tuple(np.round(v, 4)) for v in mesh.vertices.tolist()}
    turned = {(20.0 - 2 * y, 2.0 * x, 0.0) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))}
    assert places == turned | {(2.0 * x, 2.0 * y, 10.0) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))}


def test_mirrored_node_keeps_its_outside() -> None:
    file = Gltf()
    file.quad(NORMAL=np.tile(np.array([0, 0.6, 0.8], np.float32), (4, 1)))
    file.nodes({"mesh": 0, "scale": [-1, 1, 0.5]})
    mesh = load_mesh(file.glb(), "glb")
    a, b, c = mesh.vertices[mesh.triangles[0]]
    assert np.cross(b - a, c - a)[2] > 0
    expected = np.array([0, 0.6, 1.6])  # inverse transpose
    np.testing.assert_allclose(mesh.normals, np.tile(expected / np.linalg.norm(expected), (4, 1)), atol=1e-6)


# ---- colours -----------------------------------------------------------------------------------------------------


def test_no_colour_is_grey() -> None:
    file = Gltf()
    file.quad()
    np.testing.assert_allclose(load_mesh(file.glb(), "glb").vertex_colors, 0.8)


def test_base_color_factor_is_linear() -> None:
    file = Gltf()
    file.quad({"baseColorFactor": [0.9433962, 0.0123, 0.5, 1.0]})
    np.testing.assert_allclose(load_mesh(file.glb(), "glb").vertex_colors[0], [0.9433962, 0.0123, 0.5], rtol=1e-6)


def shown_texture(mesh: Mesh) -> Texture:
    texture = mesh.materials[0].color_texture
    assert texture is not None
    return texture


def color_uv(mesh: Mesh) -> dict[tuple[float, ...], NDArray[np.float32]]:
    """Base colour coordinates by the place of their vertex."""
    assert mesh.uv is not None
    return {tuple(v): uv[:2] for v, uv in zip(mesh.vertices.tolist(), mesh.uv, strict=True)}


@pytest.mark.parametrize("kind", [".png", ".jpg"])
@pytest.mark.parametrize("as_uint16", [False, True])
def test_texture_and_its_coordinates_are_kept(kind: str, as_uint16: bool) -> None:
    picture = np.zeros((16, 24, 3), np.uint8)
    picture[:8, :8], picture[:8, 8:] = (200, 0, 0), (0, 200, 0)
    file = Gltf()
    uv = np.rint(QUAD_UV * 65535).astype(np.uint16) if as_uint16 else QUAD_UV
    file.quad(file.texture(picture, kind) | {"baseColorFactor": [0.5, 1, 1, 1]}, TEXCOORD_0=uv)
    mesh = load_mesh(file.glb(), "glb")
    assert_well_formed(mesh)
    np.testing.assert_allclose(mesh.vertex_colors, np.tile((0.5, 1, 1), (4, 1)))  # the factor, not the texture
    error = np.abs(shown_texture(mesh).image.astype(int) - picture)
    assert error.max() == 0 if kind == ".png" else np.median(error) < 12  # JPEG's chroma is coarse
    for place, at in zip(QUAD.tolist(), QUAD_UV, strict=True):
        np.testing.assert_allclose(color_uv(mesh)[tuple(place)], at, atol=1e-4)


def test_far_repeats_are_brought_near() -> None:
    """A shift by whole textures, even so that it suits mirrors, keeps float32's digits for what is inside."""
    file = Gltf()
    file.quad(file.texture(np.zeros((4, 4, 3), np.uint8)), TEXCOORD_0=QUAD_UV + np.float32([5000, -300]))
    found = color_uv(load_mesh(file.glb(), "glb"))
    for place, at in zip(QUAD.tolist(), QUAD_UV, strict=True):
        np.testing.assert_allclose(found[tuple(place)], at, atol=1e-3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -3e38])
def test_bad_coordinates_become_finite(bad: float) -> None:
    uv = QUAD_UV.copy()
    uv[1] = bad
    file = Gltf()
    file.quad(file.texture(np.zeros((4, 4, 3), np.uint8)), TEXCOORD_0=uv)
    mesh = load_mesh(file.glb(), "glb")
    assert mesh.uv is not None
    assert np.isfinite(mesh.uv).all()
    assert np.abs(mesh.uv).max() <= 2e6


def test_second_coordinates_transform_and_wrapping() -> None:
    """TEXCOORD_1, KHR_texture_transform (the extension's own example: the lower left quadrant, turned) and sampler."""
    file = Gltf()
    material = file.texture(np.zeros((4, 4, 3), np.uint8))
    change = {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5], "texCoord": 1}
    material["baseColorTexture"] |= {"extensions": {"KHR_texture_transform": change}}
    file.header["samplers"] = [{"wrapS": 33071, "wrapT": 33648}]
    file.header["textures"][0]["sampler"] = 0
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    file.quad(material, TEXCOORD_0=QUAD_UV, TEXCOORD_1=unit)
    mesh = load_mesh(file.glb(), "glb")
    assert shown_texture(mesh).beyond == (Beyond.CLAMP, Beyond.MIRROR)
    found = color_uv(mesh)
    for place, (u, v) in zip(QUAD.tolist(), unit, strict=True):
        np.testing.assert_allclose(found[tuple(place)], (0.5 * v, 1 - 0.5 * u), atol=1e-6)


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


@pytest.mark.parametrize("format", ["glb", "gltf", "obj", "ply", "stl"])
def test_empty_file_says_so(format: str) -> None:
    with pytest.raises(MeshError, match=f"the {format} file is empty"):
        load_mesh(b"", format)


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


def test_large_texture_is_scaled_down_with_a_note() -> None:
    """16k wide, and uniform so that the file is small."""
    file = Gltf()
    file.quad(file.texture(np.full((64, 16384, 3), 77, np.uint8)), TEXCOORD_0=QUAD_UV)
    mesh = load_mesh(file.glb(), "glb")
    image = shown_texture(mesh).image
    assert image.shape == (16, 4096, 3)
    assert (image == 77).all()
    assert mesh.notes == ("image 0 was scaled down from 16384 x 64 to 4096 x 16 pixels",)


def test_many_large_textures_are_scaled_until_they_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gltf_pictures, "MAX_KEPT_PIXELS", 3 * 64 * 64)
    file = Gltf()
    material = file.texture(np.zeros((128, 128, 3), np.uint8))
    file.header["images"] = [dict(file.header["images"][0]) for _ in range(6)]
    file.header["textures"] = [{"source": k} for k in range(6)]
    file.quad(material, TEXCOORD_0=QUAD_UV)
    file.header["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": k}}} for k in range(6)]
    first = file.header["meshes"][0]["primitives"][0]
    file.header["meshes"][0]["primitives"] = [first | {"material": k} for k in range(6)]
    mesh = load_mesh(file.glb(), "glb")
    assert [m.color_texture.image.shape[0] for m in mesh.materials if m.color_texture] == [32] * 6
    assert len(mesh.notes) == 6


def test_texture_bomb_is_refused_before_it_is_decoded() -> None:
    header = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 60000, 60000) + bytes([8, 2, 0, 0, 0])
    file = Gltf()
    file.header["images"] = [{"bufferView": file.view(header), "mimeType": "image/png"}]
    file.header["textures"] = [{"source": 0}]
    file.quad({"baseColorTexture": {"index": 0}}, TEXCOORD_0=QUAD_UV)
    with pytest.raises(MeshError, match="textures has 60000 x 60000"):
        load_mesh(file.glb(), "glb")


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


def test_obj_without_its_materials_says_so() -> None:
    obj = b"mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl red\nf 1 2 3\n"
    mesh = load_mesh(obj, "obj")
    assert any("materials" in note for note in mesh.notes)
    np.testing.assert_allclose(mesh.vertex_colors, 0.8)


# ---- normals -----------------------------------------------------------------------------------------------------


def test_creases_are_kept_sharp() -> None:
    mesh = load_mesh(trimesh.creation.box().export(file_type="stl"), "stl")
    assert len(mesh.vertices) == 24
    assert {tuple(n) for n in np.abs(mesh.normals).round(6).tolist()} == {(1, 0, 0), (0, 1, 0), (0, 0, 1)}


def test_round_and_sharp_in_one_mesh() -> None:
    """A cylinder's side is smooth, its rims are sharp."""
    cylinder = trimesh.creation.cylinder(1.0, 2.0, sections=36)
    mesh = load_mesh(cylinder.export(file_type="ply"), "ply")
    is_cap = np.abs(mesh.normals[:, 2]) > 0.999
    np.testing.assert_allclose(mesh.normals[~is_cap][:, 2], 0, atol=1e-6)
    outward = mesh.vertices[~is_cap] * (1, 1, 0)
    np.testing.assert_allclose(mesh.normals[~is_cap], outward, atol=1e-3)


def test_normals_of_the_file_are_kept() -> None:
    file = Gltf()
    file.quad(NORMAL=np.tile(np.array([0, 3, 4], np.float32), (4, 1)))
    np.testing.assert_allclose(load_mesh(file.glb(), "glb").normals, np.tile((0, 0.6, 0.8), (4, 1)), atol=1e-6)


@pytest.mark.parametrize("bad", [[0.0, 0.0, 0.0], [np.nan, 0.0, 1.0]])
def test_bad_normals_of_the_file_are_replaced(bad: list[float]) -> None:
    normals = np.tile(np.array([0, 3, 4], np.float32), (4, 1))
    normals[2] = bad
    file = Gltf()
    file.quad(NORMAL=normals)
    np.testing.assert_allclose(load_mesh(file.glb(), "glb").normals, np.tile((0, 0, 1), (4, 1)), atol=1e-6)


def test_long_fan_is_smoothed() -> None:
    """Every triangle shares one vertex with all others: pairs of them would not fit the memory."""
    angle = np.linspace(0, 2 * np.pi, 100_001)[:-1]
    rim = np.stack([np.cos(angle), np.sin(angle), np.full_like(angle, 0.1)], axis=1)
    index = np.arange(len(rim))
    triangles = np.stack([np.zeros_like(index), index + 1, np.roll(index, -1) + 1], axis=1)
    fan = trimesh.Trimesh(np.vstack([[0, 0, 0], rim]), triangles, process=False)
    mesh = load_mesh(fan.export(file_type="ply"), "ply")
    assert len(mesh.vertices) == 100_001
    np.testing.assert_allclose(mesh.normals[(mesh.vertices == 0).all(axis=1)], [[0, 0, 1]], atol=1e-3)


# ---- what is dropped ---------------------------------------------------------------------------------------------


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


# ---- what is refused ---------------------------------------------------------------------------------------------

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


# ---- public meshes -----------------------------------------------------------------------------------------------


@pytest.mark.data
def test_every_public_mesh() -> None:
    found = [p for p in sorted(data_folder("mesh").rglob("*")) if p.suffix in {".glb", ".obj", ".ply"}]
    assert len(found) > 30
    for path in found:
        mesh = load_mesh(path.read_bytes(), path.suffix[1:])
        assert_well_formed(mesh)
        assert len(mesh.triangles) > 30, path.name


@pytest.mark.data
def test_duck_is_yellow_with_an_orange_beak() -> None:
    duck = public_mesh("Duck.glb")
    low, high = duck.bounds
    assert (high - low)[1] == pytest.approx(1.54, abs=0.01)
    body = np.median(shown_texture(duck).image.reshape(-1, 3), axis=0)
    np.testing.assert_allclose(body, (255, 216, 0), atol=12)
    assert duck.uv is not None
    assert duck.uv[:, :2].min() > 0
    assert duck.uv[:, :2].max() < 1
