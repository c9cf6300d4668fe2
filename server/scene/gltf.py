"""What is read of a glTF file before trimesh gets it: limits, and the base colour of every material.

trimesh keeps factors as 8-bit numbers and needs Pillow for textures, so both are read here; a material's name is
replaced by its index, which is how a part finds its colour again. (glTF 2.0: factors are linear, textures are sRGB.)
"""

from __future__ import annotations

import base64
import json
import struct
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.picture_headers import PNG_SIGNATURE, jpeg_size
from server.scene.limits import MAX_TEXTURE_PIXELS, MAX_TRIANGLES, MAX_VERTICES, MeshError

_MAGIC, _JSON, _BIN = b"glTF", 0x4E4F534A, 0x004E4942
_COMPRESSIONS = {"KHR_draco_mesh_compression", "EXT_meshopt_compression"}

Json = dict[str, Any]


@dataclass(frozen=True)
class BaseColor:
    """One material's base colour: linear factor, and a texture (sRGB [h, w, 3] uint8) to multiply it with."""

    factor: tuple[float, float, float] = (1.0, 1.0, 1.0)
    texture: NDArray[np.uint8] | None = None


def prepare_gltf(data: bytes) -> tuple[bytes, list[BaseColor], tuple[str, ...]]:
    """The file (GLB or JSON) as trimesh should see it, the base colour of each material, and notes.

    Raises MeshError for what is refused, and whatever indexing raises where the file names what is not there.
    """
    header, binary = _split_glb(data) if data.startswith(_MAGIC) else (_parse(data), None)
    _refuse_unsupported(header)
    _refuse_oversized(header)
    colors, notes = _base_colors(header, binary)
    for index, material in enumerate(header.get("materials", [])):
        material["name"] = str(index)
    header.pop("images", None)  # trimesh would decode them again
    return _join_glb(header, binary) if data.startswith(_MAGIC) else json.dumps(header).encode(), colors, notes


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


def _refuse_oversized(header: Json) -> None:
    """Refuse what a small file may ask to be unfolded into: many primitives that read the same bytes."""
    accessors = [int(accessor["count"]) for accessor in header.get("accessors", [])]
    primitives = [p for mesh in header.get("meshes", []) for p in mesh["primitives"]]
    corners = sum(accessors[p["indices"]] for p in primitives if "indices" in p)
    vertices = sum(accessors[p["attributes"]["POSITION"]] for p in primitives)
    if corners > MAX_VERTICES or vertices > MAX_VERTICES:
        raise MeshError(f"more than {MAX_TRIANGLES} triangles: {max(corners, vertices)} vertices")
    if min(accessors, default=0) < 0 or sum(accessors) > 8 * MAX_VERTICES:
        raise MeshError("damaged glTF: its accessors are too large")


def _base_colors(header: Json, binary: bytes | None) -> tuple[list[BaseColor], tuple[str, ...]]:
    """The base colour of each material, and a note for each image that could not be read."""
    images = [_image_index(header, material) for material in header.get("materials", [])]
    pictures = _decode_images(header, binary, sorted({index for index in images if index is not None}))
    colors = [
        BaseColor(_factor(material), None if image is None else pictures[image])
        for material, image in zip(header.get("materials", []), images, strict=True)
    ]
    return colors, tuple(
        f"image {index} could not be read; its material keeps its plain colour"
        for index, picture in pictures.items()
        if picture is None
    )


def _factor(material: Json) -> tuple[float, float, float]:
    values = material.get("pbrMetallicRoughness", {}).get("baseColorFactor", (1.0, 1.0, 1.0, 1.0))
    red, green, blue = (float(value) for value in np.clip(np.nan_to_num(values[:3]), 0.0, 1.0))
    return red, green, blue


def _image_index(header: Json, material: Json) -> int | None:
    reference = material.get("pbrMetallicRoughness", {}).get("baseColorTexture")
    if reference is None:
        return None
    source = header["textures"][reference["index"]].get("source")
    return None if source is None else int(source)


def _decode_images(header: Json, binary: bytes | None, wanted: list[int]) -> dict[int, NDArray[np.uint8] | None]:
    """Each wanted image as [h, w, 3] RGB, None where it cannot be read. Raises MeshError where they are too large."""
    pictures: dict[int, NDArray[np.uint8] | None] = {}
    left = MAX_TEXTURE_PIXELS
    for index in wanted:
        try:
            encoded = _image_bytes(header, binary, header["images"][index])
            width, height = _picture_size(encoded)
        except (KeyError, IndexError, TypeError, ValueError):
            pictures[index] = None
            continue
        left -= width * height
        if left < 0:
            raise MeshError(f"the textures have more than {MAX_TEXTURE_PIXELS} pixels together: make them smaller")
        pictures[index] = _decode(encoded)
    return pictures


def _decode(encoded: bytes) -> NDArray[np.uint8] | None:
    try:
        picture = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        return None
    return None if picture is None else picture.astype(np.uint8, copy=False)


def _picture_size(encoded: bytes) -> tuple[int, int]:
    """Width and height that a PNG or JPEG announces, the two kinds glTF has. Raises ValueError."""
    if encoded.startswith(PNG_SIGNATURE) and len(encoded) > 24:
        width, height = struct.unpack_from(">II", encoded, 16)
        return width, height
    return jpeg_size(encoded)


def _image_bytes(header: Json, binary: bytes | None, image: Json) -> bytes:
    if "uri" in image:
        return _data_uri(image["uri"])
    view = header["bufferViews"][image["bufferView"]]
    uri = header["buffers"][view["buffer"]].get("uri")
    buffer = (binary or b"") if uri is None else _data_uri(uri)
    start = int(view.get("byteOffset", 0))
    return buffer[start : start + int(view["byteLength"])]


def _data_uri(uri: str) -> bytes:
    return base64.b64decode(uri.split(",", 1)[1])
