"""Lossless depth compression: horizontal delta, zigzag, then a general compressor (layouts: README.md).

Neighbouring depths are similar, so deltas are small, and zigzag maps small magnitudes to small numbers. Byte planes
separate the high bytes, which are nearly all zero. Rank coding is smaller: a sensor produces few distinct values, and
neighbours differ by one or two *ranks* among them, which takes half a byte. All arithmetic is modulo 2**16, so any
image is restored bit for bit.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np
import zstandard
from numpy.typing import NDArray

from protocol.codec import ProtocolError

LEVEL = 1
_COUNTS = struct.Struct("<II")
_ESCAPE = 15
"""Escape value of half a byte: the number is this or larger and is stored separately."""


def filter_depth(depth: NDArray[np.uint16]) -> bytes:
    """[h, w] uint16 -> the low bytes of the zigzagged row deltas, row-major, then their high bytes."""
    delta = _row_deltas(depth)
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
    return _row_sums(zigzag)


def rank_depth(depth: NDArray[np.uint16]) -> bytes:
    """[h, w] uint16 -> the set of values, and the zigzagged row deltas of their ranks, two in a byte."""
    is_there = np.zeros(1 << 16, bool)
    is_there[depth] = True
    values = np.flatnonzero(is_there)
    deltas = _row_deltas((np.cumsum(is_there) - 1).astype(np.uint16)[depth])
    escaped = deltas[deltas >= _ESCAPE] - np.uint16(_ESCAPE)
    halves = np.minimum(deltas, _ESCAPE).astype(np.uint8)
    pairs = halves[0::2].copy()
    pairs[: len(halves) // 2] |= halves[1::2] << 4
    steps = np.diff(values, prepend=0).astype("<u2")
    return b"".join((_COUNTS.pack(len(values), len(escaped)), _planes(steps), pairs.tobytes(), _planes(escaped)))


def unrank_depth(data: bytes, width: int, height: int) -> NDArray[np.uint16]:
    """Undo `rank_depth`. Raises ProtocolError for bytes that are not exactly an encoded image of this size."""
    pair_bytes = -(-height // 2) * width
    if len(data) < _COUNTS.size:
        raise ProtocolError("depth.data is truncated: its counts are missing")
    values_there, escapes = _COUNTS.unpack_from(data)
    if len(data) != _COUNTS.size + 2 * (values_there + escapes) + pair_bytes:
        raise ProtocolError(f"depth.data does not hold {values_there} values and {escapes} escapes, as it declares")
    begun = _COUNTS.size + 2 * values_there
    steps = _from_planes(data[_COUNTS.size : begun]).astype(np.int64)
    pairs = np.frombuffer(data, np.uint8, pair_bytes, begun).reshape(-1, width)
    deltas = np.empty((2 * len(pairs), width), np.uint16)
    np.bitwise_and(pairs, _ESCAPE, out=deltas[0::2], casting="unsafe")
    np.right_shift(pairs, 4, out=deltas[1::2], casting="unsafe")
    deltas = deltas[:height]
    is_escaped = deltas == _ESCAPE
    if np.count_nonzero(is_escaped) != escapes:
        raise ProtocolError(f"depth.data does not hold the {escapes} escapes that it declares")
    deltas[is_escaped] = _from_planes(data[begun + pair_bytes :]) + np.uint16(_ESCAPE)
    ranks, values = _row_sums(deltas), np.cumsum(steps)
    if not values_there or values[-1] > 0xFFFF or int(ranks.max()) >= values_there:
        raise ProtocolError("depth.data names values that it does not hold")
    return values.astype(np.uint16)[ranks]


def most_rank_bytes(width: int, height: int) -> int:
    """Largest output of `rank_depth` for an image of this size, in bytes."""
    return _COUNTS.size + 2 * (1 << 16) + (-(-height // 2) + 2 * height) * width


def _row_deltas(picture: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """[h, w]: differences to the left neighbour, zigzagged."""
    delta = picture.copy()
    np.subtract(picture[:, 1:], picture[:, :-1], out=delta[:, 1:])
    sign = (delta.view(np.int16) >> 15).view(np.uint16)
    delta <<= 1
    delta ^= sign
    return delta


def _row_sums(zigzag: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Undo `_row_deltas`, in place."""
    sign = np.negative(zigzag & 1)
    zigzag >>= 1
    zigzag ^= sign
    return np.add.accumulate(zigzag, axis=1, out=zigzag)


def _planes(numbers: NDArray[np.uint16]) -> bytes:
    return (numbers & 255).astype(np.uint8).tobytes() + (numbers >> 8).astype(np.uint8).tobytes()


def _from_planes(planes: bytes) -> NDArray[np.uint16]:
    low, high = np.frombuffer(planes, np.uint8).reshape(2, -1).astype(np.uint16)
    numbers: NDArray[np.uint16] = low | high << np.uint16(8)
    return numbers


def deflate(data: bytes) -> bytes:
    """Raw deflate (RFC 1951, no header)."""
    compressor = zlib.compressobj(LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS)
    return compressor.compress(data) + compressor.flush()


def inflate(data: bytes, size_bytes: int, least_bytes: int | None = None) -> bytes:
    """Undo `deflate`. Raises ProtocolError unless the output has exactly `size_bytes` and no input is left over.

    `least_bytes`: the output may have any size from this up to `size_bytes`.
    """
    decompressor = zlib.decompressobj(-zlib.MAX_WBITS)
    try:
        raw = decompressor.decompress(data, size_bytes + 1)
    except zlib.error as error:
        raise ProtocolError(f"depth.data is not raw deflate: {error}") from error
    is_whole = decompressor.eof and not decompressor.unused_data
    if not (size_bytes if least_bytes is None else least_bytes) <= len(raw) <= size_bytes or not is_whole:
        raise ProtocolError(f"depth.data is truncated or does not hold the {size_bytes} bytes its size declares")
    return raw


def zstd_compress(data: bytes, level: int = LEVEL) -> bytes:
    """One zstd frame with its content size in the header."""
    return zstandard.ZstdCompressor(level=level, write_content_size=True).compress(data)


def zstd_decompress(data: bytes, size_bytes: int, least_bytes: int | None = None) -> bytes:
    """Undo `zstd_compress`. Raises ProtocolError unless the frame declares and holds exactly `size_bytes`.

    `least_bytes`: it may have any size from this up to `size_bytes`.
    """
    try:
        # zstandard allocates the size in the header, regardless of max_output_size.
        declared = zstandard.get_frame_parameters(data).content_size
        if not (size_bytes if least_bytes is None else least_bytes) <= declared <= size_bytes:
            raise ProtocolError(f"depth.data declares {_bytes(declared)}, its size needs {size_bytes} bytes")
        raw: bytes = zstandard.ZstdDecompressor().decompress(data, max_output_size=size_bytes, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise ProtocolError(f"depth.data is not one whole zstd frame: {error}") from error
    return raw


def _bytes(declared: int) -> str:
    return "no size" if declared == zstandard.CONTENTSIZE_UNKNOWN else f"{declared} bytes"
