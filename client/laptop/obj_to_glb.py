"""An OBJ with its material libraries and textures as one GLB: the same vertices, axes and units.

`Kd` is taken as sRGB, as textures are; glTF's factors are linear. Roughness is `Pr`, or what shines as `Ns` does;
metalness is `Pm`. Of the maps, `map_Kd` is read, with its options -s, -o and -clamp; others are told in a note.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.laptop import glb
from client.laptop.errors import ObjectError

Corner = tuple[int, int, int]
"""Indices of position, texture coordinate and normal; -1 = none."""


@dataclass
class _Group:
    """Faces of one material."""

    corners: dict[Corner, int] = field(default_factory=dict)
    triangles: list[tuple[int, int, int]] = field(default_factory=list)


@dataclass
class _Model:
    positions: list[list[float]] = field(default_factory=list)
    """x y z, and r g b (0 to 1) where the file has vertex colours."""
    coordinates: list[list[float]] = field(default_factory=list)
    normals: list[list[float]] = field(default_factory=list)
    groups: dict[str, _Group] = field(default_factory=dict)


@dataclass(frozen=True)
class ColorMap:
    """A `map_Kd`."""

    file: Path
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    clamp: bool = False


@dataclass(frozen=True)
class Material:
    """What is kept of an MTL material."""

    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """sRGB, 0 to 1."""
    texture: ColorMap | None = None
    specular: tuple[float, float, float] = (0.0, 0.0, 0.0)
    exponent: float | None = None
    """Of Phong's highlight."""
    given_roughness: float | None = None
    metalness: float = 0.0
    unread: frozenset[str] = frozenset()
    """Maps it has that are not read."""

    @property
    def roughness(self) -> float:
        """Perceptual, 0 to 1. A highlight of exponent n is that of microfacets with alpha^2 = 2 / (n + 2) (Karis 2013).

        Without one, or where it is black: 1.
        """
        if self.given_roughness is not None:
            return self.given_roughness
        shines = self.exponent is not None and any(self.specular)
        return (2 / (max(self.exponent or 0.0, 0.0) + 2)) ** 0.25 if shines else 1.0


def libraries(path: Path, text: str) -> list[Path]:
    """The material libraries of an OBJ that exist."""
    names = [line.split(maxsplit=1)[1].strip() for line in text.splitlines() if line.startswith("mtllib ")]
    return [path.parent / name for name in names if (path.parent / name).is_file()]


def counts_backwards(text: str) -> bool:
    """True if a face names its corners from the last one on, with negative numbers."""
    return any(line.startswith("f ") and "-" in line.split("#")[0] for line in text.splitlines())


def convert(path: Path, text: str, mtl_files: list[Path]) -> bytes:
    """GLB bytes; what was not found is told in `asset.extras.notes`. Raises ObjectError naming the file and line."""
    materials = {name: m for file in mtl_files for name, m in _read_materials(file).items()}
    unread = sorted({key for m in materials.values() for key in m.unread})
    model = _read_obj(path, text)
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": []}],
    }
    body, images, notes = bytearray(), dict[Path, int](), list[str]()
    if unread:
        notes.append(f"of the OBJ's materials, {', '.join(unread)} were not read")
    for name, group in model.groups.items():
        if group.triangles:
            primitive = _primitive(document, body, model, group)
            if name in materials:
                primitive["material"] = _add_material(document, body, materials[name], images)
            elif name:
                notes.append(f"no library of the OBJ has its material {name[:40]!r}; what names it is plain grey")
            document["meshes"][0]["primitives"].append(primitive)
    if notes:
        document["asset"]["extras"] = {"notes": notes}
    return glb.to_bytes(document, body)


def _read_obj(path: Path, text: str) -> _Model:
    model = _Model()
    group = model.groups.setdefault("", _Group())
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].split()
        try:
            match words:
                case ["v", *values]:
                    model.positions.append([float(x) for x in values])
                case ["vt", *values]:
                    model.coordinates.append([float(x) for x in values[:2]])
                case ["vn", *values]:
                    model.normals.append([float(x) for x in values[:3]])
                case ["usemtl", *name]:
                    group = model.groups.setdefault(" ".join(name), _Group())
                case ["f", *corners]:
                    _add_face(model, group, corners)
        except (ValueError, IndexError):
            raise ObjectError(f"{path}, line {number}: {line.strip()[:60]!r} is no valid OBJ line") from None
    return model


def _add_face(model: _Model, group: _Group, words: list[str]) -> None:
    """A polygon as a fan of triangles."""
    if len(words) < 3:
        raise ValueError
    indices = [group.corners.setdefault(_corner(model, word), len(group.corners)) for word in words]
    group.triangles += [(indices[0], b, c) for b, c in pairwise(indices[1:])]


def _corner(model: _Model, word: str) -> Corner:
    parts = [*word.split("/"), "", ""]
    counts = (len(model.positions), len(model.coordinates), len(model.normals))
    p, t, n = (_index(part, count) for part, count in zip(parts[:3], counts, strict=True))
    if p < 0:
        raise ValueError
    return p, t, n


def _index(part: str, count: int) -> int:
    """0-based; OBJ counts from 1, or backwards from the last with negative numbers."""
    if not part:
        return -1
    number = int(part)
    index = number - 1 if number > 0 else count + number
    if not 0 <= index < count:
        raise IndexError
    return index


