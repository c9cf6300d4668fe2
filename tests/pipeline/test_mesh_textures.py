"""Textures of meshes: pictures, coordinates, sizes."""

from __future__ import annotations

import struct
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from server.scene import gltf_pictures
from server.scene.cutout import Outline
from server.scene.limits import MAX_CUTOUTS
from server.scene.materials import Beyond
from server.scene.mesh import MeshError, load_mesh
from tests.scenes.gltf_files import QUAD, QUAD_UV, Gltf, assert_well_formed, color_uv, shown_texture


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
        np.testing.assert_allclose(found[tuple(place)], at, atol=1e-6)


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
    images = []
    for grey in range(6):
        material = file.texture(np.full((128, 128, 3), grey, np.uint8))
        images += file.header["images"]
    file.header["images"] = images
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


def many_materials(count: int, picture: NDArray[np.uint8], **material: object) -> Gltf:
    """A square for each of `count` materials with an image of its own; the bytes of all images are the same."""
    file = Gltf()
    file.quad(file.texture(picture), TEXCOORD_0=QUAD_UV)
    file.header["images"] = [dict(file.header["images"][0]) for _ in range(count)]
    file.header["textures"] = [{"source": k} for k in range(count)]
    file.header["materials"] = [
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": k}}} | material for k in range(count)
    ]
    first = file.header["meshes"][0]["primitives"][0]
    file.header["meshes"][0]["primitives"] = [
        first | {"material": k, "attributes": dict(first["attributes"])} for k in range(count)
    ]
    return file


def test_a_picture_is_decoded_once_for_all_its_materials(monkeypatch: pytest.MonkeyPatch) -> None:
    decode = Mock(wraps=gltf_pictures._decode)
    monkeypatch.setattr(gltf_pictures, "_decode", decode)
    picture = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    mesh = load_mesh(many_materials(200, picture).glb(), "glb")
    assert decode.call_count == 1
    assert shown_texture(mesh).image.tobytes() == picture.tobytes()
    assert len({id(m.color_texture) for m in mesh.materials}) == 1


def test_a_cutout_is_made_ready_once_for_all_its_materials(monkeypatch: pytest.MonkeyPatch) -> None:
    outline_of = Mock(wraps=Outline.of)
    monkeypatch.setattr(Outline, "of", outline_of)
    picture = np.full((64, 64, 4), 255, np.uint8)
    picture[:, :40, 3] = 0
    load_mesh(many_materials(50, picture, alphaMode="MASK").glb(), "glb")
    assert outline_of.call_count == 1


def test_too_many_different_cutouts_are_refused() -> None:
    picture = np.full((8, 8, 4), 255, np.uint8)
    picture[:, :5, 3] = 0
    file = many_materials(MAX_CUTOUTS + 1, picture, alphaMode="MASK")
    for k, material in enumerate(file.header["materials"]):
        material["alphaCutoff"] = 0.1 + 0.001 * k
    with pytest.raises(MeshError, match=f"more than {MAX_CUTOUTS} materials are cut out"):
        load_mesh(file.glb(), "glb")


@pytest.mark.parametrize(
    ("limit", "most", "told"),
    [("MAX_DECODED_PIXELS", 2 * 64 * 64, "more than 8192 pixels together"), ("MAX_IMAGE_BYTES", 100, "MiB together")],
)
def test_pictures_are_bounded_together_before_one_is_decoded(
    monkeypatch: pytest.MonkeyPatch, limit: str, most: int, told: str
) -> None:
    monkeypatch.setattr(gltf_pictures, limit, most)
    monkeypatch.setattr(gltf_pictures, "_decode", Mock(side_effect=AssertionError))
    file = many_materials(3, np.zeros((64, 64, 3), np.uint8))
    for grey in range(3):
        file.header["images"][grey] = {"bufferView": file.view(_png(grey)), "mimeType": "image/png"}
    with pytest.raises(MeshError, match=told):
        load_mesh(file.glb(), "glb")


def _png(grey: int) -> bytes:
    done, encoded = cv2.imencode(".png", np.full((64, 64, 3), grey, np.uint8))
    assert done
    return encoded.tobytes()
