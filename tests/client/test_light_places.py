"""`--light-at` and `--panorama-out`, and the light in words."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from client.display.light_words import light_line, light_lines, unknown_lines
from client.errors import OptionError
from client.options.capture import prepare
from client.options.capture_options import CaptureOptions
from client.options.light_places import PanoramaOut, parse_light_at, parse_panorama_out, write_panorama
from protocol.limits import MAX_LIGHT_PLACES
from protocol.messages import ArrivingLight, Light
from tests.client.lights import light_of
from tests.protocol.samples import SERVER


def test_places_become_wishes_in_their_order() -> None:
    texts = ["1,2,3", "-0.5,0,1e-1"]
    assert parse_light_at(texts) == ((1.0, 2.0, 3.0), (-0.5, 0.0, 0.1))
    capture = prepare(CaptureOptions(source="synthetic:table", frames="0:1", light_at=texts))
    assert capture.wishes.light_at == parse_light_at(texts)
    assert parse_light_at(None) == ()


@pytest.mark.parametrize("text", ["1,2", "1,2,3,4", "a,b,c", "1,2,nan", "inf,0,0", ""])
def test_a_place_is_three_finite_numbers(text: str) -> None:
    with pytest.raises(OptionError, match="expected x,y,z, finite numbers in metres"):
        parse_light_at([text])


def test_too_many_places_are_refused_in_one_line() -> None:
    assert len(parse_light_at(["0,0,0"] * MAX_LIGHT_PLACES)) == MAX_LIGHT_PLACES
    with pytest.raises(OptionError, match=f"17 places were named, at most {MAX_LIGHT_PLACES} are told"):
        parse_light_at(["0,0,0"] * (MAX_LIGHT_PLACES + 1))


def test_panorama_files(tmp_path: Path) -> None:
    assert parse_panorama_out(None) is None
    for name, expected in (
        ("sky.hdr", ("hdr", None)),
        ("SKY.EXR@1,-2,0.5", ("exr", (1.0, -2.0, 0.5))),
        ("a@b.exr", ("exr", None)),
        ("a@b/sky.hdr@0,0,0", ("hdr", (0.0, 0.0, 0.0))),
    ):
        path = tmp_path / name.rpartition("@0")[0] if name.endswith("@0,0,0") else tmp_path / name.split("@1")[0]
        assert parse_panorama_out(str(tmp_path / name)) == PanoramaOut(path, *expected)
    assert (tmp_path / "a@b").is_dir(), "the folder is made before the frames"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("sky.png", "expected FILE.hdr or FILE.exr"),
        ("sky.hdr@1,2", "expected x,y,z"),
        ("sky.hdr@", "expected x,y,z"),
        ("sky.exr@1,2,nan", "expected x,y,z"),
        ("sky@1,2,3", "expected FILE.hdr or FILE.exr"),
    ],
)
def test_wrong_panorama_files_are_refused(text: str, told: str, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=told):
        parse_panorama_out(str(tmp_path / text))


def test_a_file_that_cannot_be_written_is_refused_before_the_frames(tmp_path: Path) -> None:
    (tmp_path / "sky.hdr").mkdir()
    (tmp_path / "file").touch()
    for name in ("sky.hdr", "file/sky.hdr"):
        with pytest.raises(OptionError, match="cannot be written"):
            parse_panorama_out(str(tmp_path / name))
    with pytest.raises(OptionError, match="cannot be written"):
        write_panorama(tmp_path / "gone" / "sky.hdr", b"x")


def told() -> Light:
    light = SERVER["light_at_places"]
    assert isinstance(light, Light)
    return light


def arriving(**changes: object) -> ArrivingLight:
    return msgspec.structs.replace(told().at[0], **changes)


def test_a_light_that_is_known_is_not_doubted() -> None:
    light = msgspec.structs.replace(told(), at=(arriving(),))
    assert unknown_lines(light) == []
    assert light_line(light).endswith("intensity 1.2")


def test_what_is_not_known_is_said_in_words() -> None:
    at = (
        arriving(spread_deg=40.4, valid=False),
        arriving(of="place", index=1, spread_deg=None, valid=True),
        arriving(of="object", index=0, position=(0.5, 1.0, -2.0), spread_deg=None, valid=True),
        arriving(of="place", index=2, position=(9.0, 0.0, 0.0), seen=0.0),
    )
    light = msgspec.structs.replace(told(), at=at, spread_deg=90.0, valid=False)
    assert light_line(light).endswith("its direction may be off by 90 degrees")
    assert unknown_lines(light) == [
        "at the middle of the view: its direction may be off by 40 degrees",
        "at place 2 (0.25, 0.50, 1.75), object 1 (0.50, 1.00, -2.00): how far its direction may be off is not known",
        "at place 3 (9.00, 0.00, 0.00): no scanned surface is seen from there, its light is a guess",
    ]
    assert [line.startswith("light ") for line in light_lines(light)] == [True] * 4


def test_a_light_of_an_earlier_server_has_no_places() -> None:
    assert unknown_lines(light_of(0)) == []
    assert light_line(light_of(0)).endswith("not fixed by the pictures so far")