def _primitive(document: dict[str, Any], body: bytearray, model: _Model, group: _Group) -> dict[str, Any]:
    corners = np.array(list(group.corners), np.int64)
    vertices = [model.positions[i] for i in corners[:, 0]]
    attributes = {"POSITION": glb.add_array(document, body, _floats([v[:3] for v in vertices], 3), bounds=True)}
    if all(len(v) >= 6 for v in vertices):
        colors = np.round(np.clip(_floats([v[3:6] for v in vertices], 3), 0, 1) * 255).astype(np.uint8)
        opaque = np.full((len(colors), 1), 255, np.uint8)
        attributes["COLOR_0"] = glb.add_array(document, body, np.hstack([colors, opaque]))
    if (corners[:, 2] >= 0).all():
        normals = _floats([model.normals[i] for i in corners[:, 2]], 3)
        attributes["NORMAL"] = glb.add_array(document, body, normals)
    if (corners[:, 1] >= 0).all():
        uv = _floats([model.coordinates[i] for i in corners[:, 1]], 2)
        # OBJ counts v from the bottom, glTF from the top.
        attributes["TEXCOORD_0"] = glb.add_array(document, body, uv * np.float32([1, -1]) + np.float32([0, 1]))
    indices = np.array(group.triangles, np.uint32).ravel()
    return {"attributes": attributes, "indices": glb.add_array(document, body, indices)}


def _floats(rows: list[list[float]], columns: int) -> NDArray[np.float32]:
    values = np.array(rows, np.float32)
    if values.shape[1:] != (columns,) or not np.isfinite(values).all():
        raise ObjectError(f"the OBJ has a vertex, normal or texture coordinate without {columns} finite numbers")
    return values


def _read_materials(path: Path) -> dict[str, Material]:
    materials: dict[str, Material] = {}
    name = ""
    for number, line in enumerate(path.read_text("utf-8", errors="replace").splitlines(), 1):
        match line.split("#")[0].split():
            case ["newmtl", *words]:
                name = " ".join(words)
                materials[name] = Material()
            case ["map_Kd", *words] if name in materials and words:
                materials[name] = replace(materials[name], texture=_color_map(path, words))
            case [
                ("map_Pr" | "map_Pm" | "map_Ns" | "map_Ks" | "map_d" | "map_Bump" | "map_bump" | "norm") as key,
                *_,
            ] if name in materials:
                materials[name] = replace(materials[name], unread=materials[name].unread | {key})
            case [key, *words] if name in materials and key in _FIELDS:
                field, count = _FIELDS[key]
                values = _numbers(path, number, key, words, count)
                if key != "Ns":
                    values = [min(max(value, 0.0), 1.0) for value in values]
                change = {field: tuple(values) if count > 1 else values[0]}
                materials[name] = replace(materials[name], **change)  # type: ignore[arg-type]
    return materials


_FIELDS = {
    "Kd": ("color", 3),
    "Ks": ("specular", 3),
    "Ns": ("exponent", 1),
    "Pr": ("given_roughness", 1),
    "Pm": ("metalness", 1),
}
"""By the MTL's name: the field of Material, and how many numbers it has."""


def _numbers(path: Path, number: int, key: str, words: list[str], count: int) -> list[float]:
    try:
        values = [float(word) for word in words[:count]]
    except ValueError:
        values = []
    if len(values) < count or not np.isfinite(values).all():
        counted = {1: "one number", 2: "two numbers", 3: "three numbers"}[count]
        raise ObjectError(f"{path}, line {number}: {key} needs {counted}")
    return values


def _color_map(path: Path, words: list[str]) -> ColorMap:
    """The file after map_Kd's options; file names may have spaces, so the longest tail that exists wins."""
    for start in range(len(words)):
        file = path.parent / " ".join(words[start:]).replace("\\", "/")
        if file.is_file():
            scale, offset = (_option(words[:start], name, default) for name, default in (("-s", 1.0), ("-o", 0.0)))
            return ColorMap(file, scale, offset, clamp="-clamp on" in " ".join(words[:start]).lower())
    raise ObjectError(f"{path.parent / words[-1]}: the texture that {path.name} names is missing")


def _option(words: list[str], name: str, default: float) -> tuple[float, float]:
    """The first two numbers after an option that has up to three."""
    values = [default, default]
    if name in words:
        for k, word in enumerate(words[words.index(name) + 1 :][:2]):
            try:
                values[k] = float(word)
            except ValueError:
                break
    return values[0], values[1]


def _add_material(document: dict[str, Any], body: bytearray, material: Material, images: dict[Path, int]) -> int:
    srgb = np.array(material.color)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    surface: dict[str, Any] = {
        "baseColorFactor": [*linear.tolist(), 1.0],
        "metallicFactor": material.metalness,
        "roughnessFactor": material.roughness,
    }
    if material.texture is not None:
        surface["baseColorTexture"] = _add_texture(document, body, material.texture, images)
    document.setdefault("materials", []).append({"pbrMetallicRoughness": surface, "doubleSided": True})
    return len(document["materials"]) - 1


def _add_texture(
    document: dict[str, Any], body: bytearray, texture: ColorMap, images: dict[Path, int]
) -> dict[str, Any]:
    """A reference to the texture. OBJ's v counts from the bottom: v' = s v + o is 1 - v' = s (1 - v) + 1 - s - o."""
    if texture.file not in images:
        images[texture.file] = glb.add_image(document, body, texture.file.read_bytes(), texture.file)
    entry = {"source": images[texture.file]}
    if texture.clamp:
        document.setdefault("samplers", []).append({"wrapS": 33071, "wrapT": 33071})
        entry["sampler"] = len(document["samplers"]) - 1
    document.setdefault("textures", []).append(entry)
    reference: dict[str, Any] = {"index": len(document["textures"]) - 1}
    if texture.scale != (1.0, 1.0) or texture.offset != (0.0, 0.0):
        offset = [texture.offset[0], 1 - texture.scale[1] - texture.offset[1]]
        reference["extensions"] = {"KHR_texture_transform": {"scale": [*texture.scale], "offset": offset}}
        document["extensionsUsed"] = ["KHR_texture_transform"]
    return reference
