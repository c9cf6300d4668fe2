"""Objects on the command line, and meshes packed for one message, read again by trimesh."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from client.errors import ObjectError
from client.objects.object_file import pack_mesh, parse_object
from protocol.limits import MAX_MESH_BYTES
from protocol.messages import Spot
from server.scene.mesh import load_mesh
from server.scene.vase import HEIGHT_M, vase_glb
from tests.data import data_folder

OBJ = """mtllib model.mtl
v 0 0 0
v 1 0 0
v 1 2 0
v 0 2 0
v 0 0 3
vt 0 0
vt 1 0
vt 1 0.25
vt 0 0.25
vn 0 0 1
usemtl red paint
f 1/1/1 2/2/1 3/3/1 4/4/1
usemtl picture
f -5 -4 -1  # without coordinates
"""
MTL = """newmtl red paint
Kd 1 0.5 0
newmtl picture
map_Kd -s 1 1 1 my texture.bmp
"""


@pytest.fixture
def obj(tmp_path: Path) -> Path:
    (tmp_path / "model.obj").write_text(OBJ)
    (tmp_path / "model.mtl").write_text(MTL)
    cv2.imwrite(str(tmp_path / "my texture.bmp"), np.full((4, 4, 3), (10, 20, 30), np.uint8))
    return tmp_path / "model.obj"


def document_of(data: bytes) -> tuple[dict, bytes]:
    """JSON and binary chunk, by the container's specification."""
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    json_length, kind = struct.unpack_from("<I4s", data, 12)
    assert (kind, json_length % 4) == (b"JSON", 0)
    bin_length, kind = struct.unpack_from("<I4s", data, 20 + json_length)
    assert (kind, bin_length % 4) == (b"BIN\0", 0)
    assert 28 + json_length + bin_length == length
    return json.loads(data[20 : 20 + json_length]), data[28 + json_length :]


def test_object_forms(tmp_path: Path) -> None:
    file = tmp_path / "sofa.glb"
    file.write_bytes(b"")
    plain = parse_object(str(file))
    assert (plain.path, plain.position_m, plain.scale, plain.yaw_deg) == (file, None, 1.0, 0.0)
    full = parse_object(f"{file}@1,-2.5,3e-1,2,-90")
    assert (full.position_m, full.scale, full.yaw_deg) == ((1.0, -2.5, 0.3), 2.0, -90.0)
    assert parse_object(f"{file}@1,2,3").position_m == (1.0, 2.0, 3.0)
    assert parse_object(f"{file}@1,2,3,0.5").scale == 0.5


def test_at_sign_in_the_name(tmp_path: Path) -> None:
    file = tmp_path / "a@b.glb"
    file.write_bytes(b"")
    assert parse_object(str(file)).position_m is None
    assert parse_object(f"{file}@1,2,3").path == file


@pytest.mark.parametrize(
    ("place", "spot"),
    [
        ("floor", Spot(on="floor")),
        ("table", Spot(on="table")),
        ("auto", Spot(on="auto")),
        ("pixel:320,240.5", Spot(on="pixel", pixel=(320.0, 240.5))),
        ("pixel:320,240:12", Spot(on="pixel", pixel=(320.0, 240.0), frame=12)),
    ],
)
def test_spots(place: str, spot: Spot, tmp_path: Path) -> None:
    file = tmp_path / "sofa.glb"
    file.write_bytes(b"")
    plain = parse_object(f"{file}@{place}")
    assert (plain.spot, plain.position_m, plain.scale, plain.height_m, plain.yaw_deg) == (spot, None, 1.0, None, 0.0)
    sized = parse_object(f"{file}@{place},0.3m,-45")
    assert (sized.spot, sized.height_m, sized.yaw_deg) == (spot, 0.3, -45.0)
    if place != "auto":
        assert parse_object(f"{file}@{place},2").scale == 2.0


