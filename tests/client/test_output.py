"""What is written, file by file, against the names and forms that the command line promises."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from client.errors import OutputError
from client.results.frame_output import FrameOutput
from client.results.output_folder import OutputWriter
from protocol.messages import LeftOut, Light, Plan, Timings
from tests.client.lights import light_of
from tests.client.results_page import DESCRIPTION, light_at_object
from tests.protocol.samples import SERVER

LIGHT_FIELDS = [
    *"frame timestamp_s sh sh_std sh_webxr dominant_direction dominant_intensity dominant_lights".split(),  # noqa: SIM905
    *"lamps exposure condition valid spread_deg position at".split(),  # noqa: SIM905
]
AT_FIELDS = [
    *"of index position sh sh_std sh_webxr dominant_direction dominant_intensity spread_deg".split(),  # noqa: SIM905
    *"valid seen".split(),  # noqa: SIM905
]
ROWS = [
    *"input reconstruct surface dynamic_geometry radiance_transfer light_estimation rendering total".split(),  # noqa: SIM905
    *"host launches reads read_bytes copies".split(),  # noqa: SIM905
]


def output_of(frame: int, notes: tuple[str, ...] = (), light: Light | None = None) -> FrameOutput:
    random = np.random.default_rng(frame)
    pose = np.eye(4)
    pose[:3, 3] = (0.1 * frame, -1e-12, 2.0)
    return FrameOutput(
        frame=frame,
        timestamp_s=frame / 30,
        color=random.integers(0, 256, (24, 32, 3), np.uint8),
        light=light or light_of(frame),
        world_from_camera=pose,
        tracking="given",
        timings=Timings(input=1.5, total=12.25),
        plan=Plan(run=("composite",), left_out=(LeftOut(effect="shadow", reason="no object", error_bound=None),)),
        notes=notes,
    )


def write(folder: Path, *outputs: FrameOutput, overwrite: bool = False) -> Path:
    with OutputWriter(folder, overwrite=overwrite) as writer:
        for output in outputs:
            writer.write(output)
    return folder


def lines(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_pictures_are_named_by_position_and_exact(tmp_path: Path) -> None:
    write(tmp_path, output_of(7), output_of(123))
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == ["000007.png", "000123.png"]
    stored = cv2.imread(str(tmp_path / "frames" / "000123.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(stored[..., ::-1], output_of(123).color)


def test_light_lines(tmp_path: Path) -> None:
    more = tuple((0.5, 0.25, 0.125) for _ in range(25))
    write(tmp_path, output_of(0), output_of(1, light=light_of(1, sh_all=more, condition=7.5, valid=True)))
    first, second = lines(tmp_path / "light.jsonl")
    assert list(first) == LIGHT_FIELDS
    assert list(second) == [*LIGHT_FIELDS[:3], "sh_all", *LIGHT_FIELDS[3:]]
    assert first["frame"] == 0
    assert first["sh"][3] == [0.1 * 3, 1 / 3, 0.0]
    assert first["sh_std"][0] == [0.01, None, 0.5]
    assert len(first["sh_webxr"]) == 27
    assert (first["condition"], first["valid"]) == (None, False)
    assert (second["condition"], second["valid"]) == (7.5, True)
    assert second["sh_all"] == [[0.5, 0.25, 0.125]] * 25


def test_light_at_places(tmp_path: Path) -> None:
    """The fields that the command line promises, in their order; objects by number, not by name."""
    told = SERVER["light_at_places"]
    assert isinstance(told, Light)
    write(tmp_path, output_of(10, light=told))
    (row,) = lines(tmp_path / "light.jsonl")
    assert (row["position"], row["spread_deg"]) == ([0.25, 0.5, 1.75], 12.5)
    view, thing = row["at"]
    assert list(view) == list(thing) == AT_FIELDS
    assert (view["of"], view["index"], view["spread_deg"], view["valid"]) == ("view", 0, 8.25, True)
    assert (thing["of"], thing["index"], thing["spread_deg"], thing["valid"]) == ("object", 0, None, False)
    assert view["sh"] == [list(one) for one in told.at[0].sh]
    assert thing["sh_std"] == [[None] * 3] * 16
    assert [len(view["sh_webxr"]), len(view["position"]), len(view["dominant_direction"])] == [27, 3, 3]


def test_lights_at_objects_are_in_the_order_of_the_command_line(tmp_path: Path) -> None:
    """Also where the first one was placed last; what another client calls its object keeps its number."""
    at = light_at_object(0).at[0]
    names = (("object-2", 2.0), ("lamp", 1.0), ("object-0", 0.0))  # and where they stand
    lights = tuple(
        msgspec.structs.replace(at, index=i, object=name, position=(x, 0.0, 1.0)) for i, (name, x) in enumerate(names)
    )
    view = msgspec.structs.replace(at, of="view")
    with OutputWriter(tmp_path / "out", DESCRIPTION) as writer:
        writer.write(output_of(0, light=light_of(0, at=(view, *lights))))
        writer.write_light(light_of(1, at=(view, *lights)))
    for line in (tmp_path / "out" / "light.jsonl").read_text().splitlines():
        assert [(lit["of"], lit["index"], lit["position"][0]) for lit in json.loads(line)["at"]] == [
            ("view", 0, 0.1),
            ("object", 0, 0.0),
            ("object", 1, 1.0),
            ("object", 2, 2.0),
        ]


def test_trajectory_lines(tmp_path: Path) -> None:
    write(tmp_path, output_of(0), output_of(3))
    text = (tmp_path / "trajectory.txt").read_text().splitlines()
    assert text[1] == "0.100000 0.300000000 0.000000000 2.000000000 0.000000000 0.000000000 0.000000000 1.000000000"
    assert len(text) == 2


def test_timing_lines(tmp_path: Path) -> None:
    write(tmp_path, output_of(0), output_of(1, notes=("depth is empty",)))
    first, second = lines(tmp_path / "timings.jsonl")
    assert list(first) == ["frame", *ROWS, "tracking", "plan"]
    assert (first["input"], first["total"], first["tracking"]) == (1.5, 12.25, "given")
    assert first["plan"]["run"] == ["composite"]
    assert first["plan"]["left_out"] == [{"effect": "shadow", "reason": "no object", "error_bound": None}]
    assert second["notes"] == ["depth is empty"]


def test_equal_inputs_give_equal_bytes(tmp_path: Path) -> None:
    for name in "ab":
        write(tmp_path / name, output_of(0), output_of(1, notes=("x",)))
    for path in sorted(p for p in (tmp_path / "a").rglob("*") if p.is_file()):
        assert path.read_bytes() == (tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes()


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_not_finite_is_never_written(value: float, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="frame 4"):
        write(tmp_path, output_of(4, light=light_of(4, dominant_intensity=value)))
    assert "NaN" not in (tmp_path / "light.jsonl").read_text()
    assert "Infinity" not in (tmp_path / "light.jsonl").read_text()


def test_an_earlier_run_is_replaced_but_other_files_stay(tmp_path: Path) -> None:
    write(tmp_path, output_of(0), output_of(1))
    (tmp_path / "frames" / "mine.png").write_text("keep")
    write(tmp_path, output_of(0), overwrite=True)
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == ["000000.png", "mine.png"]
    assert len(lines(tmp_path / "light.jsonl")) == 1


def test_an_earlier_run_is_kept_unless_it_may_be_overwritten(tmp_path: Path) -> None:
    write(tmp_path, output_of(0), output_of(1))
    with pytest.raises(OutputError, match=r"holds an earlier run; name another folder .* --overwrite") as caught:
        OutputWriter(tmp_path)
    assert "\n" not in str(caught.value)
    assert len(list((tmp_path / "frames").iterdir())) == len(lines(tmp_path / "light.jsonl")) == 2


def test_a_run_that_ended_before_its_first_frame_is_none(tmp_path: Path) -> None:
    write(tmp_path)
    write(tmp_path, output_of(0))
    assert len(lines(tmp_path / "light.jsonl")) == 1


def test_pictures_of_somebody_else_stay(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "000009.png").write_text("not ours: there is no light.jsonl")
    write(tmp_path, output_of(0))
    assert (tmp_path / "frames" / "000009.png").exists()


def test_folder_that_cannot_be(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written") as caught:
        OutputWriter(tmp_path / "file" / "out")
    assert "\n" not in str(caught.value)


def test_lines_are_whole_while_it_runs(tmp_path: Path) -> None:
    writer = OutputWriter(tmp_path)
    writer.write(output_of(0))
    assert len(lines(tmp_path / "light.jsonl")) == len(lines(tmp_path / "timings.jsonl")) == 1
    writer.close()
