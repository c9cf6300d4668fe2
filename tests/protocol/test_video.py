"""Video there and back: the picture's own size and colours, one out for each one in, and errors for what is damaged."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("av")

from client.streaming.video import VideoEncoder
from protocol.codec import ProtocolError
from protocol.colors import ColorReader, readable_codecs
from protocol.frames import CameraModel
from protocol.images import decode_color
from protocol.messages import ColorImage
from protocol.video import VideoDecoder

CAMERA = CameraModel(width=96, height=64, fx=80.0, fy=80.0, cx=47.5, cy=31.5)


def moving(number: int, width: int = 96, height: int = 64) -> np.ndarray:
    """[h, w, 3]: smooth, all colours, further on in each picture."""
    y, x = np.mgrid[:height, :width]
    waves = [np.sin((x + 3 * number) / 11), np.cos((y - number) / 7), np.sin((x + y + 2 * number) / 9)]
    return (127 + 120 * np.stack(waves, axis=-1)).astype(np.uint8)


def psnr_db(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - b) ** 2)))


def test_each_picture_comes_out_at_once_and_is_the_one_that_went_in() -> None:
    video, reader = VideoEncoder(), ColorReader(CAMERA)
    sizes = []
    for number in range(12):
        image = video.encode(moving(number), 90)
        sizes.append(len(image.data))
        color = reader.decode(image)
        assert color.dtype == np.uint8
        assert psnr_db(color, moving(number)) > 30
        assert psnr_db(color, moving(number + 1)) < psnr_db(color, moving(number))
    assert np.mean(sizes[1:]) < 0.7 * sizes[0]


@pytest.mark.parametrize("rgb", [(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255), (0, 0, 0), (30, 128, 220)])
def test_colours_keep_their_values(rgb: tuple[int, int, int]) -> None:
    flat = np.full((64, 96, 3), rgb, np.uint8)
    found = ColorReader(CAMERA).decode(VideoEncoder().encode(flat, 90))
    assert np.abs(found.astype(int) - flat).max() <= 3


def test_a_grey_ramp_stays_straight() -> None:
    ramp = np.repeat(np.linspace(0, 255, 96).astype(np.uint8)[None, :, None], 64, axis=0).repeat(3, axis=2)
    found = ColorReader(CAMERA).decode(VideoEncoder().encode(ramp, 95)).astype(int)
    assert np.abs(found.mean((0, 2)) - ramp.mean((0, 2))).max() < 2.5


def test_quality_and_size_may_change_on_the_way() -> None:
    video, reader = VideoEncoder(), ColorReader(CAMERA)
    for number, (width, quality) in enumerate([(96, 90), (96, 90), (96, 50), (48, 50), (48, 50), (96, 90)]):
        image = video.encode(moving(number, width, width * 2 // 3), quality)
        assert (image.width, image.codec) == (width, "h264")
        assert reader.decode(image).shape == (64, 96, 3)


def test_what_is_missing_is_told_until_a_key_picture_comes() -> None:
    video, reader = VideoEncoder(), ColorReader(CAMERA)
    pictures = []
    for number in range(8):
        if number == 6:
            video.need_key()
        pictures.append(video.encode(moving(number), 80))
    reader.decode(pictures[0])
    for place in (2, 3, 5):
        with pytest.raises(ProtocolError, match="send a key picture"):
            reader.decode(pictures[place])
    for place in (6, 7):
        assert psnr_db(reader.decode(pictures[place]), moving(place)) > 28


def test_a_damaged_picture_is_an_error_and_what_rests_on_it_too() -> None:
    video, refused = VideoEncoder(), 0
    chance = np.random.default_rng(7)
    for _ in range(40):
        video.need_key()
        reader = ColorReader(CAMERA)
        key, second, third = (video.encode(chance.integers(0, 255, (64, 96, 3), np.uint8), 60) for _ in range(3))
        data = bytearray(second.data)
        for place in chance.integers(40, len(data), 8):
            data[place] ^= 1 << int(chance.integers(8))
        reader.decode(key)
        try:
            assert reader.decode(ColorImage(width=96, height=64, codec="h264", data=bytes(data))).shape == (64, 96, 3)
        except ProtocolError:
            refused += 1
            with pytest.raises(ProtocolError, match="send a key picture"):
                reader.decode(third)
    assert refused > 20


def test_a_decoder_alone_takes_nothing_but_pictures() -> None:
    for data in (b"\x00", b"\x00\x00\x01\x09\x10", bytes(range(256))):
        with pytest.raises(ProtocolError, match="h264"):
            VideoDecoder().decode(data)


def test_video_is_of_the_cameras_size_or_a_half_or_a_quarter_of_it() -> None:
    image = VideoEncoder().encode(moving(0, 80, 64), 80)
    with pytest.raises(ProtocolError, match="color is 80x64, the session's camera is 96x64"):
        ColorReader(CAMERA).decode(image)
    lying = ColorImage(width=96, height=64, codec="h264", data=image.data)
    with pytest.raises(ProtocolError, match="video of 80x64, color declares 96x64"):
        ColorReader(CAMERA).decode(lying)


def test_it_is_no_picture_by_itself() -> None:
    with pytest.raises(ProtocolError, match="one after the other"):
        decode_color(VideoEncoder().encode(moving(0), 80), CAMERA)
    assert "h264" in readable_codecs()


def test_without_its_library_it_is_refused_in_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("protocol.colors.IS_POSSIBLE", False)
    assert readable_codecs() == ("jpeg", "png", "raw")
    with pytest.raises(ProtocolError, match=r"needs PyAV .* jpeg \(welcome.codecs\)"):
        ColorReader(CAMERA).decode(VideoEncoder().encode(moving(0), 80))


def test_odd_sides_are_for_jpeg() -> None:
    video = VideoEncoder()
    assert video.can_encode(96, 64)
    assert not video.can_encode(97, 64)
    assert not video.can_encode(96, 63)
