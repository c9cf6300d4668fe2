"""Options shared by run and stream: what they become, and what is refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest
from msgspec import structs

from client.commands import demo
from client.errors import OptionError, SourceError
from client.options.capture import CaptureOptions, parse_frames, parse_ray_length, prepare
from client.sources.volume import default_volume, default_voxel, enlarged_volume
from protocol.messages import Wishes
from tests.client import folders


@pytest.fixture
def source(tmp_path: Path) -> str:
    return str(folders.ground_truth(tmp_path / "set", count=8))


def test_defaults_fit_the_source(source: str) -> None:
    capture = prepare(CaptureOptions(source))
    wishes = capture.wishes
    assert capture.frames == range(8)
    assert capture.objects == ()
    assert wishes.volume_m == default_volume(capture.source, range(8))
    assert wishes.voxel_m == default_voxel(wishes.volume_m)
    assert wishes.up == (0.0, -1.0, 0.0)  # what the source says
    assert (wishes.preset, wishes.rays, wishes.bands, wishes.ray_length_m) == ("reg4", 81, 4, None)
    assert (wishes.albedo, wishes.indirect, wishes.poses) == ("estimated", "observed", "given")
    assert (wishes.lamps, wishes.exposure) == ("auto", "auto")
    assert wishes.robustness == ("openness", "memory", "outliers")
    assert wishes.edges == "smooth"
    assert wishes.tone_mapping == "auto"
    assert not wishes.as_thesis
    assert not wishes.lossless


def test_the_command_line_and_the_demo_have_the_defaults_of_the_wire(source: str) -> None:
    """Except where the source knows better."""
    with demo._prepared(2) as shown:
        for wishes in (prepare(CaptureOptions(source)).wishes, shown.wishes):
            of_source = {name: getattr(wishes, name) for name in ("poses", "volume_m", "voxel_m", "up")}
            assert wishes == structs.replace(Wishes(), **of_source)


def test_everything_said(source: str) -> None:
    options = CaptureOptions(
        source,
        frames="2:6",
        poses="given",
        volume="0,0,0,1,2,3",
        voxel=0.02,
        preset="rm",
        rays=169,
        ray_length="0.5",
        bands=3,
        albedo="constant",
        indirect="none",
        lamps="on",
        robustness="normals, memory",
        edges="hard",
        tone_mapping="average",
        exposure="constant",
        up="0,0,1",
        object=[f"{source}/meta.json@1,2,3", f"{source}/meta.json"],
    )
    capture = prepare(options, lossless=True)
    wishes = capture.wishes
    assert capture.frames == range(2, 6)
    assert [item.position_m for item in capture.objects] == [(1.0, 2.0, 3.0), None]
    assert wishes.volume_m == (0.0, 0.0, 0.0, 1.0, 2.0, 3.0)
    assert (wishes.voxel_m, wishes.preset, wishes.rays, wishes.ray_length_m, wishes.bands) == (0.02, "rm", 169, 0.5, 3)
    assert (wishes.albedo, wishes.indirect) == ("constant", "none")
    assert wishes.up == (0.0, 0.0, 1.0)
    assert (wishes.lamps, wishes.exposure) == ("on", "constant")
    assert wishes.robustness == ("normals", "memory")
    assert wishes.edges == "hard"
    assert wishes.tone_mapping == "average"
    assert wishes.lossless


def test_an_object_on_a_pixel_of_a_frame_that_is_not_processed(source: str) -> None:
    asked = f"{source}/meta.json@pixel:3,4:"
    assert prepare(CaptureOptions(source, frames="1:5", object=[asked + "4"])).objects[0].spot is not None
    with pytest.raises(OptionError, match="frame 5 of its pixel is none of 1:5"):
        prepare(CaptureOptions(source, frames="1:5", object=[asked + "5"]))


def test_run_and_stream_choose_the_same_volume(source: str) -> None:
    options = CaptureOptions(source, frames="1:5")
    assert prepare(options).wishes.volume_m == prepare(options, lossless=True).wishes.volume_m


def test_as_thesis(source: str) -> None:
    wishes = prepare(CaptureOptions(source, as_thesis=True)).wishes
    assert (wishes.ray_length_m, wishes.albedo, wishes.indirect, wishes.as_thesis) == (0.1, "constant", "none", True)
    same = prepare(CaptureOptions(source, as_thesis=True, albedo="constant", indirect="none")).wishes
    assert same == wishes


@pytest.mark.parametrize("said", [{"ray_length": "1"}, {"albedo": "estimated"}, {"indirect": "observed"}], ids=str)
def test_as_thesis_is_not_said_with_what_it_is_not(said: dict, source: str) -> None:
    with pytest.raises(OptionError, match="leave one of the two out") as caught:
        prepare(CaptureOptions(source, as_thesis=True, **said))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "expected"),
    [(None, range(10)), ("0:10", range(10)), ("3:7", range(3, 7)), (":4", range(4)), ("8:", range(8, 10))],
)
def test_frames(text: str | None, expected: range) -> None:
    assert parse_frames(text, 10) == expected


@pytest.mark.parametrize("text", ["", "5", "a:b", "5:5", "6:3", "0:11", "-1:4", "1:2:3", "1.5:3"])
def test_frames_that_are_none(text: str) -> None:
    with pytest.raises(OptionError, match="--frames"):
        parse_frames(text, 10)


@pytest.mark.parametrize(("text", "expected"), [(None, None), ("room", None), ("0.1", 0.1), ("1e3", 1000.0)])
def test_ray_length(text: str | None, expected: float | None) -> None:
    assert parse_ray_length(text) == expected


REFUSED = [
    ({"volume": "0,0,0,1,1"}, "--volume"),
    ({"volume": "0,0,0,1,1,nan"}, "--volume"),
    ({"volume": "0,0,0,1,-1,1"}, "--volume"),
    ({"voxel": 0.0}, "--voxel"),
    ({"voxel": 2.0}, "--voxel"),
    ({"up": "0,0,0"}, "--up"),
    ({"up": "0,1"}, "--up"),
    ({"ray_length": "0"}, "--ray-length"),
    ({"ray_length": "far"}, "--ray-length"),
    ({"ray_length": "nan"}, "--ray-length"),
    ({"preset": "best"}, "--preset"),
    ({"albedo": "white"}, "--albedo"),
    ({"indirect": "all"}, "--indirect"),
    ({"poses": "guess"}, "--poses"),
    ({"lamps": "bright"}, "--lamps"),
    ({"robustness": "normal"}, "--robustness"),
    ({"edges": "sharp"}, "--edges"),
    ({"tone_mapping": "filmic"}, "--tone-mapping"),
    ({"robustness": "none,memory"}, "--robustness"),
    ({"robustness": "normals_printed"}, "--robustness"),
    ({"as_thesis": True, "robustness": "normals"}, "--as-thesis"),
    ({"exposure": "given"}, "--exposure"),
    ({"upsampling": "nearest"}, "--upsampling"),
    ({"interleave": 3}, "--interleave"),
    ({"budget_ms": 0.0}, "--budget-ms"),
    ({"max_light_error": 200.0}, "--max-light-error"),
    ({"budget_ms": 40.0, "preset": "rm"}, "--preset is what"),
    ({"budget_ms": 40.0, "rays": 81}, "--rays is what"),
    ({"preset": "auto", "stride": 2}, "--stride is what"),
]


@pytest.mark.parametrize(("said", "words"), REFUSED)
def test_values_that_cannot_be(said: dict, words: str, source: str) -> None:
    with pytest.raises(OptionError, match=words) as caught:
        prepare(CaptureOptions(source, **said))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("said", "chosen_by"),
    [
        ({"preset": "auto"}, (None, None)),
        ({"budget_ms": 40.0}, (40.0, None)),
        ({"max_light_error": 3.0}, (None, 3.0)),
        ({"preset": "auto", "budget_ms": 40.0, "max_light_error": 3.0}, (40.0, 3.0)),
    ],
    ids=str,
)
def test_a_budget_leaves_the_preset_to_the_server(
    said: dict, chosen_by: tuple[float | None, float | None], source: str
) -> None:
    wishes = prepare(CaptureOptions(source, **said)).wishes
    assert (wishes.preset, wishes.budget_ms, wishes.max_light_error_deg) == ("auto", *chosen_by)


def test_how_transfer_is_sampled_is_wished_only_where_it_was_said(source: str) -> None:
    usual = prepare(CaptureOptions(source)).wishes
    assert (usual.stride, usual.interleave, usual.upsampling) == (None, None, None)
    said = {"stride": 2, "interleave": 4, "upsampling": "bicubic", "visibility_state": True, "smooth_depth": False}
    wishes = prepare(CaptureOptions(source, preset="rm", **said)).wishes
    assert {name: getattr(wishes, name) for name in said} == said


@pytest.mark.parametrize("albedo", ["constant", "estimated"])
@pytest.mark.parametrize("indirect", ["none", "observed"])
def test_what_is_modelled_is_said_apart(albedo: str, indirect: str, source: str) -> None:
    wishes = prepare(CaptureOptions(source, albedo=albedo, indirect=indirect)).wishes
    assert (wishes.albedo, wishes.indirect) == (albedo, indirect)


def test_source_without_poses_is_tracked(tmp_path: Path, source: str) -> None:
    """In a volume that leaves its camera room to move; poses that are not there cannot be asked for."""
    folder = folders.redwood(tmp_path / "r")
    (folder / "trajectory.log").unlink()
    capture = prepare(CaptureOptions(str(folder)))
    assert capture.wishes.poses == "track"
    assert capture.wishes.volume_m == enlarged_volume(default_volume(capture.source, capture.frames))
    assert prepare(CaptureOptions(str(folder), volume="0,0,0,1,2,3")).wishes.volume_m == (0, 0, 0, 1, 2, 3)
    for poses in ("given", "refine"):
        with pytest.raises(OptionError, match="--poses track"):
            prepare(CaptureOptions(str(folder), poses=poses))
        assert prepare(CaptureOptions(source, poses=poses)).wishes.poses == poses


def test_bad_options_are_told_before_the_source_is_opened() -> None:
    with pytest.raises(OptionError, match="--up"):
        prepare(CaptureOptions("/nowhere", up="x"))
    with pytest.raises(SourceError):
        prepare(CaptureOptions("/nowhere"))
