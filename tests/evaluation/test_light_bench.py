"""The benchmark of light: what its rows are made of, which goals they carry, and what its pictures show."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from client.synthetic.source import open_synthetic
from protocol.frames import RgbdFrame
from protocol.messages import Wishes
from server.maths.sh import lambert_transfer, sh_basis, spherical_fibonacci
from server.opencl.engine import Engine
from tests.bench.light import parts as light_parts
from tests.bench.light import speed as light_speed
from tests.bench.light import suite as light
from tests.bench.light.e1 import SEQUENCES, overall_part
from tests.bench.light.honesty import random_light
from tests.bench.light.pictures import FOUND_COLOR, HEIGHT_PX, TRUE_COLOR, draw_rooms, environment_picture, panels
from tests.bench.light.runs import Exposed, at_preset, refusal, wishes_for
from tests.bench.light.speed import WARM_UP, errors_beside, timed
from tests.bench.report.finished import Part
from tests.bench.report.page import figures, write_page
from tests.bench.report.run import Run
from tests.scenes.lights import lobe, lobe_and_sky

UP, VIEW = np.array([0.0, 1, 0]), np.array([0.0, 0, -1])


def e1_details(**dots: list[float]) -> dict[str, dict[str, Any]]:
    """All sequences alike; environment maps as wrong as the dots say."""
    one = {preset: {"dots": values, "differences": [1 - d for d in values]} for preset, values in dots.items()}
    return {sequence.name: one for sequence in SEQUENCES}


def values(part: Part) -> dict[str, tuple[float, str, bool | None]]:
    return {row.name: (row.value, row.goal, row.holds) for row in part.rows}


def test_presets_are_held_against_rm() -> None:
    rows = values(overall_part(e1_details(rm=[1.0, 0.998], reg4=[0.9971, 0.9951])))
    mean = "dot product of dominant directions, mean"
    assert rows[f"E1, all sequences: RM: {mean}"] == (pytest.approx(0.999), ">= 0.999", True)
    assert rows[f"E1, all sequences: REG4: {mean}"][1] == ""
    assert rows["E1, all sequences: REG4: below RM by"] == (pytest.approx(0.0029), "<= 0.003", True)
    assert rows["E1, all sequences: REG4: environment map, relative MSAD, median"][0] == pytest.approx(0.0039)
    worse = values(overall_part(e1_details(rm=[1.0, 0.998], reg4=[0.996, 0.995])))
    assert worse["E1, all sequences: REG4: below RM by"][2] is False
    angles = values(errors_beside(e1_details(rm=[1.0, np.cos(np.radians(4))])))
    assert angles["light error beside the time of RM: E1, mean angle"][0] == pytest.approx(2)


def test_a_preset_that_lacks_a_sequence_has_no_mean() -> None:
    details = e1_details(rm=[1.0], reg4=[1.0])
    details[SEQUENCES[0].name] = {"rm": details[SEQUENCES[0].name]["rm"]}
    part = overall_part(details)
    assert not [name for name in values(part) if "REG4" in name]
    assert ("E1: REG4", "not on all sequences") in {(item.name, item.reason) for item in part.unmeasured}
    assert not overall_part({}).rows


def test_a_part_that_nobody_has_written_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(light_parts.ELSEWHERE, "nothing", ("tests.bench.no_such_module", "nothing_part"))
    part = light_parts.elsewhere("nothing", Run(None, True, lambda _text: None))  # type: ignore[arg-type]
    assert not part.rows
    assert part.unmeasured[0].name == "nothing"
    assert "no_such_module" in part.unmeasured[0].reason


def test_the_suite_has_all_parts_and_goes_on_without_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts replaced by small ones: rows, pictures' details and the summary come together in one result."""

    def part(name: str) -> Callable[[Run], Part]:
        def measure(_run: Run) -> Part:
            made = Part(sizes={name: 1})
            made.add(name, 1.0, "", "<= 2")
            sequence = e1_details(rm=[1.0]).get(name, {})
            lights = {"true": lobe((0, 1, 1)).tolist(), "light": lobe((0, 1, 1)).tolist()}
            made.details = {preset: {**found, **lights} for preset, found in sequence.items()}
            return made

        return measure

    names = list(light_parts.PARTS)
    assert {"mitsuba_room", "half black room", "honesty", "kitchen", "speed", "lamp", "visibility"} <= set(names)
    monkeypatch.setattr(light, "PARTS", {name: part(name) for name in names})
    monkeypatch.setattr(light, "OUT", tmp_path)
    result = light.run_suite(True, lambda _text: None)
    assert {row["name"] for row in result["rows"]} > set(names)
    assert [row["holds"] for row in result["rows"] if row["name"] in names] == [True] * len(names)
    assert any(row["name"].startswith("E1, all sequences: RM") for row in result["rows"])
    assert (tmp_path / "result.json").is_file()
    assert (tmp_path / "e1.png").is_file()


def test_what_the_server_cannot_do_is_refused_in_words() -> None:
    assert refusal(Wishes(preset="rm")) == ""
    assert "no_such" in refusal(at_preset(Wishes(), "no_such"))


