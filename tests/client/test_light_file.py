"""Lights from files: what `--light` and `--panorama` take, what they become, and what is refused with one line."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from client.errors import OptionError
from client.options.capture import CaptureOptions, prepare
from client.options.light_file import read_light, read_panorama_light
from protocol.messages import Wishes
from server.light.static_light import static_estimate
from server.maths.sh import dominant_direction, webxr_from_world
from tests.client import folders
from tests.scenes import lights
from tests.scenes.lights import degrees_between

LIGHT = lights.lobe_and_sky((0.3, 0.8, -0.2))
WEBXR = webxr_from_world(np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0]))


def rows(sh: np.ndarray) -> list[list[float]]:
    return [[float(value) for value in row] for row in sh]


def test_ground_truth_light(tmp_path: Path) -> None:
    path = tmp_path / "light.json"
    path.write_text(json.dumps({"sh": rows(LIGHT), "note": "of the data set"}, indent=1))
    np.testing.assert_array_equal(read_light(path), LIGHT)


def test_last_line_of_a_run(tmp_path: Path) -> None:
    """The finest that the line has."""
    more = np.arange(75.0).reshape(25, 3)
    path = tmp_path / "light.jsonl"
    path.write_text(
        json.dumps({"sh": rows(2 * LIGHT)}) + "\n" + json.dumps({"sh": rows(LIGHT), "sh_all": rows(more)}) + "\n"
    )
    np.testing.assert_array_equal(read_light(path), more)


def test_a_line_of_another_exposure_is_brought_to_the_first_picture_s_units(tmp_path: Path) -> None:
    path = tmp_path / "light.jsonl"
    path.write_text(json.dumps({"sh": rows(2 * LIGHT), "exposure": 2.0}))
    np.testing.assert_array_equal(read_light(path), LIGHT)


def test_radiance_is_brought_to_the_picture_s_units(tmp_path: Path) -> None:
    """A light.json is radiance; a light.jsonl is in units of the picture already."""
    path = tmp_path / "light.json"
    path.write_text(json.dumps({"sh": rows(LIGHT)}))
    np.testing.assert_allclose(read_light(path, 2.0), LIGHT / 2)
    path.write_text(json.dumps({"frame": 3, "sh": rows(LIGHT)}))
    np.testing.assert_array_equal(read_light(path, 2.0), LIGHT)


@pytest.mark.parametrize(
    "content",
    [
        None,
        b"",
        b"\xff\xfe",
        b"no json",
        b"[]",
        b"{}",
        b'{"sh": 3}',
        b'{"sh": [[1, 2, 3], [1, 2, 3]]}',
        b'{"sh": [[1, 2]]}',
        b'{"sh": [[1, 2, "x"]]}',
        b'{"sh": [[1, 2, NaN]]}',
        b'{"sh": [[1, 2, 3]], "exposure": 0}',
        b'{"sh": [[1, 2, 3]], "exposure": NaN}',
        b'{"sh": [[1, 2, 3]], "exposure": "long"}',
    ],
)
def test_files_that_are_no_lights(content: bytes | None, tmp_path: Path) -> None:
    path = tmp_path / "light.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(OptionError, match="--light") as caught:
        read_light(path)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_panorama(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="--panorama"):
        read_panorama_light(tmp_path / "none.hdr", 4)


@pytest.mark.parametrize("name", ["sky.hdr", "sky.EXR"])
def test_a_panorama_is_no_light(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"#?RADIANCE")
    with pytest.raises(OptionError, match="is a panorama; give it with --panorama"):
        read_light(tmp_path / name)


def test_options_become_wishes(tmp_path: Path) -> None:
    source = str(folders.redwood(tmp_path / "redwood"))
    light, sky = tmp_path / "light.json", tmp_path / "sky.hdr"
    light.write_text(json.dumps({"sh": rows(LIGHT)}))
    cv2.imwrite(str(sky), np.ones((16, 32, 3), np.float32))
    given = prepare(CaptureOptions(source, light=str(light))).wishes
    assert given.light_axes == "world"
    np.testing.assert_array_equal(given.light, LIGHT)
    around = prepare(CaptureOptions(source, panorama=str(sky), bands=3)).wishes
    assert (len(around.light), around.light_axes) == (9, "webxr")
    assert (given.tone_mapping, around.tone_mapping) == ("auto", "average")  # a panorama's units are its own
    assert prepare(CaptureOptions(source, panorama=str(sky), tone_mapping="light")).wishes.tone_mapping == "light"
    assert prepare(CaptureOptions(source)).wishes.light is None
    with pytest.raises(OptionError, match="leave one of the two out"):
        prepare(CaptureOptions(source, light=str(light), panorama=str(sky)))


def test_wishes_refuse_what_is_no_light() -> None:
    with pytest.raises(ValueError, match="coefficients"):
        Wishes(light=((1.0, 1.0, 1.0),) * 5)
    with pytest.raises(ValueError, match="finite"):
        Wishes(light=((1.0, float("nan"), 1.0),))


@pytest.mark.parametrize("bands", [2, 4, 6])
def test_given_in_world_axes(bands: int) -> None:
    estimate = static_estimate(Wishes(light=tuple(map(tuple, rows(LIGHT)))), bands, WEBXR)
    assert estimate is not None
    assert estimate.valid
    count = min(16, bands * bands)
    assert estimate.sh.shape == (bands * bands, 3)
    np.testing.assert_array_equal(estimate.sh[:count], LIGHT[:count])
    np.testing.assert_array_equal(estimate.sh[count:], 0)
    np.testing.assert_array_equal(estimate.std, 0)


def test_given_in_webxr_axes_is_turned_into_the_world() -> None:
    """Above (+y) and right (+x) in a panorama, for a camera that looks along +x in a world whose z is up."""
    webxr = webxr_from_world(np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]))
    light = lights.lobe_and_sky((1.0, 1.0, 0.0))
    estimate = static_estimate(Wishes(light=tuple(map(tuple, rows(light))), light_axes="webxr"), 4, webxr)
    assert estimate is not None
    assert degrees_between(dominant_direction(estimate.sh), (0.0, -1.0, 1.0)) < 1e-4


def test_nothing_given() -> None:
    assert static_estimate(Wishes(), 4, WEBXR) is None
