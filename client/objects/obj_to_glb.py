"""Conversion of an OBJ with material libraries and textures to one GLB with the same vertices, axes and units.

`Kd` is sRGB, like textures; glTF's factors are linear. Roughness is `Pr`, or follows from `Ns`; metalness is `Pm`.
`map_Kd`, `map_Pr` and `map_Pm` are read with their options -s, -o and -clamp; a note names other maps.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from client.errors import ObjectError
from client.objects import glb
from client.objects.mtl import Material, TextureMap, read_materials

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


def libraries(path: Path, text: str) -> list[Path]:
    """Existing material libraries of an OBJ."""
    names = [line.split(maxsplit=1)[1].strip() for line in text.splitlines() if line.startswith("mtllib ")]
    return [path.parent / name for name in names if (path.parent / name).is_file()]


def has_negative_indices(text: str) -> bool:
    """Whether a face has negative indices, which count from the last vertex."""
    return any(line.startswith("f ") and "-" in line.split("#")[0] for line in text.splitlines())


def convert(path: Path, text: str, mtl_files: list[Path]) -> bytes:
    """GLB bytes; `asset.extras.notes` names what was not found. Raises ObjectError with file and line."""
    materials = {name: m for file in mtl_files for name, m in read_materials(file).items()}
    unread = sorted({key for m in materials.values() for key in m.unread})
    model = _read_obj(path, text)
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": []}],
    }
    body, images, notes = bytearray(), dict[tuple[Path, ...], int](), list[str]()
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
    """0-based index; OBJ counts from 1, and negative numbers from the last element."""
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
        # v points up in OBJ, down in glTF.
        flipped = uv * np.array([1, -1], np.float32) + np.array([0, 1], np.float32)
        attributes["TEXCOORD_0"] = glb.add_array(document, body, flipped)
    indices = np.array(group.triangles, np.uint32).ravel()
    return {"attributes": attributes, "indices": glb.add_array(document, body, indices)}


def _floats(rows: list[list[float]], columns: int) -> NDArray[np.float32]:
    values = np.array(rows, np.float32)
    if values.shape[1:] != (columns,) or not np.isfinite(values).all():
        raise ObjectError(f"the OBJ has a vertex, normal or texture coordinate without {columns} finite numbers")
    return values


def _add_material(
    document: dict[str, Any], body: bytearray, material: Material, images: dict[tuple[Path, ...], int]
) -> int:
    srgb = np.array(material.color)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    surface: dict[str, Any] = {
        "baseColorFactor": [*linear.tolist(), 1.0],
        "metallicFactor": material.metalness,
        "roughnessFactor": material.roughness,
    }
    if material.texture is not None:
        files = (material.texture.file,)
        if files not in images:
            images[files] = glb.add_image(document, body, material.texture.file.read_bytes(), material.texture.file)
        surface["baseColorTexture"] = _add_texture(document, material.texture, images[files])
    if material.roughness_map is not None or material.metalness_map is not None:
        surface["metallicRoughnessTexture"] = _add_surface(document, body, material, images)
    document.setdefault("materials", []).append({"pbrMetallicRoughness": surface, "doubleSided": True})
    return len(document["materials"]) - 1


def _add_surface(
    document: dict[str, Any], body: bytearray, material: Material, images: dict[tuple[Path, ...], int]
) -> dict[str, Any]:
    """A reference to one picture of both maps as in glTF: roughness in green, metalness in blue, 255 without a map.

    Raises ObjectError if the options of the two maps differ.
    """
    roughness, metalness = material.roughness_map, material.metalness_map
    if roughness and metalness and replace(roughness, file=metalness.file) != metalness:
        raise ObjectError(
            f"{metalness.file.name} and {roughness.file.name} have different options: give map_Pm those of map_Pr"
        )
    place = roughness or metalness
    assert place is not None
    files = tuple(each.file if each else Path() for each in (roughness, metalness))
    if files not in images:
        green, blue = (None if each is None else _read_grey(each.file) for each in (roughness, metalness))
        height, width = np.max([picture.shape for picture in (green, blue) if picture is not None], axis=0)
        channels = [
            np.full((height, width), 255, np.uint8) if picture is None else cv2.resize(picture, (width, height))
            for picture in (blue, green, None)
        ]
        data = cv2.imencode(".png", np.stack(channels, axis=-1))[1].tobytes()  # cv2 expects blue, green, red
        images[files] = glb.add_image(document, body, data, place.file)
    return _add_texture(document, place, images[files])


def _read_grey(file: Path) -> NDArray[np.uint8]:
    """[h, w] red channel of a picture. Raises ObjectError."""
    picture = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if picture is None:
        raise ObjectError(f"{file}: the texture cannot be decoded; save it as PNG or JPEG")
    return np.ascontiguousarray(picture[..., 2], np.uint8)


def _add_texture(document: dict[str, Any], texture: TextureMap, image: int) -> dict[str, Any]:
    """A reference to an image. OBJ's v points up: v' = s v + o is 1 - v' = s (1 - v) + 1 - s - o in glTF."""
    entry = {"source": image}
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
