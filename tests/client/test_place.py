"""`probeless place`: what a click says is where the object then stands."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from client.cli import run_command
from client.commands.place import DEPTH_STEP, frames_to_show, write_place_page
from client.options.source import open_source
from client.results.names import PLACE_NAME
from client.sources.frame_source import ENDLESS
from protocol.frames import CameraModel, RgbdFrame

SOURCE = "synthetic:table?size=160x120&frames=9"


def data_of(page: Path) -> dict:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text(), re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def picture_of(frame: dict) -> NDArray[np.uint8]:
    jpeg = np.frombuffer(base64.b64decode(frame["picture"].partition(",")[2]), np.uint8)
    return cv2.imdecode(jpeg, cv2.IMREAD_COLOR_RGB)


def test_frames_are_spread_over_the_source() -> None:
    assert frames_to_show(range(5, 8)) == [5, 6, 7]
    shown = frames_to_show(range(10, 110), most=4)
    assert (shown[0], shown[-1], len(shown)) == (10, 109, 4)
    assert frames_to_show(range(3, ENDLESS)) == [3]


def test_the_page_has_the_frames_with_the_depth_of_their_pixels(tmp_path: Path) -> None:
    assert run_command(["place", SOURCE, "--frames", "2:9", "--object", "cup.obj", "--out", str(tmp_path)]) == 0
    data = data_of(tmp_path / PLACE_NAME)
    assert (data["source"], data["object"], data["width"], data["height"]) == (SOURCE, "cup.obj", 160, 120)
    source = open_source(SOURCE)
    assert [frame["index"] for frame in data["frames"]] == list(range(2, 9))
    for frame in data["frames"]:
        expected = source[frame["index"]]
        depth = np.frombuffer(base64.b64decode(frame["depth"]), "<u2").reshape(30, 40)
        assert (depth == expected.depth[::DEPTH_STEP, ::DEPTH_STEP]).all()
        picture = picture_of(frame)
        assert np.abs(picture.astype(float) - expected.color).mean() < 2


class _Source:
    """One frame of a distorted lens, whose name could end the page."""

    def __init__(self, camera: CameraModel, frame: RgbdFrame) -> None:
        self.camera, self._frame = camera, frame

    def __getitem__(self, index: int) -> RgbdFrame:
        return replace(self._frame, index=index)

    def __len__(self) -> int:
        return 1

    def __iter__(self) -> Iterator[RgbdFrame]:
        yield self._frame


def test_a_name_of_a_source_cannot_become_a_part_of_the_page(tmp_path: Path) -> None:
    source = open_source(SOURCE)
    write_place_page(tmp_path / "a.html", source, "</script><b>x", [0])
    assert data_of(tmp_path / "a.html")["source"] == "</script><b>x"


def test_pictures_are_without_distortion_as_the_pixels_of_the_option_are(tmp_path: Path) -> None:
    source = open_source(SOURCE)
    lens = source.camera
    camera = CameraModel(
        width=160,
        height=120,
        fx=lens.fx,
        fy=lens.fy,
        cx=lens.cx,
        cy=lens.cy,
        distortion=(0.2, -0.05, 0.001, 0.002, 0.0),
    )
    straight = np.zeros((120, 160, 3), np.uint8)
    straight[:, 136:140] = 255
    # Where the lens shows each pixel of a bent picture: OpenCV's model, the other way round.
    v, u = np.mgrid[0:120, 0:160].astype(np.float32)
    matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    ideal = cv2.undistortPoints(np.stack([u, v], -1).reshape(-1, 1, 2), matrix, np.array(camera.distortion), P=matrix)
    maps = ideal.reshape(120, 160, 2).astype(np.float32)
    bent = cv2.remap(straight, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR)
    write_place_page(tmp_path / "a.html", _Source(camera, replace(source[0], color=bent)), "bent", [0])
    (frame,) = data_of(tmp_path / "a.html")["frames"]
    assert frame["depth"] is None  # is of the lens as it is
    columns = np.arange(160)
    rows = np.where(picture_of(frame)[10:110, :, 0] > 60, picture_of(frame)[10:110, :, 0], 0).astype(float)
    middles = (rows * columns).sum(axis=1) / rows.sum(axis=1)
    assert np.abs(middles - 137.5).max() < 0.5
    bent_rows = bent[10:110, :, 0].astype(float)
    assert np.ptp((bent_rows * columns).sum(axis=1) / bent_rows.sum(axis=1)) > 1.0


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    assert run_command(["place", SOURCE, "--out", str(tmp_path / "file")]) == 1
    assert "cannot be written" in capsys.readouterr().err