def test_a_height_in_place_of_the_scale(tmp_path: Path) -> None:
    file = tmp_path / "sofa.glb"
    file.write_bytes(b"")
    found = parse_object(f"{file}@1,2,3,0.75m,90")
    assert (found.position_m, found.scale, found.height_m, found.yaw_deg) == ((1.0, 2.0, 3.0), 1.0, 0.75, 90.0)


@pytest.mark.parametrize(
    "place",
    [
        *("auto,2", "auto,0m", "auto,-1m", "auto,nanm", "auto,m", "table,", "table,1,2,3", "floor,1m,x", "walls"),
        *(
            "pixel:1",
            "pixel:1,x",
            "pixel:1,2:",
            "pixel:1,2:-3",
            "pixel:1,2:3.5",
            "pixel:nan,2",
            "1,2,3,2000m",
            "ray:1,2",
        ),
    ],
)
def test_spots_that_are_none(place: str, tmp_path: Path) -> None:
    file = tmp_path / "sofa.glb"
    file.write_bytes(b"")
    with pytest.raises(ObjectError, match="--object") as caught:
        parse_object(f"{file}@{place}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "place", ["1,2", "1,2,3,4,5,6", "1,2,x", "nan,0,0", "0,inf,0", "", "1,2,3,0", "1,2,3,-1", "1,2,3,2000", "1,,3"]
)
def test_places_that_are_none(place: str, tmp_path: Path) -> None:
    file = tmp_path / "sofa.glb"
    file.write_bytes(b"")
    with pytest.raises(ObjectError, match="--object") as caught:
        parse_object(f"{file}@{place}")
    assert "\n" not in str(caught.value)


def test_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ObjectError, match="no such file"):
        parse_object(f"{tmp_path}/none.glb@1,2,3")


def test_obj_with_materials_keeps_its_vertices(obj: Path) -> None:
    format_, data = pack_mesh(obj)
    assert format_ == "glb"
    scene = trimesh.load_scene(io.BytesIO(data), file_type="glb")
    triangles = np.concatenate([mesh.triangles for mesh in scene.dump()])
    v = np.array([[0, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 0], [0, 0, 3]], float)
    expected = v[[[0, 1, 2], [0, 2, 3], [0, 1, 4]]]
    np.testing.assert_array_equal(triangles, expected)


def test_obj_materials(obj: Path) -> None:
    document, body = document_of(pack_mesh(obj)[1])
    red, picture = (m["pbrMetallicRoughness"] for m in document["materials"])
    assert red["baseColorFactor"] == pytest.approx([1, 0.21404114, 0, 1])  # sRGB 0.5 decoded
    assert "baseColorTexture" not in red
    assert picture["baseColorTexture"] == {"index": 0}
    view = document["bufferViews"][document["images"][0]["bufferView"]]
    assert document["images"][0]["mimeType"] == "image/png"
    stored = body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    pixels = cv2.imdecode(np.frombuffer(stored, np.uint8), cv2.IMREAD_COLOR)
    assert (pixels == (10, 20, 30)).all()


@pytest.mark.parametrize(
    ("lines", "roughness", "metalness"),
    [
        ("", 1.0, 0.0),
        ("Ns 250", 1.0, 0.0),  # no Ks: nothing shines
        ("Ns 250\nKs 0 0 0", 1.0, 0.0),
        ("Ks 0.5 0.5 0.5\nNs 0", 1.0, 0.0),
        ("Ks 0.5 0.5 0.5\nNs 30", 0.5, 0.0),
        ("Ks 0.5 0.5 0.5\nNs 30\nPr 0.25\nPm 0.75", 0.25, 0.75),
        ("Pr 7\nPm -1", 1.0, 0.0),
    ],
)
def test_obj_roughness_and_metalness(lines: str, roughness: float, metalness: float, obj: Path) -> None:
    (obj.parent / "model.mtl").write_text(MTL.replace("Kd 1 0.5 0", f"Kd 1 0.5 0\n{lines}"))
    red, picture = (m["pbrMetallicRoughness"] for m in document_of(pack_mesh(obj)[1])[0]["materials"])
    assert (red["roughnessFactor"], red["metallicFactor"]) == pytest.approx((roughness, metalness))
    assert (picture["roughnessFactor"], picture["metallicFactor"]) == (1.0, 0.0)


