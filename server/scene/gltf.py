"""Prepares a glTF file for trimesh: checks limits and assigns materials to parts.

trimesh stores factors as 8-bit numbers and needs Pillow for textures, so gltf_materials.py reads the materials. Here a
material's name is replaced by its index, by which a part is matched with it later, and texture coordinates get names
that trimesh passes through.
"""

from __future__ import annotations

import json
import struct
from collections import Counter
from typing import Any

from server.scene.gltf_materials import GltfMaterial, Json, read_materials
from server.scene.limits import MAX_PARTS, MAX_TRIANGLES, MAX_VERTICES, MeshError

COLOR_UV, SURFACE_UV = "_COLOR_UV", "_SURFACE_UV"
"""Attributes of a primitive: texture coordinates of base colour, and of roughness and metalness."""

_MAGIC, _JSON, _BIN = b"glTF", 0x4E4F534A, 0x004E4942
_COMPRESSIONS = {"KHR_draco_mesh_compression", "EXT_meshopt_compression"}
_KNOWN_EXTENSIONS = {"KHR_texture_transform", "KHR_materials_unlit"}
_MOST_DEPTH = 256
_MOST_NOTES, _NOTE_CHARS = 8, 200
_TRIANGLES, _STRIP = 4, 5


def prepare_gltf(data: bytes) -> tuple[bytes, list[GltfMaterial], tuple[str, ...]]:
    """The file (GLB or JSON) for trimesh, its materials, and notes.

    Raises MeshError for a refused file, and whatever indexing raises for invalid references (KeyError, IndexError ...).
    """
    header, binary = _split_glb(data) if data.startswith(_MAGIC) else (_parse(data), None)
    _refuse_unsupported(header)
    _refuse_tangled(header)
    _refuse_oversized(header)
    materials, notes = read_materials(header, binary)
    notes += _connect_materials(header, materials) + _told(header)
    for key in ("images", "textures", "samplers", "animations", "skins"):  # trimesh must not read these
        header.pop(key, None)
    header["materials"] = [{"name": str(index)} for index in range(len(materials))]
    return _join_glb(header, binary) if data.startswith(_MAGIC) else json.dumps(header).encode(), materials, notes


def _connect_materials(header: Json, materials: list[GltfMaterial]) -> tuple[str, ...]:
    """Set the texture coordinates of each primitive's material; returns notes."""
    problems: Counter[str] = Counter()
    for primitive in (primitive for mesh in header.get("meshes", []) for primitive in mesh["primitives"]):
        attributes, index = primitive["attributes"], primitive.get("material")
        if primitive.get("mode", _TRIANGLES) not in (_TRIANGLES, _STRIP):
            problems["are points, lines or fans and were not read"] += 1
        if index is not None and not (isinstance(index, int) and 0 <= index < len(materials)):
            problems["name a material that does not exist; they keep the plain colour"] += 1
            del primitive["material"]
        elif index is not None:
            for name, use in ((COLOR_UV, materials[index].color_use), (SURFACE_UV, materials[index].surface_use)):
                if use is not None and f"TEXCOORD_{use.uv_set}" in attributes:
                    attributes[name] = attributes[f"TEXCOORD_{use.uv_set}"]
                elif use is not None:
                    problems["have a texture but no coordinates for it; they keep the plain colour"] += 1
        attributes.pop("TEXCOORD_0", None)
    return tuple(f"{count} parts {what}" for what, count in problems.items())


def _told(header: Json) -> tuple[str, ...]:
    """Notes of the file's author (client/objects/obj_to_glb.py writes them) and on unsupported extensions."""
    notes = header["asset"].get("extras", {}).get("notes", [])
    told = tuple(" ".join(str(note).split())[:_NOTE_CHARS] for note in notes[:_MOST_NOTES])
    missing = {str(name) for name in header.get("extensionsRequired", [])} - _KNOWN_EXTENSIONS
    if missing:
        told += (f"the file needs {', '.join(sorted(missing))[:_NOTE_CHARS]}, which is not read: it may look wrong",)
    return told