def test_wishes_are_those_of_run() -> None:
    source = open_synthetic("synthetic:table?size=64x48&frames=4")
    wishes = wishes_for(source, range(4))
    assert wishes.up == (0, 1, 0)
    assert wishes.volume_m is not None
    assert wishes.preset == "rm"


def test_a_shorter_exposure_halves_the_picture() -> None:
    frame = RgbdFrame(0, 0.0, np.full((8, 8, 3), 40000, np.uint16), np.zeros((8, 8), np.uint16), None)
    exposed = Exposed([frame], 0.5)  # type: ignore[arg-type]
    assert exposed[0].color.dtype == np.uint16
    assert (exposed[0].color == 20000).all()
    assert len(exposed) == 1


def test_random_lights_are_lights() -> None:
    generator = np.random.default_rng(5)
    directions = spherical_fibonacci(3000)
    lights = [random_light(generator) for _ in range(20)]
    for sh in lights:
        irradiance = lambert_transfer(directions, 4) @ sh
        assert irradiance.max() == pytest.approx(1, rel=0.01)
        assert irradiance.min() > 0
        assert (sh_basis(directions, 4) @ sh).min() > -0.3 * (sh_basis(directions, 4) @ sh).max()
    assert np.std([sh[1, 0] / sh[0, 0] for sh in lights]) > 0.1


def test_times_are_of_the_work_alone(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    """By clocks that only the work moves on, ten times as far while it warms up."""
    clock = {"wall": 0.0, "cpu": 0.0}
    calls: list[int] = []

    def work() -> None:
        calls.append(1)
        slow = 1 if len(calls) > WARM_UP else 10
        clock["wall"] += 0.02 * slow
        clock["cpu"] += 0.005 * slow

    clocks = SimpleNamespace(perf_counter=lambda: clock["wall"], process_time=lambda: clock["cpu"])
    monkeypatch.setattr(light_speed, "time", clocks)
    wall_ms, cpu_ms = timed(engine, work, 3)
    assert len(calls) == WARM_UP + 3
    assert wall_ms == pytest.approx([20.0] * 3)
    assert cpu_ms == pytest.approx([5.0] * 3)


def test_the_brightest_place_of_the_map_is_towards_the_light() -> None:
    picture = environment_picture(lobe((1, 0, 0)), UP, VIEW, 1.0)
    assert picture.shape == (HEIGHT_PX, 2 * HEIGHT_PX, 3)
    row, column = np.unravel_index(cv2.GaussianBlur(picture[..., 1], (0, 0), 3).argmax(), picture.shape[:2])
    assert abs(row - HEIGHT_PX / 2) < 8  # level
    assert abs(column - 1.5 * HEIGHT_PX) < 8  # to the right of the view


def test_both_directions_are_marked() -> None:
    true, found = lobe_and_sky((0, 0, -1)), lobe_and_sky((1, 0, 0))
    cells = dict(panels({"RM": 3 * found}, true, UP, VIEW))
    assert list(cells) == ["true", "RM"]
    middle = cells["true"][HEIGHT_PX // 2 - 12 : HEIGHT_PX // 2 + 12, HEIGHT_PX - 12 : HEIGHT_PX + 12]
    assert (middle == TRUE_COLOR).all(axis=-1).any()
    right = cells["RM"][HEIGHT_PX // 2 - 12 : HEIGHT_PX // 2 + 12, 3 * HEIGHT_PX // 2 - 12 : 3 * HEIGHT_PX // 2 + 12]
    assert (right == FOUND_COLOR).all(axis=-1).any()
    assert not (right == TRUE_COLOR).all(axis=-1).any()


def test_a_picture_for_each_set(tmp_path: Path) -> None:
    true = lobe_and_sky((0, 1, 0)).tolist()
    draw_rooms(tmp_path, {"a": {"true": true, "rm": true}, "b": {"true": true}}, ("rm", "reg4"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "b.png"]


def test_figures_go_between_the_marks(tmp_path: Path) -> None:
    result = {
        "commit": "abc",
        "date": "2026-11-22",
        "device": "device",
        "sizes": {"frames": 3},
        "rows": [
            {"name": "held", "value": 1.0, "unit": "deg", "goal": "<= 2", "holds": True},
            {"name": "beside", "value": 2.0, "unit": "", "goal": None, "holds": None},
        ],
        "unmeasured": [{"name": "x", "reason": "no GPU"}],
    }
    text = figures(result)
    assert text.startswith("Commit abc, measured 2026-11-22 on device. frames: 3.")
    assert "| held | 1 | deg | <= 2 | yes |" in text
    assert "| beside | 2 |  |" in text
    assert "- x: no GPU" in text
    page, json_file = tmp_path / "light.md", tmp_path / "result.json"
    page.write_text("before\n<!-- figures -->\nold\n<!-- end of figures -->\nafter\n")
    json_file.write_text(json.dumps(result))
    write_page(page, json_file)
    assert page.read_text() == f"before\n<!-- figures -->\n{text}<!-- end of figures -->\nafter\n"
    assert (tmp_path / "light.json").is_file()