@pytest.mark.parametrize("line", ["Ns many", "Pr nan", "Pm", "Ks 1 1"])
def test_material_that_is_broken(line: str, obj: Path) -> None:
    (obj.parent / "model.mtl").write_text(MTL.replace("Kd 1 0.5 0", f"Kd 1 0.5 0\n{line}"))
    with pytest.raises(ObjectError, match=r"model\.mtl, line 3: .* needs (one|three) number"):
        pack_mesh(obj)


def test_what_an_obj_lacks_is_told(obj: Path) -> None:
    """From the client's reader, inside the GLB, to the notes of the mesh."""
    obj.write_text(OBJ.replace("usemtl red paint", "usemtl gone"))
    (obj.parent / "model.mtl").write_text(MTL + "map_Bump bumps.png\nmap_Ns shine.png\n")
    format_, data = pack_mesh(obj)
    mesh = load_mesh(data, format_)
    assert mesh.notes[-2:] == (
        "of the OBJ's materials, map_Bump, map_Ns were not read",
        "no library of the OBJ has its material 'gone'; what names it is plain grey",
    )
    np.testing.assert_allclose(mesh.vertex_colors[mesh.triangles[0]], 0.8)


@pytest.mark.parametrize(
    ("lines", "roughness", "metalness", "texel"),
    [
        ("map_Pr rough.png\nmap_Pm metal.png\n", 1.0, 1.0, (90, 200)),
        ("map_Pr -s 2 2 1 rough.png\nPr 0.5\nPm 0.25\n", 0.5, 0.25, (90, 255)),
        ("Ks 1 1 1\nNs 30\nmap_Pm metal.png\n", (2 / 32) ** 0.25, 1.0, (255, 200)),
    ],
)
def test_maps_of_roughness_and_metalness(
    lines: str, roughness: float, metalness: float, texel: tuple[int, int], obj: Path
) -> None:
    """One picture of both, of the larger's size; what a map has none of is white; the numbers multiply it."""
    cv2.imwrite(str(obj.parent / "rough.png"), np.full((4, 6), 90, np.uint8))
    cv2.imwrite(str(obj.parent / "metal.png"), np.full((2, 3), 200, np.uint8))
    (obj.parent / "model.mtl").write_text(MTL.replace("newmtl picture", lines + "newmtl picture"))
    mesh = load_mesh(pack_mesh(obj)[1], "glb")
    assert not any("not read" in note for note in mesh.notes)
    (found,) = [m for m in mesh.materials if m.surface_texture is not None]
    assert (found.roughness, found.metalness) == pytest.approx((roughness, metalness))
    assert found.surface_texture is not None
    image = found.surface_texture.image
    assert image.shape == ((4, 6, 3) if "Pr" in lines else (2, 3, 3))
    assert (image[..., 1:] == texel).all()


def test_maps_that_do_not_fit_are_refused(obj: Path) -> None:
    cv2.imwrite(str(obj.parent / "rough.png"), np.full((4, 4), 90, np.uint8))
    (obj.parent / "model.mtl").write_text(MTL + "map_Pr rough.png\nmap_Pm -s 2 2 1 rough.png\n")
    with pytest.raises(ObjectError, match="different options"):
        pack_mesh(obj)
    (obj.parent / "rough.png").write_bytes(b"no picture")
    (obj.parent / "model.mtl").write_text(MTL + "map_Pr rough.png\n")
    with pytest.raises(ObjectError, match=r"rough\.png: the texture cannot be decoded"):
        pack_mesh(obj)


