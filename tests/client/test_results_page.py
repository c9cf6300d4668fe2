"""The page of an output folder: its data is what the other files hold, also where a run ends early."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from client.errors import SourceError
from client.results.camera_pictures import LONGEST_SIDE_PX, encode_camera_picture
from client.results.frame_rows import STAGES, rounded
from client.results.output_folder import OutputWriter
from client.results.page import PAGE
from tests.client.results_page import DESCRIPTION, NOTE, OBJECT, data_of, output_of, write_run, write_until


def lines(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_rows_are_what_the_other_files_hold(tmp_path: Path) -> None:
    data = data_of(write_run(tmp_path))
    lights, timings = lines(tmp_path / "light.jsonl"), lines(tmp_path / "timings.jsonl")
    path = [line.split() for line in (tmp_path / "trajectory.txt").read_text().splitlines()]
    assert len(data["frames"]) == len(lights) == len(timings) == len(path) == 12
    for row, light, timing, place in zip(data["frames"], lights, timings, path, strict=True):
        drawn = row["drawn"]
        assert (row["frame"], row["time"]) == (light["frame"], light["timestamp_s"])
        assert (tmp_path / "frames" / f"{row['frame']:06d}.png").is_file()
        assert drawn["ms"] == [timing[name] for name in STAGES]
        assert (drawn["total"], drawn["host"], drawn["tracking"]) == (timing["total"], timing["host"], "given")
        assert np.allclose(np.reshape(drawn["pose"], (3, 4))[:, 3], [float(x) for x in place[1:4]])
        effects = [data["tables"]["effects"][i] for i in drawn["run"]]
        assert effects == timing["plan"]["run"]
        left_out = [
            dict(zip(("effect", "reason", "error_bound"), data["tables"]["left_out"][i], strict=True))
            for i in drawn["out"]
        ]
        assert left_out == timing["plan"]["left_out"]
        assert data["tables"]["points"][drawn["point"]] == ["--rays 81", "asked for"]
        assert drawn.get("notes", []) == timing.get("notes", [])


def test_lights_are_those_of_the_file_to_four_digits(tmp_path: Path) -> None:
    data = data_of(write_run(tmp_path, 3))
    assert data["tables"]["places"] == [["beyond", 0], ["object", 0]]
    for row, told in zip(data["frames"], lines(tmp_path / "light.jsonl"), strict=True):
        beyond, arriving = row["lights"]
        assert np.allclose(beyond["sh"], np.ravel(told["sh"]), rtol=5e-4)
        assert np.allclose(beyond["towards"], told["dominant_direction"], rtol=5e-4)
        assert (beyond["spread"], beyond["valid"]) == (told["spread_deg"], told["valid"])
        assert arriving["at"] == told["at"][0]["position"]
        assert (arriving["spread"], arriving["seen"]) == (12.5, 0.5)


def test_what_the_run_was_is_said(tmp_path: Path) -> None:
    data = data_of(write_run(tmp_path, 2))
    head = {name: data[name] for name in ("source", "device", "fps", "total", "ended", "objects", "video", "up")}
    assert head == {
        "source": "a table",
        "device": "a fake device",
        "fps": 30.0,
        "total": 2,
        "ended": "",
        "objects": ["duck <b>.glb"],
        "video": None,
        "up": [0.0, -1.0, 0.0],
    }
    assert data["camera"] == {"width": 64, "height": 48, "fx": 50.0, "fy": 50.0, "cx": 31.5, "cy": 23.5}


def test_nothing_in_the_data_is_markup(tmp_path: Path) -> None:
    write_run(tmp_path, 2)
    page = (tmp_path / "index.html").read_text()
    data = page[page.index('id="data"') :]
    data = data[data.index(">") + 1 : data.index("</script>")]
    assert "<" not in data
    assert json.loads(data)["frames"][1]["drawn"]["notes"] == [NOTE]


def test_the_page_needs_no_other_file_but_pictures() -> None:
    built = PAGE.read_text("utf-8").replace("http://www.w3.org/1999/xhtml", "")
    assert built.count("<!--data-->") == 1
    for address in ("http://", "https://", "import(", ' src="', '<link rel="stylesheet'):
        assert address not in built, address


def test_camera_pictures_are_the_cameras(tmp_path: Path) -> None:
    data = data_of(write_run(tmp_path, 2))
    stored = cv2.imread(str(tmp_path / "camera" / "000001.jpg"), cv2.IMREAD_COLOR_RGB)
    captured = output_of(1).captured
    assert captured is not None
    assert np.abs(stored.astype(int) - captured.color).mean() < 10  # of noise, which JPEG keeps least; measured 6.4
    drawn = data["frames"][1]["drawn"]
    assert drawn["picture"] == 2
    share, first, last = drawn["changed"]
    assert share == pytest.approx(12 * 12 / (48 * 64), abs=0.002)
    assert (first, last) == pytest.approx((OBJECT[1].start / 64, OBJECT[1].stop / 64), abs=0.02)


def test_a_picture_without_virtual_content_is_kept_once(tmp_path: Path) -> None:
    with OutputWriter(tmp_path, DESCRIPTION) as writer:
        plain = output_of(0)
        assert plain.captured is not None
        writer.write(replace(plain, color=plain.captured.color))
    assert not (tmp_path / "camera").exists()
    assert data_of(tmp_path)["frames"][0]["drawn"]["picture"] == 1


def test_large_camera_pictures_are_reduced() -> None:
    large = np.zeros((1000, 2560, 3), np.uint8)
    small = cv2.imdecode(np.frombuffer(encode_camera_picture(large), np.uint8), cv2.IMREAD_COLOR)
    assert small.shape == (500, LONGEST_SIDE_PX, 3)


def test_the_scan_is_the_wall_in_its_colours(tmp_path: Path) -> None:
    scan = data_of(write_run(tmp_path))["scan"]
    count = scan["count"]
    steps = np.frombuffer(base64.b64decode(scan["places"]), "<u2").reshape(count, 3)
    colors = np.frombuffer(base64.b64decode(scan["colors"]), np.uint8).reshape(count, 3)
    least, most = np.array(scan["least"]), np.array(scan["most"])
    places = least + (most - least) * steps / 65535
    assert np.allclose(places[:, 2], 1.0)
    assert places[:, 0].min() == pytest.approx(-31.5 / 50, abs=0.03)
    assert places[:, 0].max() == pytest.approx(32.5 / 50 + 0.1, abs=0.05)
    seen = output_of(0).captured
    assert seen is not None
    assert np.abs(colors.mean(0) - seen.color.mean((0, 1))).max() < 8


@pytest.mark.parametrize(
    ("error", "ended"),
    [
        (KeyboardInterrupt(), "interrupted"),
        (SourceError("frame 3: color.jpg is\ntruncated"), "frame 3: color.jpg is truncated"),
        (ZeroDivisionError("x"), "stopped by an error"),
    ],
)
def test_a_run_that_ends_early_has_a_page(error: BaseException, ended: str, tmp_path: Path) -> None:
    with pytest.raises(type(error)):
        write_until(tmp_path, error)
    data = data_of(tmp_path)
    assert (len(data["frames"]), data["total"], data["ended"]) == (3, 12, ended)


def test_without_a_frame_there_is_no_page(tmp_path: Path) -> None:
    with OutputWriter(tmp_path, DESCRIPTION):
        pass
    assert not (tmp_path / "index.html").exists()


def test_lights_alone_have_a_page(tmp_path: Path) -> None:
    with OutputWriter(tmp_path, DESCRIPTION) as writer:
        writer.write_light(output_of(4).light)
    (row,) = data_of(tmp_path)["frames"]
    assert (row["frame"], row["drawn"]) == (4, None)


def test_an_overwritten_run_leaves_nothing(tmp_path: Path) -> None:
    write_run(tmp_path, 4)
    (tmp_path / "camera" / "mine.jpg").write_text("keep")
    (tmp_path / "video.mp4").write_text("")
    with OutputWriter(tmp_path, overwrite=True) as writer:
        writer.write(replace(output_of(0), captured=None))
    assert sorted(path.name for path in (tmp_path / "camera").iterdir()) == ["mine.jpg"]
    assert not (tmp_path / "index.html").exists()
    assert not (tmp_path / "video.mp4").exists()


def test_equal_inputs_give_equal_pages(tmp_path: Path) -> None:
    first, second = write_run(tmp_path / "a", 3), write_run(tmp_path / "b", 3)
    assert (first / "index.html").read_bytes() == (second / "index.html").read_bytes()


def test_rounding_keeps_four_digits() -> None:
    assert rounded((0.123456, 1234567.0, 3.0, -0.0, 1e-9)) == [0.1235, 1235000, 3, 0, 1e-9]
