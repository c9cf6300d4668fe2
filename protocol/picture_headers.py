"""Validates JPEG and PNG headers before a decoder reads the image.

An image is refused if it is truncated, if its size cannot be determined, or if it contains anything that a plain 8-bit
image does not need (animation, compressed text, hundreds of scans), which could make a small message expensive.
"""

from __future__ import annotations

import struct

from protocol.codec import ProtocolError

MAX_JPEG_SCANS = 32
MAX_PNG_CHUNKS = 8192
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_CHUNKS = {b"IHDR", b"IDAT", b"IEND", b"sRGB", b"gAMA", b"cHRM", b"cICP", b"pHYs", b"sBIT", b"tIME"}
PNG_RGB, PNG_RGBA = 2, 6

_SOI, _EOI, _SOS = b"\xff\xd8", b"\xff\xd9", b"\xff\xda"
_SOF_HUFFMAN = (0xC0, 0xC1, 0xC2)  # baseline, extended, progressive
_SOF_OTHER = (0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF)  # lossless, hierarchical, arithmetic


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Width and height in pixels of an 8-bit grey or YCbCr JPEG. Raises ProtocolError."""
    if not data.startswith(_SOI):
        raise ProtocolError("color.data is not a JPEG: it does not start with FF D8")
    if not data.endswith(_EOI):
        raise ProtocolError("color.data is a truncated JPEG: it does not end with FF D9")
    if data.count(_SOS) > MAX_JPEG_SCANS:
        raise ProtocolError(f"color.data is a JPEG with more than {MAX_JPEG_SCANS} scans")
    return _jpeg_frame_size(data)


def _jpeg_frame_size(data: bytes) -> tuple[int, int]:
    """Walk the marker segments up to the frame header (SOF, ITU-T T.81 B.2.2)."""
    at = 2
    try:
        while True:
            start, marker, length = struct.unpack_from(">BBH", data, at)
            if start != 0xFF or length < 2 or marker in _SOF_OTHER or marker == _SOS[1]:
                raise ProtocolError(f"color.data is a damaged JPEG, or of a kind not accepted (byte {at})")
            if marker in _SOF_HUFFMAN:
                precision, height, width, components = struct.unpack_from(">BHHB", data, at + 4)
                break
            at += 2 + length
    except struct.error:
        raise ProtocolError("color.data is a truncated JPEG: it has no frame header") from None
    if precision != 8 or components not in (1, 3):
        raise ProtocolError(f"color.data is a JPEG of {components} components of {precision} bits, must be 3 of 8")
    return width, height


def png_size(data: bytes) -> tuple[int, int]:
    """Width and height in pixels of an 8-bit RGB or RGBA PNG. Raises ProtocolError."""
    if not data.startswith(PNG_SIGNATURE):
        raise ProtocolError("color.data is not a PNG: it lacks the PNG signature")
    _require_plain_chunks(data)
    try:
        kind, width, height, bits, color = struct.unpack_from(">4x4sIIBB", data, len(PNG_SIGNATURE))
    except struct.error:
        raise ProtocolError("color.data is a truncated PNG") from None
    if kind != b"IHDR" or bits != 8 or color not in (PNG_RGB, PNG_RGBA):
        raise ProtocolError(f"color.data is a PNG of colour type {color} with {bits} bits, must be RGB or RGBA with 8")
    return width, height


def _require_plain_chunks(data: bytes) -> None:
    """Walk the chunks from the signature to the end; the last one must be IEND and end the data."""
    at, kind = len(PNG_SIGNATURE), b""
    for _ in range(MAX_PNG_CHUNKS):
        if at + 12 > len(data):
            break
        length, kind = struct.unpack_from(">I4s", data, at)
        if kind not in PNG_CHUNKS:
            raise ProtocolError(f"color.data is a PNG with a chunk {kind!r}, which is not accepted")
        at += 12 + length
    if kind != b"IEND" or at != len(data):
        raise ProtocolError("color.data is a truncated PNG, or has bytes after its end, or too many chunks")
