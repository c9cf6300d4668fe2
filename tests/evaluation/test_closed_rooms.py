"""The figures of closed rooms, for lights whose errors are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from msgspec import structs

from protocol.messages import ArrivingLight
from server.maths.sh import rotate_sh
from server.opencl.device import Device
from server.pipeline import FrameResult
from tests.bench.light import closed_rooms
from tests.bench.light.closed_rooms import Arrived, arrived_in, closed_rooms_part, compare, level_and_chroma
from tests.bench.report.run import Run
from tests.data import data_folder
from tests.scenes.analytic import Floats


def light(strength: float = 1.0, tint: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Floats:
    """Sky and a light along x."""
    sh = np.zeros((16, 3))
    sh[0], sh[3] = 3.0, 1.0
    return np.asarray(strength * sh * tint)


def told(sh: Floats, spread_deg: float | None = 10.0, valid: bool = True) -> ArrivingLight:
    return ArrivingLight(
        of="place",
        index=0,
        position=(0.0, 0.0, 0.0),
        sh=tuple(tuple(map(float, row)) for row in sh),  # type: ignore[misc]
        sh_std=((None, None, None),) * 16,
        sh_webxr=(0.0,) * 27,
        dominant_direction=(1.0, 0.0, 0.0),
        dominant_intensity=1.0,
        spread_deg=spread_deg,
        valid=valid,
    )


def about_z(degrees: float) -> Floats:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def one(found: Floats, true: Floats, **more: object) -> Arrived:
    return compare([(told(found, **more),)], true[None])  # type: ignore[arg-type]


def test_a_turned_light_is_off_by_its_turn() -> None:
    arrived = one(rotate_sh(light(), about_z(25.0)), light())
    assert arrived.angles_deg[0, 0] == pytest.approx(25.0, abs=1e-6)
    assert arrived.irradiance[0, 0] > 0.05
    assert arrived.level[0, 0] == pytest.approx(1.0, abs=1e-3)


def test_a_brighter_light_is_off_in_its_level_alone() -> None:
    arrived = one(light(1.5), light())
    assert arrived.irradiance[0, 0] == pytest.approx(0.0, abs=1e-9)
    assert arrived.angles_deg[0, 0] == pytest.approx(0.0, abs=1e-3)
    assert arrived.level[0, 0] == pytest.approx(1.5)
    assert arrived.chroma[0, 0] == pytest.approx(0.0, abs=1e-9)


def test_a_tint_is_off_in_its_chroma() -> None:
    level, chroma = level_and_chroma(light(tint=(1.2, 1.0, 0.8)), light())
    assert level == pytest.approx(1.0)
    assert chroma == pytest.approx(0.2)


def test_a_light_without_spread_may_point_anywhere() -> None:
    arrived = one(light(), light(), spread_deg=None, valid=False)
    assert arrived.spreads_deg[0, 0] == 180.0
    assert not arrived.is_valid.any()


def test_the_last_frames_are_judged() -> None:
    frames = [(told(rotate_sh(light(), about_z(90.0))),)] * 4 + [(told(light()),)] * 15
    assert compare(frames, light()[None]).last().angles_deg.max() < 1e-3


def test_coefficients_inside_their_intervals_are_counted() -> None:
    """After one scale; what is not known may be anything."""
    found, true = light(), 2.0 * light()
    true[5, 1] += 1.0
    of_some = compare([(structs.replace(told(found), sh_std=((0.1, 0.1, None),) * 16),)], true[None])
    assert one(found, true).inside[0, 0] == 1.0
    assert 1 - 2 / 48 <= of_some.inside[0, 0] < 1.0


def test_rooms_without_objects_and_noise_are_measured_too(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As `python -m tests.bench.rooms` makes them."""
    (tmp_path / "made").mkdir()
    (tmp_path / "made/probes.json").write_text("{}")
    found = compare([(told(rotate_sh(light(), about_z(5.0))),) * 5] * 20, np.array([light()] * 5))
    asked: list[Path] = []

    def arrived(_run: Run, source: Path, _room: Path) -> tuple[Arrived, list[FrameResult]]:
        asked.append(source)
        return found, []

    monkeypatch.setattr(closed_rooms, "data_folder", lambda _name: tmp_path)
    monkeypatch.setattr(closed_rooms, "arrived_in", arrived)
    part = closed_rooms_part(Run(device, quick=True, say=print))
    assert asked == [tmp_path / "made"]
    rows = [row.name for row in part.rows]
    assert "room made: table and floor: dominant direction" in rows
    assert not any("FLIP" in name or "noisy" in name for name in rows)


def test_light_in_a_closed_room(device: Device) -> None:
    """A ceiling lamp that no picture shows. Figures of whole runs are in docs/benchmarks/light.md."""
    folder = data_folder("rooms") / "r1_ceiling"
    arrived = arrived_in(Run(device, quick=True, say=print), folder, folder, frames=10, with_objects=False)[0]
    last = arrived.angles_deg[-5:]
    assert np.median(last) <= 10  # seen: 3
    assert last.max() <= 25  # seen: 9
    assert np.median(arrived.irradiance[-5:]) <= 0.25  # seen: .14
    assert abs(np.median(arrived.level[-5:]) - 1) <= 0.35  # seen: .2
    assert (last <= arrived.spreads_deg[-5:]).mean() >= 0.9  # seen: 1
    assert arrived.inside[-5:].mean() >= 0.85  # of the 95 % intervals; without LEAST_SPREAD_DEG in them .6
