"""The benchmark of speed on a small scene: every row is there, and counts are what they are said to be."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from client.gallery.source import GallerySource
from protocol.frames import RgbdFrame
from protocol.messages import TIMING_ROWS
from server.opencl.device import Device
from tests.bench.speed.frames import DEFAULT, EMPTY, FAST, WARM_UP, WITHOUT, Stage, measure_moving, measure_rest


class BackAndForth(GallerySource):
    """A scene whose camera returns the way it came, for as long as is asked."""

    def __getitem__(self, index: int) -> RgbdFrame:
        last = super().__len__() - 1
        return replace(super().__getitem__(last - abs(last - index % (2 * last))), index=index)


def small_stage(folder: Path) -> Stage:
    source = BackAndForth("closed-room", width=80)
    (folder / "ball.glb").write_bytes(source.scene.objects[0].glb())
    return Stage(source, folder / "ball.glb", source.scene.objects[0].position(0), 1.0)


def test_a_moving_camera_has_all_rows(device: Device, tmp_path: Path) -> None:
    said: list[str] = []
    part = measure_moving(device, small_stage(tmp_path), range(WARM_UP + 4), said.append)
    rows = {row.name: row.value for row in part.rows}
    assert part.sizes == {"frames of a moving camera": 4}
    for name in (DEFAULT, WITHOUT, FAST, EMPTY):
        assert rows[f"moving camera, {name}: frame, median"] > 0
    for row in TIMING_ROWS:
        assert rows[f"moving camera, {DEFAULT}: {row}, median"] >= 0
    assert rows[f"moving camera, {DEFAULT}: radiance_transfer, median"] > 0
    assert 20 < rows["moving camera: kernels launched, median"] < 200
    assert 3 <= rows["moving camera: blocking reads, median"] < 40
    assert 0 < rows["moving camera: host's own time, median"] < rows[f"moving camera, {DEFAULT}: frame, 95 % of them"]
    assert rows["moving camera: share of the frame that no row tells"] < 100
    assert rows["moving camera: frame without caches / with, median"] > 0
    assert len(said) == 2
    flips = [value for name, value in rows.items() if "FLIP" in name]
    assert all(0 <= value < 0.02 for value in flips)


def test_a_camera_at_rest_is_timed_once_nothing_is_computed_again(device: Device, tmp_path: Path) -> None:
    part = measure_rest(device, small_stage(tmp_path), 0, 110, lambda _text: None)
    rows = {row.name: row.value for row in part.rows}
    assert np.isfinite(rows["camera at rest: frame, median"])
    assert 16 < rows["camera at rest: frames until nothing is computed again"] < 90
    settling = measure_rest(device, small_stage(tmp_path), 0, 6, lambda _text: None)
    assert not settling.rows
    assert "did not settle within 6 frames" in settling.unmeasured[0].reason
