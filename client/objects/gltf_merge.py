"""Puts the content of one glTF document into another, with all its meshes, materials and textures."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

from client.objects.glb import check_glb
from server.scene.glb import append

Json = dict[str, Any]

_LISTS = ("accessors", "bufferViews", "images", "samplers", "textures", "materials", "meshes", "nodes")
_ANIMATED = ("skin", "camera", "extensions")
"""Of nodes, left out: the object stands still, and has no cameras and lights of its own."""
_EXTENSION_LISTS = ("extensionsUsed", "extensionsRequired")


def append_glb(document: Json, body: bytearray, data: bytes, name: Path) -> list[int]:
    """Append a GLB's default scene to `document` with buffer `body`; returns its root nodes. `name`: for errors.

    Animations, skins, cameras and lights are left out. Raises ObjectError for a file that is no GLB.
    """
    added = check_glb(name, data)
    start = append(body, _binary(data))
    first = {key: len(document.get(key, [])) for key in _LISTS}
    for view in added.get("bufferViews", []):
        view["byteOffset"] = view.get("byteOffset", 0) + start
    for node in added.get("nodes", []):
        for key in _ANIMATED:
            node.pop(key, None)
    scenes = added.get("scenes", [])
    roots = scenes[added.get("scene", 0)].get("nodes", []) if scenes else _without_parent(added)
    for key in _LISTS:
        for item in added.get(key, []):
            _shift(key, item, first)
        if added.get(key):
            document.setdefault(key, []).extend(added[key])
    for key in _EXTENSION_LISTS:
        for extension in added.get(key, []):
            if extension != "KHR_lights_punctual" and extension not in document.setdefault(key, []):
                document[key].append(extension)
    return [root + first["nodes"] for root in roots]


def _binary(data: bytes) -> bytes:
    """The second chunk."""
    (json_length,) = struct.unpack_from("<I", data, 12)
    at = 20 + json_length
    if at + 8 > len(data):
        return b""
    (length,) = struct.unpack_from("<I", data, at)
    return data[at + 8 : at + 8 + length]


def _without_parent(document: Json) -> list[int]:
    children = {child for node in document.get("nodes", []) for child in node.get("children", [])}
    return [index for index in range(len(document.get("nodes", []))) if index not in children]


def _shift(key: str, item: Json, first: dict[str, int]) -> None:
    """Add to each index in an item of list `key` the number of items that were there before."""
    moved = json.loads(json.dumps(item))
    _shift_fields(moved, _FIELDS[key], first)
    for primitive in moved.get("primitives", []) if key == "meshes" else ():
        primitive.pop("extensions", None)
        _shift_fields(primitive, {"indices": "accessors", "material": "materials"}, first)
        for attributes in (primitive.get("attributes", {}), *primitive.get("targets", [])):
            _shift_fields(attributes, dict.fromkeys(attributes, "accessors"), first)
    if key == "accessors" and "sparse" in moved:
        for part in ("indices", "values"):
            _shift_fields(moved["sparse"][part], {"bufferView": "bufferViews"}, first)
    if key == "nodes" and "children" in moved:
        moved["children"] = [child + first["nodes"] for child in moved["children"]]
    if key == "materials":
        _shift_textures(moved, first)
    if key == "textures":
        for extension in moved.get("extensions", {}).values():
            _shift_fields(extension, {"source": "images"}, first)
    item.clear()
    item.update(moved)


_FIELDS = {
    "accessors": {"bufferView": "bufferViews"},
    "bufferViews": {},
    "images": {"bufferView": "bufferViews"},
    "samplers": {},
    "textures": {"source": "images", "sampler": "samplers"},
    "materials": {},
    "meshes": {},
    "nodes": {"mesh": "meshes"},
}


def _shift_fields(item: Json, fields: dict[str, str], first: dict[str, int]) -> None:
    for name, target in fields.items():
        if name in item:
            item[name] += first[target]


def _shift_textures(item: Any, first: dict[str, int]) -> None:
    """Texture references of a material, of its extensions too: objects `...Texture` with an index."""
    for name, value in item.items() if isinstance(item, dict) else ():
        if name.lower().endswith("texture") and isinstance(value, dict) and "index" in value:
            value["index"] += first["textures"]
        else:
            _shift_textures(value, first)
