"""Images inside a glTF file: decoded within limits, and scaled down if they are too large."""

from __future__ import annotations

import base64
import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.picture_headers import PNG_SIGNATURE, jpeg_size
from server.scene.limits import (
    MAX_DECODED_PIXELS,
    MAX_IMAGE_BYTES,
    MAX_KEPT_PIXELS,
    MAX_KEPT_SIDE,
    MAX_TEXTURE_PIXELS,
    MeshError,
)
from server.scene.mipmaps import shrunk

Json = dict[str, Any]
Image = NDArray[np.uint8]


class Pictures:
    """The images of one file. `notes`: one line for each image that could not be read or was scaled down."""

    def __init__(self, header: Json, binary: bytes | None) -> None:
        self._header = header
        self._binary = binary
        self._buffers: dict[int, bytes] = {}
        """Decoded data URIs of buffers, by index."""
        self._encoded: dict[int, bytes] = {}
        """By index; only the first of images with the same bytes."""
        self._first: dict[int, int] = {}
        """The first image with the same bytes, for each image that could be read."""
        self._most_side = MAX_KEPT_SIDE
        self._decoded: tuple[int, Image | None] | None = None
        """The last image that was decoded, in full size."""
        self._images: dict[tuple[int, bool], Image | None] = {}
        self._alphas: dict[int, Image | None] = {}
        self.notes: tuple[str, ...] = ()

    def load(self, wanted: set[int]) -> None:
        """Find the wanted images and their sizes. Raises MeshError if they are too large to decode."""
        sizes: dict[int, tuple[int, int]] = {}
        first_of: dict[bytes, int] = {}
        pixels = size_bytes = 0
        for index in sorted(wanted):
            try:
                encoded = self._image_bytes(_listed(self._header["images"], index))
                first = first_of.setdefault(encoded, index)
                if first == index:
                    sizes[index] = _picture_size(encoded)
            except (KeyError, IndexError, TypeError, ValueError):
                self._unreadable(index)
                continue
            self._first[index] = first
            if first == index:
                self._encoded[index] = encoded
                pixels += _pixels_of(*sizes[index])
                size_bytes += len(encoded)
                _refuse_oversized(pixels, size_bytes)
        while self._most_side > 1 and _kept_pixels(sizes.values(), self._most_side) > MAX_KEPT_PIXELS:
            self._most_side //= 2

    def same_as(self, index: int) -> int:
        """The first image with the same bytes; images that are equal are decoded and kept once."""
        return self._first.get(index, index)

    def image(self, index: int, *, is_srgb: bool) -> Image | None:
        """[h, w, 3] RGB; None if it cannot be read. Scaled down in linear light if it is sRGB, else by its values."""
        key = (index, is_srgb)
        if key not in self._images:
            found = self._full_size(index)
            if found is not None:
                self._images[key] = shrunk(found, self._most_side, is_srgb=is_srgb)
                self._note_scaling(index, found, self._images[key])
            else:
                self._images[key] = None
                if index in self._encoded:
                    self._unreadable(index)
        return self._images[key]

    def alpha(self, index: int) -> Image | None:
        """[h, w] alpha; None if there is none or all of it is opaque. Scaled down like the image."""
        if index not in self._alphas:
            self._alphas[index] = self._read_alpha(index)
        return self._alphas[index]

    def _read_alpha(self, index: int) -> Image | None:
        self._decoded = None  # free it first
        encoded = self._encoded.get(index)
        found = None if encoded is None else _decode(encoded, cv2.IMREAD_UNCHANGED)
        if found is None or found.ndim != 3 or found.shape[2] != 4 or found[..., 3].min() == 255:
            return None
        return np.asarray(shrunk(np.ascontiguousarray(found[..., 1:]), self._most_side, is_srgb=False)[..., 2])

    def _full_size(self, index: int) -> Image | None:
        if self._decoded is None or self._decoded[0] != index:
            encoded = self._encoded.get(index)
            self._decoded = index, None if encoded is None else _decode(encoded)
        return self._decoded[1]

    def _image_bytes(self, image: Json) -> bytes:
        if "uri" in image:
            return _data_uri(image["uri"])
        view = self._header["bufferViews"][image["bufferView"]]
        number = view["buffer"]
        uri = self._header["buffers"][number].get("uri")
        if uri is not None and number not in self._buffers:
            self._buffers[number] = _data_uri(uri)
        buffer = (self._binary or b"") if uri is None else self._buffers[number]
        start = int(view.get("byteOffset", 0))
        return buffer[start : start + int(view["byteLength"])]

    def _unreadable(self, index: int) -> None:
        self._encoded.pop(index, None)
        name = f"image {index}" if index >= 0 else "a texture that does not exist"
        self.notes += (f"{name} could not be read; its material keeps its plain colour",)

    def _note_scaling(self, index: int, before: Image, after: Image | None) -> None:
        if after is None or before.shape == after.shape:
            return
        (old_height, old_width), (height, width) = before.shape[:2], after.shape[:2]
        self.notes += (f"image {index} was scaled down from {old_width} x {old_height} to {width} x {height} pixels",)


def _pixels_of(width: int, height: int) -> int:
    """Raises MeshError if one image has too many."""
    if width * height > MAX_TEXTURE_PIXELS:
        raise MeshError(
            f"one of the textures has {width} x {height} pixels, more than {MAX_TEXTURE_PIXELS}: make it smaller"
        )
    return width * height


def _refuse_oversized(pixels: int, size_bytes: int) -> None:
    """Raises MeshError if all images together have too many pixels or bytes."""
    if pixels > MAX_DECODED_PIXELS:
        raise MeshError(f"the textures have more than {MAX_DECODED_PIXELS} pixels together: make them smaller")
    if size_bytes > MAX_IMAGE_BYTES:
        raise MeshError(f"the images have more than {MAX_IMAGE_BYTES >> 20} MiB together: make them smaller")


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


def _data_uri(uri: str) -> bytes:
    return base64.b64decode(uri.split(",", 1)[1])