def _parse(text: bytes) -> Json:
    try:
        header = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise MeshError(f"not a glTF file: its JSON does not parse ({error})") from error
    if not isinstance(header, dict) or "asset" not in header:
        raise MeshError("not a glTF file: it has no `asset`")
    return header


def _split_glb(data: bytes) -> tuple[Json, bytes | None]:
    """The JSON and the binary chunk of a GLB container."""
    chunks: dict[int, bytes] = {}
    at = 12
    while at + 8 <= len(data):
        length, kind = struct.unpack_from("<II", data, at)
        if at + 8 + length > len(data):
            raise MeshError(f"truncated GLB: a chunk of {length} bytes is announced, {len(data) - at - 8} are there")
        chunks.setdefault(kind, data[at + 8 : at + 8 + length])
        at += 8 + length
    if _JSON not in chunks:
        raise MeshError("not a GLB file: it has no JSON chunk")
    return _parse(chunks[_JSON]), chunks.get(_BIN)


def _join_glb(header: Json, binary: bytes | None) -> bytes:
    text = json.dumps(header).encode()
    chunks = [(_JSON, text + b" " * (-len(text) % 4))]
    if binary is not None:
        chunks.append((_BIN, binary + b"\0" * (-len(binary) % 4)))
    body = b"".join(struct.pack("<II", len(content), kind) + content for kind, content in chunks)
    return _MAGIC + struct.pack("<II", 2, 12 + len(body)) + body


def _refuse_unsupported(header: Json) -> None:
    used = _COMPRESSIONS & {str(name) for name in header.get("extensionsUsed", [])}
    if used:
        raise MeshError(f"the model is compressed with {', '.join(sorted(used))}: export it without compression")
    for buffer in header.get("buffers", []):
        uri = buffer.get("uri")
        if uri is not None and not str(uri).startswith("data:"):
            raise MeshError("the glTF keeps its data in another file: export it as GLB, or with embedded buffers")


def _refuse_tangled(header: Json) -> None:
    """Refuse a scene graph that is not a tree: a node with two parents, or that is its own ancestor."""
    nodes: list[Any] = header.get("nodes", [])
    if len(nodes) > MAX_PARTS:
        raise MeshError(f"the glTF has more than {MAX_PARTS} parts: join them")
    parent: dict[int, int] = {}
    for index, node in enumerate(nodes):
        for child in node.get("children", []):
            if not 0 <= child < len(nodes):
                raise MeshError(f"damaged glTF: node {index} has child {child}, there are {len(nodes)} nodes")
            if child in parent:
                raise MeshError(f"damaged glTF: node {child} has two parents, its scene graph is no tree")
            parent[child] = index
    for index in range(len(nodes)):
        at, steps = index, 0
        while at in parent and steps <= _MOST_DEPTH:
            at, steps = parent[at], steps + 1
        if steps > _MOST_DEPTH:
            raise MeshError(f"damaged glTF: node {index} is in a circle, or more than {_MOST_DEPTH} levels deep")


def _refuse_oversized(header: Json) -> None:
    """Refuse files that expand to a large model: many primitives that read the same bytes."""
    accessors = [int(accessor["count"]) for accessor in header.get("accessors", [])]
    primitives = [p for mesh in header.get("meshes", []) for p in mesh["primitives"]]
    corners = sum(accessors[p["indices"]] for p in primitives if "indices" in p)
    vertices = sum(accessors[p["attributes"]["POSITION"]] for p in primitives)
    if corners > MAX_VERTICES or vertices > MAX_VERTICES:
        raise MeshError(f"more than {MAX_TRIANGLES} triangles: {max(corners, vertices)} vertices; simplify the model")
    if min(accessors, default=0) < 0 or sum(accessors) > 8 * MAX_VERTICES:
        raise MeshError("damaged glTF: its accessors are too large")
    if len(primitives) > MAX_PARTS:
        raise MeshError(f"the glTF has more than {MAX_PARTS} parts: join them")
