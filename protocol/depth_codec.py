"""Lossless depth: horizontal delta, zigzag, byte planes, then a general compressor (layout: README.md).

Neighbouring depths differ by little, so the deltas are small, zigzag makes small magnitudes small numbers, and the
plane of high bytes becomes almost all zeros. All arithmetic is modulo 2**16: any uint16 picture survives bit for bit.
"""

from __future__ import annotations

import zlib

import numpy as np
import zstandard
from numpy.typing import NDArray

from protocol.codec import ProtocolError

LEVEL = 1


def filter_depth(depth: NDArray[np.uint16]) -> bytes:
    """[h, w] uint16 -> the low bytes of the zigzagged row deltas, row-major, then their high bytes."""
    delta = depth.copy()
    np.subtract(depth[:, 1:], depth[:, :-1], out=delta[:, 1:])
    sign = (delta.view(np.int16) >> 15).view(np.uint16)
    delta <<= 1
    delta ^= sign
    planes = np.empty((2, *depth.shape), np.uint8)
    np.copyto(planes[0], delta, casting="unsafe")
    np.copyto(planes[1], delta >> 8, casting="unsafe")
    return planes.tobytes()


def unfilter_depth(planes: bytes, width: int, height: int) -> NDArray[np.uint16]:
    """Undo `filter_depth`; `planes` has exactly 2 * width * height bytes."""
    low, high = np.frombuffer(planes, np.uint8).reshape(2, height, width)
    zigzag = high.astype(np.uint16)
    zigzag <<= 8
    zigzag |= low
    sign = np.negative(zigzag & 1)
    zigzag >>= 1
    zigzag ^= sign
    return np.add.accumulate(zigzag, axis=1, out=zigzag)


def deflate(data: bytes) -> bytes:
    """Raw deflate (RFC 1951, no header)."""
    compressor = zlib.compressobj(LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS)
    return compressor.compress(data) + compressor.flush()


def inflate(data: bytes, size_bytes: int) -> bytes:
    """Undo `deflate`. Raises ProtocolError unless exactly `size_bytes` come out and nothing is left over."""
    decompressor = zlib.decompressobj(-zlib.MAX_WBITS)
    try:
        raw = decompressor.decompress(data, size_bytes + 1)
    except zlib.error as error:
        raise ProtocolError(f"depth.data is not raw deflate: {error}") from error
    if len(raw) != size_bytes or not decompressor.eof or decompressor.unused_data:
        raise ProtocolError(f"depth.data is truncated or does not hold the {size_bytes} bytes its size declares")
    return raw


def zstd_compress(data: bytes, level: int = LEVEL) -> bytes:
    """One zstd frame with its content size in the header."""
    return zstandard.ZstdCompressor(level=level, write_content_size=True).compress(data)


def zstd_decompress(data: bytes, size_bytes: int) -> bytes:
    """Undo `zstd_compress`. Raises ProtocolError unless the frame declares and holds exactly `size_bytes`."""
    try:
        # zstandard allocates what the header declares, whatever max_output_size says.
        declared = zstandard.get_frame_parameters(data).content_size
        if declared != size_bytes:
            raise ProtocolError(f"depth.data declares {_bytes(declared)}, its size needs {size_bytes} bytes")
        raw: bytes = zstandard.ZstdDecompressor().decompress(data, max_output_size=size_bytes, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise ProtocolError(f"depth.data is not one whole zstd frame: {error}") from error
    return raw


def _bytes(declared: int) -> str:
    return "no size" if declared == zstandard.CONTENTSIZE_UNKNOWN else f"{declared} bytes"
