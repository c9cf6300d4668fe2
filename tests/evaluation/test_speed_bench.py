"""The benchmark of speed on a small scene: every row is there, and counts are what they are said to be."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from client.gallery.source import GallerySource
from protocol.frames import RgbdFrame
from protocol.messages import TIMING_ROWS
from server.opencl.device import Device, open_device
from tests.bench.speed import devices
from tests.bench.speed.frames import DEFAULT, EMPTY, FAST, WARM_UP, WITHOUT, Stage, measure_moving, measure_rest
from tests.bench.speed.memory import measure_memory
from tests.bench.truth.rooms import CAMERA


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
    assert 0 <= rows["moving camera: blocking reads, median"] < 40  # what is there already does not block
    assert 0 < rows["moving camera: host's own time, median"] < rows[f"moving camera, {DEFAULT}: frame, 95 % of them"]
    assert abs(rows["moving camera: share of the frame that no row tells"]) < 0.1
    assert rows["moving camera: frame without caches / with, median"] > 0
    assert len(said) == 2
    flips = [value for name, value in rows.items() if "FLIP" in name]
    assert all(0 <= value < 0.02 for value in flips)


def test_a_camera_at_rest_is_timed_once_nothing_is_computed_again(device: Device, tmp_path: Path) -> None:
    part = measure_rest(device, small_stage(tmp_path), 0, 110, lambda _text: None)
    rows = {row.name: row.value for row in part.rows}
    assert np.isfinite(rows["camera at rest: frame, median"])
    assert 8 < rows["camera at rest: frames until nothing is computed again"] < 90
    settling = measure_rest(device, small_stage(tmp_path), 0, 6, lambda _text: None)
    assert not settling.rows
    assert "did not settle within 6 frames" in settling.unmeasured[0].reason


def test_devices_are_measured_side_by_side(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stage, frames = small_stage(tmp_path), range(WARM_UP + 3)
    monkeypatch.setattr(devices, "other_devices", lambda _device: [])
    (alone,) = devices.measure_devices(device, stage, frames, lambda _text: None).unmeasured
    assert "one usable OpenCL device" in alone.reason
    again = open_device(device.name)
    again.name = "another"
    monkeypatch.setattr(devices, "other_devices", lambda _device: [again])
    monkeypatch.setattr(devices, "LEAST_MS", 0.0)
    monkeypatch.setattr(devices, "MUCH", 1.0)
    part = devices.measure_devices(device, stage, frames, lambda _text: None)
    rows = {row.name: row.value for row in part.rows}
    for name in (device.name, "another"):
        assert rows[f"{name}: kernels, sum of medians"] > 0
        assert 0 < rows[f"{name}: host's own time, median"] < rows[f"{name}: frame, median"]
    assert 0.1 < rows[f"raycast: {device.name} over another"] < 10


def test_what_is_kept_is_counted_and_does_not_grow(device: Device, tmp_path: Path) -> None:
    small = msgspec.structs.replace(CAMERA, width=80, height=60, fx=66.0, fy=66.0, cx=39.5, cy=29.5)
    small_stage(tmp_path)
    said: list[str] = []
    part = measure_memory(device, tmp_path / "ball.glb", 15, said.append, small, voxel_m=0.05)
    rows = {row.name.removeprefix("room of 6x3x6 m: "): row.value for row in part.rows}
    samples = 80 * 60 / 16
    entries = 4 * samples * 232 / 1e6  # of transfer alone, before the table is rounded up
    assert entries < rows["what is kept at places of the world, at the end"] < 6 * entries
    assert rows["growth of it, after a fifth of the walk"] == 0
    assert rows["all on the device, at the end"] > rows["what is kept at places of the world, at the end"]
    assert said == ["memory: frame 0 of 15"]
