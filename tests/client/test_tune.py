"""`probeless tune`: a front is measured, kept, shown, and used by `run --budget-ms`."""

from __future__ import annotations

from pathlib import Path

import pytest
from msgspec import structs

from client.cli import run_command
from client.synthetic.source import open_synthetic
from client.tuning import devices as tune_devices
from client.tuning import scenes as tune_scenes
from client.tuning import tune as tuning
from client.tuning.scenes import Stage
from client.tuning.tune import lines_of, tune
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.opencl.device import Device, open_device
from server.quality.pareto_front import read_front, write_front
from server.quality.sampling_settings import SamplingSettings

FEW = (SamplingSettings(preset="reg8", rays=9), SamplingSettings(preset="reg4", rays=49))
TABLE = "synthetic:table?size=96x72&frames=4"


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Small scenes, and a folder of its own for fronts."""
    monkeypatch.setattr(tune_scenes, "SIZE", "160x120")
    monkeypatch.setattr(tune_scenes, "LIT_SIZE", "160x120")
    for module in (tuning, tune_scenes):
        monkeypatch.setattr(module, "FRAMES", 3)
        monkeypatch.setattr(module, "SETTLING", 1)
        monkeypatch.setattr(module, "LIT_FRAMES", 4)
    monkeypatch.setattr(tune_scenes, "LIT_SETTLING", 1)
    monkeypatch.setattr(tuning, "POINTS", FEW)
    monkeypatch.setenv("PROBELESS_FRONTS", str(tmp_path / "fronts"))


def test_points_are_measured_and_kept(device: Device) -> None:
    told: list[tuple[int, int]] = []
    front = tune(device, lambda done, total: told.append((done, total)), FEW)
    assert [p.point for p in front.points] == list(FEW)
    for point in front.points:
        assert 0 < point.total_ms < 60_000
        assert 0 <= point.light_error_deg <= 180
        assert 0 < point.picture_error < 255
    assert front.points[0].light_error_deg > front.points[1].light_error_deg  # 9 rays err more than 49
    assert told[-1] == (18, 18)
    assert [done for done, _ in told] == sorted(done for done, _ in told)
    write_front(front)
    assert read_front(device.name) == front
    lines = list(lines_of(front))
    assert all(any(line.endswith(point.settings) for line in lines) for point in FEW)


def test_a_budget_begins_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str], device: Device) -> None:
    """Before the device is measured and after; every frame says its point."""
    for is_measured in (False, True):
        if is_measured:
            write_front(structs.replace(read_front(device.name), device=device.name))
        out = tmp_path / f"out{is_measured}"
        assert run_command(["run", TABLE, "--out", str(out), "--budget-ms", "60000"]) == 0
        assert ("was not measured" in capsys.readouterr().err) is not is_measured
        rows = (out / "timings.jsonl").read_text().splitlines()
        assert len(rows) == 4
        unknown = "what the scene costs" if is_measured else "what frames cost on this device"
        best = read_front(device.name).best()[-1].point.settings
        for row in rows:
            assert f'"reason": "the first frames of a budget of 60000 ms: {unknown} is not known"' in row
            assert f'"settings": "{best}"' in row


def test_a_server_begins_at_once_too(device: Device) -> None:
    source = open_synthetic(TABLE)
    session = ClientSession(device, source.camera, Wishes(preset="auto", budget_ms=50.0))
    point = session.process(source[0]).plan.point
    session.close()
    assert point is not None
    assert point.reason.endswith("what frames cost on this device is not known")


def test_the_fastest_device_is_told(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    other = open_device(device.name)
    other.name = "Vendor / other"
    times = {device.name: 40.0, other.name: 30.0}
    monkeypatch.setattr(tune_devices, "frame_ms", lambda one, _stage: times[one.name])
    monkeypatch.setattr(tune_devices, "other_devices", lambda _device: [])
    assert not list(tune_devices.comparison(device, lambda _: None))
    monkeypatch.setattr(tune_devices, "other_devices", lambda _device: [other])
    said: list[str] = []
    _, fastest, slowest, advice = tune_devices.comparison(device, said.append)
    assert "comparing 2 devices" in said[0]
    assert fastest.split() == ["30.0", "ms", "Vendor", "/", "other"]
    assert device.name in slowest
    assert '--device "Vendor / other"' in advice
    times[device.name] = 20.0
    assert len(list(tune_devices.comparison(device, said.append))) == 3


def test_a_frame_of_the_usual_settings_is_timed(device: Device) -> None:
    assert 0 < tune_devices.frame_ms(device, Stage()) < 60_000
    assert device.name not in {other.name for other in tune_devices.other_devices(device)}
