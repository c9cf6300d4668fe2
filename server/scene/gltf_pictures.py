"""Images inside a glTF file: decoded within limits, and scaled down if they are too large."""

from __future__ import annotations

import base64
import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.picture_headers import PNG_SIGNATURE, jpeg_size
from server.scene.limits import MAX_KEPT_PIXELS, MAX_KEPT_SIDE, MAX_TEXTURE_PIXELS, MeshError
from server.scene.mipmaps import shrunk

Json = dict[str, Any]
Image = NDArray[np.uint8]


class Pictures:
    """The images of one file. `notes`: one line for each image that could not be read or was scaled down."""

    def __init__(self, header: Json, binary: bytes | None) -> None:
        self._header = header
        self._binary = binary
        self._encoded: dict[int, bytes] = {}
        self._most_side = MAX_KEPT_SIDE
        self._images: dict[tuple[int, bool], Image | None] = {}
        self.notes: tuple[str, ...] = ()

    def load(self, wanted: set[int]) -> None:
        """Find the wanted images and their sizes. Raises MeshError if one is too large to decode."""
        sizes: dict[int, tuple[int, int]] = {}
        for index in sorted(wanted):
            try:
                encoded = _image_bytes(self._header, self._binary, _listed(self._header["images"], index))
                sizes[index] = _picture_size(encoded)
            except (KeyError, IndexError, TypeError, ValueError):
                self._unreadable(index)
                continue
            self._encoded[index] = encoded
            width, height = sizes[index]
            if width * height > MAX_TEXTURE_PIXELS:
                raise MeshError(
                    f"one of the textures has {width} x {height} pixels, more than {MAX_TEXTURE_PIXELS}: "
                    "make it smaller"
                )
        while self._most_side > 1 and _kept_pixels(sizes.values(), self._most_side) > MAX_KEPT_PIXELS:
            self._most_side //= 2

    def image(self, index: int, *, is_srgb: bool) -> Image | None:
        """[h, w, 3] RGB; None if it cannot be read. Scaled down in linear light if it is sRGB, else by its values."""
        key = (index, is_srgb)
        if key not in self._images:
            encoded = self._encoded.get(index)
            found = None if encoded is None else _decode(encoded)
            if found is not None:
                self._images[key] = shrunk(found, self._most_side, is_srgb=is_srgb)
                self._note_scaling(index, found, self._images[key])
            else:
                self._images[key] = None
                if encoded is not None:
                    self._unreadable(index)
        return self._images[key]

    def alpha(self, index: int) -> Image | None:
        """[h, w] alpha; None if there is none or all of it is opaque. Scaled down like the image."""
        encoded = self._encoded.get(index)
        found = None if encoded is None else _decode(encoded, cv2.IMREAD_UNCHANGED)
        if found is None or found.ndim != 3 or found.shape[2] != 4 or found[..., 3].min() == 255:
            return None
        return np.asarray(shrunk(np.ascontiguousarray(found[..., 1:]), self._most_side, is_srgb=False)[..., 2])

    def _unreadable(self, index: int) -> None:
        self._encoded.pop(index, None)
        name = f"image {index}" if index >= 0 else "a texture that does not exist"
        self.notes += (f"{name} could not be read; its material keeps its plain colour",)

    def _note_scaling(self, index: int, before: Image, after: Image | None) -> None:
        if after is None or before.shape == after.shape:
            return
        (old_height, old_width), (height, width) = before.shape[:2], after.shape[:2]
        self.notes += (f"image {index} was scaled down from {old_width} x {old_height} to {width} x {height} pixels",)


def _listed(images: list[Json], index: int) -> Json:
    if index < 0:
        raise IndexError
    return images[index]


def _kept_pixels(sizes: Any, most_side: int) -> int:
    total = 0
    for width, height in sizes:
        step = -(-max(width, height) // most_side)
        total += (width // step) * (height // step)
    return total


def _decode(encoded: bytes, flags: int = cv2.IMREAD_COLOR_RGB) -> Image | None:
    try:
        picture = cv2.imdecode(np.frombuffer(encoded, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        return None
    if picture is None:
        return None
    return np.asarray(picture // (257 if picture.dtype == np.uint16 else 1), np.uint8)


def _picture_size(encoded: bytes) -> tuple[int, int]:
    """Width and height in the header of a PNG or JPEG, the two formats of glTF. Raises ValueError."""
    if encoded.startswith(PNG_SIGNATURE) and len(encoded) > 24:
        width, height = struct.unpack_from(">II", encoded, 16)
        if width < 1 or height < 1:
            raise ValueError("a PNG without pixels")
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
