"""Pictures: exact where they promise it, close where they are JPEG, and refused before they cost anything."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from collections.abc import Callable
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
import zstandard
from numpy.typing import NDArray

from protocol.codec import ProtocolError
from protocol.frames import CameraModel
from protocol.images import DEPTH_CODECS, decode_color, decode_depth, encode_color, encode_depth
from protocol.messages import ColorImage, DepthImage
from protocol.picture_headers import MAX_JPEG_SCANS, jpeg_size, png_size
from tests.data import data_folder

WIDTH, HEIGHT = 64, 48
CAMERA = CameraModel(width=WIDTH, height=HEIGHT, fx=50, fy=50, cx=31.5, cy=23.5)
LINEAR = msgspec.structs.replace(CAMERA, color_encoding="linear16")


def _camera(width: int, height: int) -> CameraModel:
    return msgspec.structs.replace(CAMERA, width=width, height=height, fx=width, fy=width)


def _smooth(seed: int = 0) -> NDArray[np.uint8]:
    small = np.random.default_rng(seed).integers(0, 256, (5, 6, 3)).astype(np.uint8)
    return cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)


def _change(image: Any, **fields: object) -> Any:
    return msgspec.structs.replace(image, **fields)


def _depths(seed: int) -> dict[str, NDArray[np.uint16]]:
    random = np.random.default_rng(seed)
    width, height = (int(side) for side in random.integers(8, 80, 2))
    y, x = np.mgrid[0:height, 0:width]
    ramp = (800 + 3 * x + 2 * y).astype(np.uint16)
    return {
        "noise": random.integers(0, 65536, (height, width)).astype(np.uint16),
        "extremes": random.choice([0, 1, 32767, 32768, 65534, 65535], (height, width)).astype(np.uint16),
        "ramp": ramp,
        "holes": np.where(random.random((height, width)) < 0.3, 0, ramp).astype(np.uint16),
        "nothing": np.zeros((height, width), np.uint16),
        "a view": random.integers(0, 65536, (2 * height, 2 * width)).astype(np.uint16)[::2, ::2],
    }


# ---- depth -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("codec", DEPTH_CODECS)
@pytest.mark.parametrize("seed", range(8))
def test_depth_survives_bit_for_bit(codec: Any, seed: int) -> None:
    for name, depth in _depths(seed).items():
        image = encode_depth(depth, codec)
        decoded = decode_depth(image, _camera(image.width, image.height))
        assert decoded.dtype == np.uint16
        assert decoded.flags.writeable
        assert np.array_equal(decoded, depth), name


def _filter_by_hand(depth: NDArray[np.uint16]) -> bytes:
    """The layout as README.md words it, one value at a time."""
    zigzagged = []
    for row in depth.tolist():
        left = 0
        for value in row:
            delta = (value - left + 32768) % 65536 - 32768
            zigzagged.append(2 * delta if delta >= 0 else -2 * delta - 1)
            left = value
    return bytes(z & 255 for z in zigzagged) + bytes(z >> 8 for z in zigzagged)


@pytest.mark.parametrize("seed", range(4))
def test_depth_layout_is_the_documented_one(seed: int) -> None:
    for depth in _depths(seed).values():
        planes = _filter_by_hand(depth)
        assert zlib.decompress(encode_depth(depth, "zdelta").data, -15) == planes
        assert zstandard.decompress(encode_depth(depth, "zstd-delta").data) == planes


def _ranks_by_hand(depth: NDArray[np.uint16]) -> bytes:
    """The layout as README.md words it, one value at a time."""
    values = sorted(set(depth.ravel().tolist()))
    halves, escaped = [], []
    for row in depth.tolist():
        left, found = 0, []
        for value in row:
            rank = values.index(value)
            delta = (rank - left + 32768) % 65536 - 32768
            zigzag = 2 * delta if delta >= 0 else -2 * delta - 1
            found.append(min(zigzag, 15))
            escaped += [zigzag - 15] if zigzag >= 15 else []
            left = rank
        halves.append(found)
    if len(halves) % 2:
        halves.append([0] * len(halves[0]))
    pairs = [
        a | b << 4
        for upper, lower in zip(halves[0::2], halves[1::2], strict=True)
        for a, b in zip(upper, lower, strict=True)
    ]
    steps = [value - before for before, value in zip([0, *values], values, strict=False)]
    low_high = [bytes(n & 255 for n in some) + bytes(n >> 8 for n in some) for some in (steps, escaped)]
    return struct.pack("<II", len(values), len(escaped)) + low_high[0] + bytes(pairs) + low_high[1]


@pytest.mark.parametrize("seed", range(4))
def test_the_layout_of_ranks_is_the_documented_one(seed: int) -> None:
    for depth in _depths(seed).values():
        small = depth[:17, :23]
        assert zstandard.decompress(encode_depth(small, "zstd-ranks").data) == _ranks_by_hand(small)
        assert zlib.decompress(encode_depth(small, "zranks").data, -15) == _ranks_by_hand(small)


def test_ranks_take_less_of_a_sensor_that_knows_few_distances() -> None:
    y, x = np.mgrid[0:120, 0:160]
    disparity = np.rint(40 + 0.05 * x + 0.02 * y + np.random.default_rng(0).normal(0, 0.7, x.shape))
    depth = (585 * 75 / disparity * 8).astype(np.uint16)
    sizes = {codec: len(encode_depth(depth, codec).data) for codec in DEPTH_CODECS}
    assert sizes["zstd-ranks"] < 0.7 * sizes["zstd-delta"]
    assert sizes["zranks"] < 0.7 * sizes["zdelta"]


def test_raw_depth_is_little_endian() -> None:
    assert encode_depth(np.full((8, 8), 0x0102, np.uint16), "raw").data == b"\x02\x01" * 64


@pytest.mark.data
def test_real_depth_survives_and_shrinks() -> None:
    path = data_folder("rgbd_7scenes_redkitchen") / "data" / "frame-000000.depth.png"
    depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    for codec in ("zdelta", "zranks", "zstd-delta", "zstd-ranks"):
        image = encode_depth(depth, codec)
        assert np.array_equal(decode_depth(image, _camera(640, 480)), depth)
        assert len(image.data) < depth.nbytes / 5


def _zstd(size_bytes: int, **options: Any) -> bytes:
    return zstandard.ZstdCompressor(level=1, **options).compress(bytes(size_bytes))


def _deflate(size_bytes: int) -> bytes:
    compressor = zlib.compressobj(1, zlib.DEFLATED, -15)
    return compressor.compress(bytes(size_bytes)) + compressor.flush()


def _ranks(values: list[int], pairs: bytes, escaped: bytes = b"", counts: tuple[int, int] | None = None) -> bytes:
    steps = np.diff(np.array(values, np.int64), prepend=0) % 65536
    planes = bytes(n & 255 for n in steps.tolist()) + bytes(n >> 8 for n in steps.tolist())
    declared = struct.pack("<II", *(counts or (len(values), len(escaped) // 2)))
    return zstandard.compress(declared + planes + pairs + escaped)


SIZE = 2 * WIDTH * HEIGHT
PAIRS = WIDTH * HEIGHT // 2
HOSTILE_DEPTH: dict[str, tuple[str, bytes | Callable[[], bytes]]] = {
    "raw too short": ("raw", bytes(SIZE - 1)),
    "raw too long": ("raw", bytes(SIZE + 2)),
    "raw empty": ("raw", b""),
    "zstd empty": ("zstd-delta", b""),
    "zstd truncated": ("zstd-delta", _zstd(SIZE)[:-2]),
    "zstd header only": ("zstd-delta", _zstd(SIZE)[:6]),
    "zstd no frame": ("zstd-delta", b"\x00" * 64),
    "zstd too small": ("zstd-delta", _zstd(SIZE - 2)),
    "zstd bomb that declares itself": ("zstd-delta", lambda: _zstd(200 << 20)),
    "zstd bomb that declares nothing": ("zstd-delta", lambda: _zstd(64 << 20, write_content_size=False)),
    "zstd bytes after it": ("zstd-delta", _zstd(SIZE) + b"\x00"),
    "zstd a second frame": ("zstd-delta", _zstd(SIZE) + _zstd(SIZE)),
    "zstd skippable frame": ("zstd-delta", b"\x50\x2a\x4d\x18\x04\x00\x00\x00abcd"),
    "ranks empty": ("zstd-ranks", b""),
    "ranks of nothing": ("zstd-ranks", zstandard.compress(b"")),
    "ranks without counts": ("zstd-ranks", zstandard.compress(bytes(7))),
    "ranks without values": ("zstd-ranks", _ranks([], bytes(PAIRS))),
    "ranks too short": ("zstd-ranks", _ranks([0, 5], bytes(PAIRS - 1))),
    "ranks too long": ("zstd-ranks", _ranks([0, 5], bytes(PAIRS + 1))),
    "ranks that lie of their values": ("zstd-ranks", _ranks([0, 5], bytes(PAIRS), counts=(1, 0))),
    "ranks of four thousand million": ("zstd-ranks", _ranks([0, 5], bytes(PAIRS), counts=(2**32 - 1, 2**32 - 1))),
    "ranks beyond the values": ("zstd-ranks", _ranks([0, 5], b"\x04" + bytes(PAIRS - 1))),
    "ranks below the first": ("zstd-ranks", _ranks([0, 5], b"\x01" + bytes(PAIRS - 1))),
    "ranks whose values exceed 16 bits": ("zstd-ranks", _ranks([60000, 55535], bytes(PAIRS))),
    "ranks without an escape": ("zstd-ranks", _ranks([0, 5], b"\x0f" + bytes(PAIRS - 1))),
    "ranks with an escape too many": ("zstd-ranks", _ranks([0, 5], bytes(PAIRS), bytes(2))),
    "ranks with half an escape": ("zstd-ranks", _ranks([0, 5], b"\x0f" + bytes(PAIRS - 1), bytes(3), (2, 1))),
    "ranks bomb": ("zstd-ranks", lambda: _zstd(200 << 20)),
    "ranks bomb that declares nothing": ("zstd-ranks", lambda: _zstd(64 << 20, write_content_size=False)),
    "ranks bytes after it": ("zstd-ranks", _ranks([0, 5], bytes(PAIRS)) + b"\x00"),
    "zlib ranks empty": ("zranks", b""),
    "zlib ranks of nothing": ("zranks", _deflate(0)),
    "zlib ranks truncated": ("zranks", _deflate(8 + PAIRS)[:-2]),
    "zlib ranks without values": ("zranks", _deflate(8 + PAIRS)),
    "zlib ranks bomb": ("zranks", lambda: _deflate(50 << 20)),
    "zlib empty": ("zdelta", b""),
    "zlib truncated": ("zdelta", _deflate(SIZE)[:-2]),
    "zlib with a zlib header": ("zdelta", zlib.compress(bytes(SIZE))),
    "zlib too small": ("zdelta", _deflate(SIZE - 2)),
    "zlib one byte too many": ("zdelta", _deflate(SIZE + 1)),
    "zlib bomb": ("zdelta", lambda: _deflate(200 << 20)),
    "zlib bytes after it": ("zdelta", _deflate(SIZE) + b"\x00"),
    "zlib noise": ("zdelta", np.random.default_rng(1).bytes(500)),
}


def _refused(decode: Callable[[], object], *words: str) -> None:
    """It raises one printable line with these words, and allocates next to nothing before."""
    tracemalloc.start()
    try:
        with pytest.raises(ProtocolError) as refusal:
            decode()
        peak_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    text = str(refusal.value)
    assert all(word in text for word in words), text
    assert text.isprintable()
    assert peak_bytes < 1 << 20


@pytest.mark.parametrize("name", HOSTILE_DEPTH)
def test_hostile_depth_is_refused(name: str) -> None:
    codec, found = HOSTILE_DEPTH[name]
    data = found() if callable(found) else found  # bombs are not compressed whenever tests are collected
    image = DepthImage(width=WIDTH, height=HEIGHT, codec=codec, data=data)
    _refused(lambda: decode_depth(image, CAMERA), "depth.data")


def test_a_zstd_frame_whose_header_lies_is_refused() -> None:
    honest = _zstd(SIZE + 2)
    declared = struct.pack("<H", SIZE + 2 - 256)  # RFC 8878 3.1.1.1: two-byte content sizes are stored minus 256
    lying = honest.replace(declared, struct.pack("<H", SIZE - 256), 1)
    assert zstandard.get_frame_parameters(lying).content_size == SIZE
    image = DepthImage(width=WIDTH, height=HEIGHT, codec="zstd-delta", data=lying)
    _refused(lambda: decode_depth(image, CAMERA), "depth.data")


def test_depth_of_another_size_than_the_cameras_is_refused() -> None:
    image = encode_depth(np.zeros((HEIGHT, WIDTH), np.uint16))
    _refused(lambda: decode_depth(image, _camera(WIDTH + 1, HEIGHT)), "depth is 64x48", "camera is 65x48")
    _refused(lambda: decode_depth(_change(image, width=HEIGHT, height=WIDTH), CAMERA), "depth is 48x64")


@pytest.mark.parametrize("wrong", [np.zeros((4, 4), np.int16), np.zeros((4, 4, 1), np.uint16), np.zeros((4, 4))])
def test_arrays_that_are_no_depth_are_not_encoded(wrong: Any) -> None:
    with pytest.raises(ValueError, match="uint16"):
        encode_depth(wrong)


# ---- colour ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("codec", ["png", "raw"])
@pytest.mark.parametrize("seed", range(4))
def test_lossless_colour_survives_bit_for_bit(codec: Any, seed: int) -> None:
    rgb = np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    decoded = decode_color(encode_color(rgb, codec), CAMERA)
    assert decoded.dtype == np.uint8
    assert decoded.flags.writeable
    assert np.array_equal(decoded, rgb)


def test_linear_colour_survives_bit_for_bit_and_is_little_endian() -> None:
    rgb = np.random.default_rng(0).integers(0, 65536, (HEIGHT, WIDTH, 3)).astype(np.uint16)
    image = encode_color(rgb, "raw", "linear16")
    assert image.data == b"".join(struct.pack("<3H", *pixel) for pixel in rgb.reshape(-1, 3).tolist())
    decoded = decode_color(image, LINEAR)
    assert decoded.dtype == np.uint16
    assert np.array_equal(decoded, rgb)


def test_jpeg_is_close_and_keeps_red_red() -> None:
    rgb = _smooth()
    decoded = decode_color(encode_color(rgb, "jpeg", quality=95), CAMERA)
    assert np.abs(decoded.astype(int) - rgb).mean() < 4
    red = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    red[..., 0] = 200
    assert np.abs(decode_color(encode_color(red), CAMERA).astype(int) - red).max() < 4


def test_jpeg_quality_is_used() -> None:
    sizes = [len(encode_color(_smooth(), "jpeg", quality=quality).data) for quality in (20, 60, 95)]
    assert sizes == sorted(sizes)
    assert sizes[0] < sizes[2]


def _imencode(extension: str, picture: NDArray[Any], *options: int) -> bytes:
    done, data = cv2.imencode(extension, picture, options)
    assert done
    return data.tobytes()


def _color(codec: Any, data: bytes, **declared: Any) -> ColorImage:
    return ColorImage(**{"width": WIDTH, "height": HEIGHT, "codec": codec, "data": data, **declared})


@pytest.mark.parametrize(
    "options",
    [
        (),
        (cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
        (cv2.IMWRITE_JPEG_RST_INTERVAL, 4),
        (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
        (cv2.IMWRITE_JPEG_OPTIMIZE, 1),
    ],
)
def test_usual_jpegs_are_accepted(options: tuple[int, ...]) -> None:
    data = _imencode(".jpg", _smooth(), *options)
    assert jpeg_size(data) == (WIDTH, HEIGHT)
    assert decode_color(_color("jpeg", data), CAMERA).shape == (HEIGHT, WIDTH, 3)


def test_grey_jpeg_and_png_with_alpha_are_accepted() -> None:
    grey = _imencode(".jpg", _smooth()[..., 0])
    assert decode_color(_color("jpeg", grey), CAMERA).shape == (HEIGHT, WIDTH, 3)
    with_alpha = _imencode(".png", np.dstack([_smooth(), np.full((HEIGHT, WIDTH), 9, np.uint8)]))
    assert np.array_equal(decode_color(_color("png", with_alpha), CAMERA), _smooth()[..., ::-1])


def test_an_orientation_in_the_jpeg_does_not_turn_it() -> None:
    wide = _smooth()
    plain = _imencode(".jpg", wide)
    tiff = b"MM\x00\x2a" + struct.pack(
        ">IHHHIHHI", 8, 1, 0x0112, 3, 1, 6, 0, 0
    )  # Orientation = 6: turned by 90 degrees
    exif = b"Exif\x00\x00" + tiff
    turned = plain[:2] + b"\xff\xe1" + struct.pack(">H", 2 + len(exif)) + exif + plain[2:]
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR).shape == (WIDTH, HEIGHT, 3)
    assert np.array_equal(decode_color(_color("jpeg", turned), CAMERA), decode_color(_color("jpeg", plain), CAMERA))


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _png(*chunks: bytes, width: int = WIDTH, height: int = HEIGHT, bits: int = 8, kind: int = 2) -> bytes:
    header = _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(chunks) + _chunk(b"IEND", b"")


def _sof(width: int, height: int, marker: int = 0xC0, bits: int = 8, components: int = 3) -> bytes:
    frame = struct.pack(">BHHB", bits, height, width, components) + b"\x01\x11\x00" * components
    return b"\xff\xd8\xff" + bytes([marker]) + struct.pack(">H", 2 + len(frame)) + frame + b"\xff\xd9"


JPEG = _imencode(".jpg", _smooth())
PNG = _imencode(".png", _smooth())
HOSTILE_COLOR: dict[str, tuple[str, bytes]] = {
    "raw too short": ("raw", bytes(3 * WIDTH * HEIGHT - 1)),
    "raw too long": ("raw", bytes(3 * WIDTH * HEIGHT + 1)),
    "jpeg empty": ("jpeg", b""),
    "jpeg that is a png": ("jpeg", PNG),
    "jpeg cut": ("jpeg", JPEG[:-20]),
    "jpeg cut in its header": ("jpeg", JPEG[:30] + b"\xff\xd9"),
    "jpeg without a picture": ("jpeg", b"\xff\xd8\xff\xd9"),
    "jpeg of another size": ("jpeg", _imencode(".jpg", np.zeros((HEIGHT, WIDTH + 1, 3), np.uint8))),
    "jpeg turned": ("jpeg", _imencode(".jpg", np.zeros((WIDTH, HEIGHT, 3), np.uint8))),
    "jpeg of 65535 x 65535": ("jpeg", _sof(65535, 65535)),
    "jpeg of no height": ("jpeg", _sof(WIDTH, 0)),
    "jpeg of 12 bits": ("jpeg", _sof(WIDTH, HEIGHT, bits=12)),
    "jpeg of CMYK": ("jpeg", _sof(WIDTH, HEIGHT, components=4)),
    "jpeg arithmetic": ("jpeg", _sof(WIDTH, HEIGHT, marker=0xC9)),
    "jpeg lossless": ("jpeg", _sof(WIDTH, HEIGHT, marker=0xC3)),
    "jpeg frame header only": ("jpeg", _sof(WIDTH, HEIGHT)),
    "jpeg of many scans": ("jpeg", JPEG[:-2] + b"\xff\xda" * (MAX_JPEG_SCANS + 1) + b"\xff\xd9"),
    "jpeg segment of no length": ("jpeg", b"\xff\xd8\xff\xe0\x00\x00" + JPEG[2:]),
    "png empty": ("png", b""),
    "png that is a jpeg": ("png", JPEG),
    "png cut": ("png", PNG[:-12]),
    "png cut in a chunk": ("png", PNG[: len(PNG) // 2]),
    "png signature only": ("png", PNG[:8]),
    "png bytes after it": ("png", PNG + b"\x00"),
    "png of another size": ("png", _imencode(".png", np.zeros((HEIGHT + 1, WIDTH, 3), np.uint8))),
    "png of 2 G x 2 G": ("png", _png(width=2**31 - 1, height=2**31 - 1)),
    "png of 16 bits": ("png", _imencode(".png", np.zeros((HEIGHT, WIDTH, 3), np.uint16))),
    "png grey": ("png", _imencode(".png", np.zeros((HEIGHT, WIDTH), np.uint8))),
    "png without data": ("png", _png()),
    "png of garbage": ("png", _png(_chunk(b"IDAT", b"garbage"))),
    "png with compressed text": ("png", _png(_chunk(b"zTXt", b"k\x00\x00" + zlib.compress(bytes(8 << 20))))),
    "png animated": ("png", _png(_chunk(b"acTL", struct.pack(">II", 1000, 0)))),
    "png chunk of 4 GB": ("png", PNG[:33] + struct.pack(">I4s", 2**32 - 1, b"IDAT") + PNG[41:]),
    "png of many chunks": ("png", _png(*[_chunk(b"IDAT", b"")] * 10_000)),
    "png whose first chunk is no header": ("png", PNG[:8] + PNG[33:]),
}


@pytest.mark.parametrize("name", HOSTILE_COLOR)
def test_hostile_colour_is_refused(name: str) -> None:
    codec, data = HOSTILE_COLOR[name]
    _refused(lambda: decode_color(_color(codec, data), CAMERA), "color.data")


@pytest.mark.parametrize("codec", ["jpeg", "png"])
def test_damaged_pictures_are_refused_or_decoded_to_the_declared_size(codec: Any) -> None:
    random = np.random.default_rng(5)
    whole = JPEG if codec == "jpeg" else PNG
    for _ in range(300):
        damaged = bytearray(whole)
        for at in random.integers(0, len(whole), random.integers(1, 4)):
            damaged[at] = random.integers(0, 256)
        try:
            rgb = decode_color(_color(codec, bytes(damaged)), CAMERA)
        except ProtocolError:
            continue
        assert rgb.shape == (HEIGHT, WIDTH, 3)


def test_headers_agree_with_opencv_on_random_sizes() -> None:
    random = np.random.default_rng(2)
    for width, height in random.integers(1, 300, (20, 2)).tolist():
        picture = np.zeros((height, width, 3), np.uint8)
        assert jpeg_size(_imencode(".jpg", picture)) == (width, height)
        assert png_size(_imencode(".png", picture)) == (width, height)


def test_colour_of_another_size_or_encoding_than_the_cameras_is_refused() -> None:
    image = encode_color(_smooth(), "raw")
    _refused(lambda: decode_color(image, _camera(WIDTH, HEIGHT + 8)), "color is 64x48", "camera is 64x56")
    _refused(lambda: decode_color(image, LINEAR), "color.encoding", "linear16")
    assert decode_color(image, LINEAR, "srgb8").dtype == np.uint8  # a composite of a linear session


@pytest.mark.parametrize("codec", ["jpeg", "png"])
def test_linear_colour_goes_raw_only(codec: Any) -> None:
    with pytest.raises(ProtocolError, match="as raw"):
        encode_color(np.zeros((HEIGHT, WIDTH, 3), np.uint16), codec, "linear16")
    data = JPEG if codec == "jpeg" else PNG
    _refused(lambda: decode_color(_color(codec, data, encoding="linear16"), LINEAR), "color.codec", "as raw")


@pytest.mark.parametrize("wrong", [np.zeros((8, 8), np.uint8), np.zeros((8, 8, 4), np.uint8), np.zeros((8, 8, 3))])
def test_arrays_that_are_no_colour_are_not_encoded(wrong: Any) -> None:
    with pytest.raises(ValueError, match="colour of srgb8"):
        encode_color(wrong)