def test_obj_texture_options(obj: Path) -> None:
    """Where the picture is read: at OBJ's own coordinates, scaled and moved, counted from the bottom."""
    (obj.parent / "model.mtl").write_text(
        "newmtl red paint\nmap_Kd -clamp on -s 2 3 1 -o 0.25 0.5 my texture.bmp\n"
        "newmtl picture\nmap_Kd my texture.bmp\n"
    )
    document, _ = document_of(pack_mesh(obj)[1])
    assert len(document["images"]) == 1  # one file, twice
    first, second = (m["pbrMetallicRoughness"]["baseColorTexture"] for m in document["materials"])
    assert "extensions" not in second
    assert "sampler" not in document["textures"][second["index"]]
    sampler = document["samplers"][document["textures"][first["index"]]["sampler"]]
    assert sampler == {"wrapS": 33071, "wrapT": 33071}
    change = first["extensions"]["KHR_texture_transform"]
    u, v = 0.3, 0.9
    moved = np.array([u, 1 - v]) * change["scale"] + change["offset"]
    np.testing.assert_allclose([moved[0], 1 - moved[1]], [2 * u + 0.25, 3 * v + 0.5])


def test_obj_texture_coordinates_are_turned_over(obj: Path) -> None:
    document, body = document_of(pack_mesh(obj)[1])
    with_texture, without = document["meshes"][0]["primitives"]
    assert "TEXCOORD_0" not in without["attributes"]
    accessor = document["accessors"][with_texture["attributes"]["TEXCOORD_0"]]
    offset = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
    uv = np.frombuffer(body, np.float32, accessor["count"] * 2, offset).reshape(-1, 2)
    np.testing.assert_array_equal(uv, [[0, 1], [1, 1], [1, 0.75], [0, 0.75]])


def test_obj_without_materials_goes_as_it_is(tmp_path: Path) -> None:
    file = tmp_path / "plain.obj"
    forwards = OBJ.replace("f -5 -4 -1", "f 1 2 5")
    file.write_text(forwards.replace("mtllib", "# mtllib"))
    assert pack_mesh(file) == ("obj", file.read_bytes())
    file.write_text(forwards)  # names a library that is not there
    assert pack_mesh(file)[0] == "obj"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("f 1/1/1 2/2/1 3/3/1 4/4/1", "f 1/1/1 2/2/1 9/3/1", "line 13"),
        ("f 1/1/1 2/2/1 3/3/1 4/4/1", "f 1/1/1 2/2/1", "line 13"),
        ("v 1 0 0", "v 1 zero 0", "line 3"),
        ("v 1 0 0", "v 1 nan 0", "finite"),
    ],
)
def test_obj_that_is_broken(old: str, new: str, words: str, obj: Path) -> None:
    obj.write_text(OBJ.replace(old, new))
    with pytest.raises(ObjectError, match=words):
        pack_mesh(obj)


def test_missing_texture_is_named(obj: Path) -> None:
    (obj.parent / "my texture.bmp").unlink()
    with pytest.raises(ObjectError, match=r"texture\.bmp.*missing"):
        pack_mesh(obj)


@pytest.mark.parametrize("inline", [True, False])
def test_gltf_becomes_one_glb(inline: bool, tmp_path: Path) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=1)
    mesh.apply_translation((1, 2, 3))
    for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh)).items():
        (tmp_path / name).write_bytes(data)
    path = tmp_path / "model.gltf"
    if inline:
        document = json.loads(path.read_text())
        for buffer in document["buffers"]:
            import base64

            encoded = base64.b64encode((tmp_path / buffer["uri"]).read_bytes()).decode()
            (tmp_path / buffer["uri"]).unlink()
            buffer["uri"] = "data:application/octet-stream;base64," + encoded
        path.write_text(json.dumps(document))
    format_, data = pack_mesh(path)
    assert format_ == "glb"
    assert len(document_of(data)[0]["buffers"]) == 1
    again = trimesh.load(io.BytesIO(data), file_type="glb", force="mesh")
    np.testing.assert_allclose(again.triangles, mesh.triangles, atol=1e-6)


