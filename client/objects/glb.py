"""GLB containers: checking, and packing of a glTF with its files.

Bytes of images and vertices are copied; axes, units and colours are not converted.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import cv2
import numpy as np

from client.errors import ObjectError
from server.scene.glb import add_array, add_view, append, to_bytes

__all__ = ["add_array", "add_image", "add_view", "check_glb", "gltf_to_glb", "to_bytes"]

_JSON = 0x4E4F534A


def check_glb(path: Path, data: bytes) -> dict[str, Any]:
    """The JSON of a GLB. Raises ObjectError if `data` is not a GLB with a mesh."""
    if len(data) < 20 or data[:4] != b"glTF":
        raise ObjectError(f"{path}: is no GLB mesh, it does not begin with glTF")
    version, length, json_length, kind = struct.unpack_from("<IIII", data, 4)
    if version != 2 or kind != _JSON:
        raise ObjectError(f"{path}: is GLB version {version}; export it as glTF 2.0")
    if length > len(data) or 20 + json_length > len(data):
        raise ObjectError(f"{path}: the GLB is truncated ({len(data)} of {length} bytes); fetch it again")
    document = _document(path, data[20 : 20 + json_length])
    if not document.get("meshes"):
        raise ObjectError(f"{path}: the GLB holds no mesh")
    return document


def gltf_to_glb(path: Path, data: bytes) -> bytes:
    """Pack a .gltf with its buffers and images as one GLB. Raises ObjectError."""
    document = _document(path, data)
    if not document.get("meshes"):
        raise ObjectError(f"{path}: the glTF holds no mesh")
    body = bytearray()
    offsets = [append(body, _fetch(path, buffer.get("uri"))) for buffer in document.get("buffers", [])]
    for view in document.get("bufferViews", []):
        view["byteOffset"] = view.get("byteOffset", 0) + offsets[view.get("buffer", 0)]
        view["buffer"] = 0
    for image in document.get("images", []):
        if "uri" in image:
            _embed(document, body, image, _fetch(path, image.pop("uri")))
    return to_bytes(document, body)


def add_image(document: dict[str, Any], body: bytearray, data: bytes, name: Path) -> int:
    """Append an image and return its index; formats other than PNG and JPEG become PNG. Raises ObjectError."""
    image: dict[str, Any] = {}
    if _mime_type(data) is None:
        data = _as_png(data, name)
    _embed(document, body, image, data)
    document.setdefault("images", []).append(image)
    return len(document["images"]) - 1


def _embed(document: dict[str, Any], body: bytearray, image: dict[str, Any], data: bytes) -> None:
    image["bufferView"] = add_view(document, body, data)
    image["mimeType"] = _mime_type(data) or image.get("mimeType", "image/png")


def _mime_type(data: bytes) -> str | None:
    if data.startswith(b"\x89PNG"):
        return "image/png"
    return "image/jpeg" if data.startswith(b"\xff\xd8") else None


def _as_png(data: bytes, name: Path) -> bytes:
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if picture is None:
        raise ObjectError(f"{name}: the texture cannot be decoded; save it as PNG or JPEG")
    return cv2.imencode(".png", picture)[1].tobytes()


def _document(path: Path, text: bytes) -> dict[str, Any]:
    try:
        document = json.loads(text)
    except ValueError as error:
        raise ObjectError(f"{path}: is no glTF mesh, its JSON does not parse") from error
    if not isinstance(document, dict) or "asset" not in document:
        raise ObjectError(f"{path}: is no glTF mesh, it has no asset entry")
    return document


def _fetch(path: Path, uri: object) -> bytes:
    """Bytes of a `uri`: inline base64, or a file relative to the glTF."""
    if not isinstance(uri, str):
        raise ObjectError(f"{path}: a buffer has no uri; export it as .glb")
    if uri.startswith("data:"):
        try:
            return base64.b64decode(uri.partition(",")[2], validate=True)
        except binascii.Error as error:
            raise ObjectError(f"{path}: an inline buffer is not base64") from error
    part = path.parent / unquote(uri)
    try:
        return part.read_bytes()
    except OSError as error:
        raise ObjectError(f"{part}: named by {path.name} but cannot be read ({error.strerror})") from error
