"""Which lossless codec the depth goes over the wire with, measured on real depth.

`python -m tests.bench.client.depth_codecs [--frames N] [--json]` prints milliseconds to encode and to
decode (best of five for a frame, median over the frames) and the ratio of compression. Every row is checked to be
bit-exact.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

import cv2
import numpy as np
import zstandard
from numpy.typing import NDArray

from protocol.depth_codec import (
    deflate,
    filter_depth,
    inflate,
    most_rank_bytes,
    rank_depth,
    unfilter_depth,
    unrank_depth,
    zstd_compress,
    zstd_decompress,
)
from protocol.images import encode_depth
from tests.data import ROOT

Depth = NDArray[np.uint16]
DATA = {"rgbd_7scenes_redkitchen": "data/*.depth.png", "mitsuba_track_noisy": "depth/*.png"}
REPEATS = 5


@dataclass(frozen=True)
class Candidate:
    """A codec: array to bytes, and bytes with the array's width and height back to the array."""

    name: str
    encode: Callable[[Depth], bytes]
    decode: Callable[[bytes, int, int], Depth]


@dataclass(frozen=True)
class Row:
    """One candidate on one data set."""

    data: str
    codec: str
    encode_ms: float
    decode_ms: float
    ratio: float
    bytes_per_frame: int


def _unpack(raw: bytes, width: int, height: int) -> Depth:
    return np.frombuffer(raw, "<u2").reshape(height, width).astype(np.uint16)


def _png(depth: Depth) -> bytes:
    done, data = cv2.imencode(".png", depth, (cv2.IMWRITE_PNG_COMPRESSION, 1))
    assert done
    return data.tobytes()


def _unpng(data: bytes, width: int, height: int) -> Depth:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED).reshape(height, width)


def _ranks(depth: Depth) -> tuple[bytes, Depth]:
    """Its values, with their number before them, and the rank of each pixel's among them."""
    values, ranks = np.unique(depth, return_inverse=True)
    return np.array([len(values), *values], "<u4").tobytes(), ranks.reshape(depth.shape).astype(np.uint16)


def _png_of_ranks(depth: Depth) -> bytes:
    table, ranks = _ranks(depth)
    options = (cv2.IMWRITE_PNG_COMPRESSION, 6, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP)
    return table + cv2.imencode(".png", ranks, options)[1].tobytes()


def _jp2_of_ranks(depth: Depth) -> bytes:
    table, ranks = _ranks(depth)
    return table + cv2.imencode(".jp2", ranks, (cv2.IMWRITE_JPEG2000_COMPRESSION_X1000, 1000))[1].tobytes()


def _unpng_of_ranks(data: bytes, width: int, height: int) -> Depth:
    begun = 4 + 4 * int.from_bytes(data[:4], "little")
    values = np.frombuffer(data[4:begun], "<u4").astype(np.uint16)
    return values[_unpng(data[begun:], width, height)]


CANDIDATES = (
    Candidate("raw", lambda d: d.tobytes(), _unpack),
    Candidate("PNG, level 1 (OpenCV)", _png, _unpng),
    Candidate("deflate 1", lambda d: deflate(d.tobytes()), lambda b, w, h: _unpack(inflate(b, 2 * w * h), w, h)),
    Candidate(
        "deflate 1, filtered = zdelta",
        lambda d: encode_depth(d, "zdelta").data,
        lambda b, w, h: unfilter_depth(inflate(b, 2 * w * h), w, h),
    ),
    Candidate(
        "zstd 1",
        lambda d: zstd_compress(d.tobytes()),
        lambda b, w, h: _unpack(zstd_decompress(b, 2 * w * h), w, h),
    ),
    Candidate(
        "zstd 1, filtered = zstd-delta",
        lambda d: encode_depth(d, "zstd-delta").data,
        lambda b, w, h: unfilter_depth(zstd_decompress(b, 2 * w * h), w, h),
    ),
    Candidate("filter alone", filter_depth, unfilter_depth),
    *(
        Candidate(
            f"zstd {level}, ranks = zstd-ranks",
            lambda d, level=level: encode_depth(d, "zstd-ranks", level=level).data,
            lambda b, w, h: unrank_depth(zstd_decompress(b, most_rank_bytes(w, h), least_bytes=0), w, h),
        )
        for level in (1, 6, 19)
    ),
    Candidate("ranks alone", rank_depth, unrank_depth),
    Candidate("PNG of ranks, level 6 (OpenCV)", _png_of_ranks, _unpng_of_ranks),
    Candidate("JPEG 2000 of ranks (OpenCV)", _jp2_of_ranks, _unpng_of_ranks),
)


