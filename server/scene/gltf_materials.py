"""Materials of a glTF file: factors and textures of base colour, roughness and metalness (glTF 2.0, 3.9.2).

Factors are linear, base colour textures are sRGB, roughness and metalness are a texture's green and blue. Materials of
alphaMode MASK are cut out, and of BLEND those whose texture says where they are opaque, at half; others are opaque.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from server.scene.gltf_pictures import Pictures
from server.scene.materials import Beyond, Material, Texture

Json = dict[str, Any]

_BEYOND = {10497: Beyond.REPEAT, 33071: Beyond.CLAMP, 33648: Beyond.MIRROR}
"""Wrap modes by their OpenGL numbers in glTF."""


@dataclass(frozen=True)
class TextureUse:
    """Texture coordinates at which a material reads a texture."""

    uv_set: int
    """N of TEXCOORD_N."""
    transform: NDArray[np.float64]
    """[2, 3] affine transform of the file's coordinates (KHR_texture_transform)."""


@dataclass(frozen=True)
class GltfMaterial:
    """A material, the linear factor of its base colour, and its texture coordinates."""

    factor: tuple[float, float, float]
    material: Material
    color_use: TextureUse | None
    surface_use: TextureUse | None


def read_materials(header: Json, binary: bytes | None) -> tuple[list[GltfMaterial], tuple[str, ...]]:
    """All materials of the file, and notes on textures that were not read or were scaled down. Raises MeshError."""
    entries = header.get("materials", [])
    references = [(_reference(m, "baseColorTexture"), _reference(m, "metallicRoughnessTexture")) for m in entries]
    pictures = Pictures(header, binary)
    pictures.load({index for pair in references for ref in pair if (index := _image_of(header, ref)) is not None})
    textures: dict[tuple[int, tuple[Beyond, Beyond], bool, bool], Texture] = {}

    def texture_of(reference: Json | None, *, is_srgb: bool, with_alpha: bool = False) -> Texture | None:
        listed = _image_of(header, reference)
        index = None if listed is None else pictures.same_as(listed)
        image = None if index is None else pictures.image(index, is_srgb=is_srgb)
        if reference is None or index is None or image is None:
            return None
        key = (index, _beyond(header, reference), is_srgb, with_alpha)
        if key not in textures:
            textures[key] = Texture(image, key[1], pictures.alpha(index) if with_alpha else None)
        return textures[key]

    materials = []
    for entry, (color, surface) in zip(entries, references, strict=True):
        values = _metallic_roughness(entry)
        mode = entry.get("alphaMode", "OPAQUE")
        color_texture = texture_of(color, is_srgb=True, with_alpha=mode in {"MASK", "BLEND"})
        surface_texture = texture_of(surface, is_srgb=False)
        material = Material(
            roughness=_unit(values.get("roughnessFactor", 1.0)),
            metalness=_unit(values.get("metallicFactor", 1.0)),
            color_texture=color_texture,
            surface_texture=surface_texture,
            cutoff=_cutoff(entry, mode, color_texture),
            opacity=_unit((*values.get("baseColorFactor", ()), 1.0, 1.0, 1.0, 1.0)[3]),
        )
        uses = (_use(ref) if found else None for ref, found in ((color, color_texture), (surface, surface_texture)))
        materials.append(GltfMaterial(_factor(values), material, *uses))
    blended = [m.material.cutoff for m, e in zip(materials, entries, strict=True) if e.get("alphaMode") == "BLEND"]
    cut = sum(cutoff is not None for cutoff in blended)
    notes = [f"{cut} materials are transparent in places; what is less than half opaque is left out"] if cut else []
    if len(blended) > cut:
        notes.append(f"{len(blended) - cut} materials are transparent; they are shown opaque")
    return materials, (*pictures.notes, *notes)


def _cutoff(material: Json, mode: str, color: Texture | None) -> float | None:
    if mode == "MASK":
        return float(np.nan_to_num(float(material.get("alphaCutoff", 0.5))))
    return 0.5 if mode == "BLEND" and color is not None and color.alpha is not None else None


def _metallic_roughness(material: Json) -> Json:
    values: Json = material.get("pbrMetallicRoughness", {})
    return values


def _reference(material: Json, name: str) -> Json | None:
    return _metallic_roughness(material).get(name)


def _image_of(header: Json, reference: Json | None) -> int | None:
    """Index of the image of a texture reference; -1 if it does not exist."""
    if reference is None:
        return None
    try:
        source = header["textures"][reference["index"]].get("source")
    except (KeyError, IndexError):
        return -1
    return None if source is None else int(source)


def _beyond(header: Json, reference: Json) -> tuple[Beyond, Beyond]:
    sampler = header["textures"][reference["index"]].get("sampler")
    modes: Json = {} if sampler is None else header["samplers"][sampler]
    u, v = (_BEYOND.get(modes.get(axis, 0), Beyond.REPEAT) for axis in ("wrapS", "wrapT"))
    return u, v


def _factor(values: Json) -> tuple[float, float, float]:
    red, green, blue = (_unit(value) for value in values.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0))[:3])
    return red, green, blue


def _unit(value: float) -> float:
    """Clipped to [0, 1]; NaN becomes 0."""
    return float(np.clip(np.nan_to_num(float(value)), 0.0, 1.0))


def _use(reference: Json | None) -> TextureUse | None:
    """KHR_texture_transform: scale, rotation by [[cos, sin], [-sin, cos]], translation."""
    if reference is None:
        return None
    change = reference.get("extensions", {}).get("KHR_texture_transform", {})
    angle_rad = float(change.get("rotation", 0.0))
    turn = np.array([[math.cos(angle_rad), math.sin(angle_rad)], [-math.sin(angle_rad), math.cos(angle_rad)]])
    transform = np.column_stack([turn * change.get("scale", (1.0, 1.0)), change.get("offset", (0.0, 0.0))])
    return TextureUse(int(change.get("texCoord", reference.get("texCoord", 0))), transform.astype(np.float64))
