"""Writes a GLB from arrays: one buffer and the JSON that describes it."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

_JSON, _BIN = 0x4E4F534A, 0x004E4942
_COMPONENT = {np.dtype(np.float32): 5126, np.dtype(np.uint32): 5125, np.dtype(np.uint8): 5121}
_SHAPE = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


def to_bytes(document: dict[str, Any], body: bytes | bytearray) -> bytes:
    """The GLB file with JSON `document` and buffer `body`."""
    if body:
        document["buffers"] = [{"byteLength": len(body)}]
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    padded = bytes(body) + b"\0" * (-len(body) % 4)
    chunks = struct.pack("<II", len(text), _JSON) + text
    if padded:
        chunks += struct.pack("<II", len(padded), _BIN) + padded
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def add_array(document: dict[str, Any], body: bytearray, values: NDArray[Any], bounds: bool = False) -> int:
    """Append an accessor over `values` [n] or [n, k] (float32, uint32, uint8 meaning 0..1); returns its index."""
    columns = 1 if values.ndim == 1 else values.shape[1]
    accessor: dict[str, Any] = {
        "bufferView": add_view(document, body, np.ascontiguousarray(values).tobytes()),
        "componentType": _COMPONENT[values.dtype],
        "count": len(values),
        "type": _SHAPE[columns],
    }
    if values.dtype == np.uint8:
        accessor["normalized"] = True
    if bounds:
        accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
    document.setdefault("accessors", []).append(accessor)
    return len(document["accessors"]) - 1


def add_view(document: dict[str, Any], body: bytearray, data: bytes) -> int:
    """Append a buffer view over `data`; returns its index."""
    offset = append(body, data)
    views = document.setdefault("bufferViews", [])
    views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(data)})
    return len(views) - 1


def append(body: bytearray, data: bytes) -> int:
    """Append bytes at a multiple of four; returns the offset."""
    body.extend(b"\0" * (-len(body) % 4))
    offset = len(body)
    body.extend(data)
    return offset