def _best_ms(work: Callable[[], object]) -> float:
    times_s = []
    for _ in range(REPEATS):
        start_s = time.perf_counter()
        work()
        times_s.append(time.perf_counter() - start_s)
    return min(times_s) * 1e3


def measure(data: str, frames: list[Depth], candidate: Candidate) -> Row:
    """Times and ratio of one candidate over `frames`. Raises AssertionError if it is not bit-exact."""
    encode_ms, decode_ms, sizes = [], [], []
    for depth in frames:
        height, width = depth.shape
        encoded = candidate.encode(depth)
        assert np.array_equal(candidate.decode(encoded, width, height), depth), candidate.name
        encode_ms.append(_best_ms(lambda d=depth: candidate.encode(d)))
        decode_ms.append(_best_ms(lambda e=encoded, w=width, h=height: candidate.decode(e, w, h)))
        sizes.append(len(encoded))
    raw_bytes = sum(depth.nbytes for depth in frames)
    return Row(
        data,
        candidate.name,
        round(median(encode_ms), 2),
        round(median(decode_ms), 2),
        round(raw_bytes / sum(sizes), 2),
        sum(sizes) // len(sizes),
    )


def load_frames(folder: Path, pattern: str, count: int) -> list[Depth]:
    """`count` depth pictures, evenly spread over the set."""
    paths = sorted(folder.glob(pattern))
    chosen = [paths[at] for at in np.linspace(0, len(paths) - 1, count).astype(int)]
    return [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in chosen]


def _public_data(name: str) -> Path:
    base = Path(os.environ.get("PROBELESS_DATA", ROOT.parent / "shared" / "data"))
    if not (base / name).exists():
        sys.exit(f"public data set {name} is not at {base}; set PROBELESS_DATA to where it is")
    return base / name


def _machine() -> str:
    names = [line.split(":")[1].strip() for line in _cpuinfo() if line.startswith("model name")]
    return f"{len(names)} x {names[0]}" if names else platform.processor() or platform.machine()


def _cpuinfo() -> list[str]:
    path = Path("/proc/cpuinfo")
    return path.read_text().splitlines() if path.exists() else []


def _print_table(rows: list[Row]) -> None:
    print(f"{_machine()}; zlib {zlib.ZLIB_RUNTIME_VERSION}, zstd {'.'.join(map(str, zstandard.ZSTD_VERSION))}")
    for data in dict.fromkeys(row.data for row in rows):
        print(f"\n{data}\n\n| codec | encode ms | decode ms | ratio | kB a frame |\n|---|---|---|---|---|")
        for row in rows:
            if row.data == data:
                print(
                    f"| {row.codec} | {row.encode_ms} | {row.decode_ms} | {row.ratio} | {row.bytes_per_frame // 1000} |"
                )


def main() -> None:
    """Measure and print."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--frames", type=int, default=12, help="pictures of each set")
    options.add_argument("--json", action="store_true", help="one JSON object instead of tables")
    chosen = options.parse_args()
    rows = []
    for data, pattern in DATA.items():
        frames = load_frames(_public_data(data), pattern, chosen.frames)
        for candidate in CANDIDATES:
            print(f"{data}: {candidate.name}", file=sys.stderr)
            rows.append(measure(data, frames, candidate))
    if chosen.json:
        print(
            json.dumps({"device": _machine(), "frames": chosen.frames, "rows": [asdict(row) for row in rows]}, indent=1)
        )
    else:
        _print_table(rows)


if __name__ == "__main__":
    main()