def test_gltf_with_a_missing_part_is_refused(tmp_path: Path) -> None:
    for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(trimesh.creation.box())).items():
        if name == "model.gltf":
            (tmp_path / name).write_bytes(data)
    with pytest.raises(ObjectError, match=r"named by model\.gltf"):
        pack_mesh(tmp_path / "model.gltf")


@pytest.mark.parametrize("kind", ["glb", "ply", "stl"])
def test_others_go_as_they_are(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"box.{kind}"
    trimesh.creation.box().export(path)
    assert pack_mesh(path) == (kind, path.read_bytes())


@pytest.mark.parametrize("kind", ["glb", "gltf", "obj", "ply", "stl", "txt"])
@pytest.mark.parametrize("content", [b"", b"this is no mesh\n", bytes(range(256))])
def test_files_that_are_no_mesh(kind: str, content: bytes, tmp_path: Path) -> None:
    path = tmp_path / f"thing.{kind}"
    path.write_bytes(content)
    with pytest.raises(ObjectError, match=r"thing\.") as caught:
        pack_mesh(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("keep", [12, 30, 1000])
def test_truncated_glb(keep: int, tmp_path: Path) -> None:
    path = tmp_path / "vase.glb"
    path.write_bytes(vase_glb()[:keep])
    with pytest.raises(ObjectError, match=r"vase\.glb"):
        pack_mesh(path)


def test_too_big_is_refused_before_it_is_sent(tmp_path: Path) -> None:
    path = tmp_path / "huge.ply"
    path.write_bytes(b"ply\nelement vertex 1\nend_header\n" + bytes(MAX_MESH_BYTES))
    with pytest.raises(ObjectError, match="simplify"):
        pack_mesh(path)


def test_vase_is_closed_and_stands() -> None:
    mesh = trimesh.load(io.BytesIO(vase_glb()), file_type="glb", force="mesh")
    np.testing.assert_allclose(mesh.bounds[:, 1], (0, HEIGHT_M), atol=0.003)
    normals = mesh.vertex_normals
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-4)
    document, body = document_of(vase_glb())
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    offset = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
    colors = np.frombuffer(body, np.uint8, accessor["count"] * 4, offset).reshape(-1, 4)
    assert len(np.unique(colors, axis=0)) == 3
    closed = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True, merge_norm=True)
    assert closed.is_watertight
    assert closed.is_winding_consistent
    assert closed.volume > 1e-4
    agreement = (closed.face_normals * closed.vertex_normals[closed.faces].mean(axis=1)).sum(axis=1)
    assert agreement.min() > 0.3


def test_indices_that_count_backwards(tmp_path: Path) -> None:
    path = tmp_path / "fan.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 0 0 1\nf -4 -2 -1\n")
    format_, data = pack_mesh(path)
    mesh = trimesh.load(io.BytesIO(data), file_type=format_, force="mesh")
    expected = [[(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 0, 0), (0, 1, 0), (0, 0, 1)]]
    np.testing.assert_array_equal(mesh.triangles, expected)


@pytest.mark.data
@pytest.mark.parametrize("name", ["teapot.obj", "Duck.glb", "bunny_16k.ply"])
def test_public_meshes(name: str) -> None:
    path = data_folder("mesh") / name
    format_, data = pack_mesh(path)
    packed = trimesh.load(io.BytesIO(data), file_type=format_, force="mesh")
    original = trimesh.load(path, force="mesh")
    np.testing.assert_allclose(packed.bounds, original.bounds, rtol=1e-6)
    assert packed.area == pytest.approx(original.area, rel=1e-5)


@pytest.mark.data
def test_cornell_box_has_its_published_size() -> None:
    format_, data = pack_mesh(data_folder("mesh") / "cornell_box_multimaterial.obj")
    scene = trimesh.load_scene(io.BytesIO(data), file_type=format_)
    np.testing.assert_allclose(scene.bounds, [(0, 0, 0), (556, 548.8, 559.2)], atol=1e-3)
    assert len({tuple(mesh.visual.material.baseColorFactor) for mesh in scene.geometry.values()}) == 3
