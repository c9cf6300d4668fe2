"""The benchmark of rendering: what its rows are made of, which goals they carry, and what its pictures show."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from client.synthetic.lighting.lights import disc_light
from client.synthetic.render import camera_rays, cast
from client.synthetic.source import open_synthetic
from server.effects.plan import Effect
from server.maths.sh import lambert_transfer
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.shading.composite import srgb_codes
from tests.bench.rendering import room as rendering_room
from tests.bench.rendering import speed as rendering_speed
from tests.bench.rendering import stage as rendering_stage
from tests.bench.rendering import suite as rendering
from tests.bench.rendering import turning as rendering_turning
from tests.bench.rendering.bleeding import Bleeding, to_objects, to_real
from tests.bench.rendering.common import PRESETS, require
from tests.bench.rendering.composites import grown
from tests.bench.rendering.pasting import ObjectNormals, pasted
from tests.bench.rendering.pictures import (
    CROP,
    ENLARGED,
    around_objects,
    bounce_strip,
    change_picture,
    preset_strip,
    save_strip,
    stack,
    tinted,
)
from tests.bench.rendering.report import write_report
from tests.bench.rendering.rows import add_pasted, add_score
from tests.bench.rendering.speed import EVERYTHING, SECTIONS, StageClock, speed_of, torus
from tests.bench.rendering.turning import (
    BALL_CENTER,
    BALL_RADIUS_M,
    SLAB,
    TABLE,
    Turn,
    ball_points,
    exact_shadow,
    pixels_of,
    shadow_at,
    shadow_change,
    turning_camera,
)
from tests.bench.report.finished import Part, UnmeasurableError
from tests.bench.report.run import Run
from tests.bench.truth import object_shading, whole_room
from tests.bench.truth.composite_truth import CompositeTruth, linear_from_codes, score
from tests.bench.truth.mitsuba_room import RoomSet
from tests.bench.truth.room_composites import RoomTruth, SetTruth, set_truth
from tests.data import data_folder
from tests.scenes.lights import lobe_and_sky, uniform

SHAPE = (130, 220)
SILENT: Callable[[str], None] = lambda _text: None  # noqa: E731


@pytest.fixture
def flip() -> None:
    pytest.importorskip("flip_evaluator", reason="flip_evaluator is not installed: make install-bench")


@pytest.fixture
def truth() -> CompositeTruth:
    """A grey wall, a red square in front of it and its shadow; pasting has the square too bright and no shadow."""
    picture = np.full((*SHAPE, 3), 0.4)
    composite, baseline = picture.copy(), picture.copy()
    objects = np.zeros(SHAPE, bool)
    objects[40:70, 50:80] = True
    composite[70:90, 50:100] *= np.linspace(0.3, 0.9, 20)[:, None, None]
    composite[objects], baseline[objects] = (0.3, 0.1, 0.1), (0.6, 0.2, 0.2)
    return CompositeTruth([picture], [composite], [objects], [srgb_codes(baseline)])


def values(part: Part) -> dict[str, tuple[float, str, bool | None]]:
    return {row.name: (row.value, row.goal, row.holds) for row in part.rows}


@pytest.mark.usefixtures("flip")
def test_the_truth_scores_as_such(truth: CompositeTruth) -> None:
    found = score(truth, truth.wanted)
    assert found.error == found.last_error == pytest.approx(0, abs=1e-6)
    assert found.brightness == pytest.approx(1, abs=0.01)
    assert found.shadow_correlation > 0.999
    assert found.shadow_slope == pytest.approx(1, abs=0.02)


@pytest.mark.usefixtures("flip")
def test_pasting_scores_as_objects_too_bright_and_no_shadow(truth: CompositeTruth) -> None:
    found = score(truth, truth.pasted)
    assert found.brightness == pytest.approx(2, abs=0.05)
    assert found.shadow_correlation == 0
    assert found.object_error > 0.1
    assert found.real_error > 0.05
    half = [srgb_codes((truth.composites[0] + truth.pictures[0]) / 2)]
    assert score(truth, half).shadow_slope == pytest.approx(0.5, abs=0.03)
    assert score(truth, half).shadow_correlation > 0.99


@pytest.mark.usefixtures("flip")
def test_rows_are_held_against_the_goals_and_against_pasting(truth: CompositeTruth) -> None:
    part = Part()
    of_pasted = add_pasted(part, "room", truth)
    add_score(part, "good", truth, truth.wanted, of_pasted, 0.06, 0.9)
    add_score(part, "bad", truth, truth.pasted, of_pasted, 0.06, 0.9)
    add_score(part, "beside", truth, truth.pasted, of_pasted, None, None, is_held=False)
    rows = values(part)
    held = ("FLIP of what the objects change", "FLIP over that of pasting", "shadow, correlation")
    assert [rows[f"good: {name}"][1:] for name in held] == [("<= 0.06", True), ("<= 0.5", True), (">= 0.9", True)]
    assert [rows[f"bad: {name}"][2] for name in held] == [False, False, False]
    assert rows["bad: FLIP over that of pasting"][0] == pytest.approx(1)
    assert [rows[f"beside: {name}"][1] for name in held] == ["", "", ""]


def test_objects_are_replaced_in_the_truth(truth: CompositeTruth) -> None:
    changed = truth.with_objects([np.full((int(truth.objects[0].sum()), 3), 0.2)])[0]
    np.testing.assert_array_equal(changed[truth.objects[0]], srgb_codes(np.full((900, 3), 0.2)))
    np.testing.assert_array_equal(changed[~truth.objects[0]], truth.wanted[0][~truth.objects[0]])


def test_pasted_objects_have_the_whole_light() -> None:
    shown = np.full((8, 8, 3), 77, np.uint8)
    mask, normals = np.zeros((8, 8), bool), np.zeros((8, 8, 3))
    mask[2:4, 2:4] = True
    normals[mask] = (0, 1, 0)
    light, albedo = lobe_and_sky((0, 1, 0)) / 8, np.full((8, 8, 3), 0.5)
    found = pasted(shown, mask, normals, albedo, light)
    wanted = srgb_codes(0.5 * (lambert_transfer(np.array([[0.0, 1, 0]]), 4) @ light))
    np.testing.assert_array_equal(found[mask], np.tile(wanted, (4, 1)))
    assert (found[~mask] == 77).all()
    white = pasted(shown, mask, normals, np.ones((8, 8, 3)), uniform())
    assert (white[mask] == 255).all()


def test_normals_of_a_mesh_are_smooth_across_its_triangles(tmp_path: Path) -> None:
    """320 triangles, each of which a smooth normal turns by 18 degrees."""
    pytest.importorskip("open3d", reason="open3d is not installed: make install-bench")
    ball = trimesh.creation.icosphere(subdivisions=2, radius=BALL_RADIUS_M)
    ball.apply_translation(BALL_CENTER)
    (tmp_path / "ball.ply").write_bytes(ball.export(file_type="ply"))
    pose = rendering_turning.pose_at(0)
    normals = ObjectNormals([tmp_path / "ball.ply"]).seen(turning_camera(), pose)
    assert 0.02 < (np.abs(normals).sum(axis=-1) > 0).mean() < 0.2
    points, of_points = ball_points()
    facing = of_points @ (rendering_turning.EYE - BALL_CENTER) > 0.6  # a coarse ball is seen elsewhere at its rim
    found = normals[pixels_of(points[facing], pose)]
    cosines = (found * of_points[facing]).sum(axis=1)
    assert np.degrees(np.arccos(np.minimum(cosines, 1))).mean() < 2


WALL, OBJECT, BOUNCE = np.array([0.8, 0.3, 0.2]), np.array([0.3, 0.5, 0.6]), np.array([0.12, 0.03, 0.02])
"""Albedos, and irradiance by way of other surfaces."""
SHADED, COVERED = (slice(20, 40), slice(32, 50)), (slice(20, 40), slice(10, 30))


def bleeding_truth(transport: str, units: float) -> SetTruth:
    """A coloured wall under coloured light, an object and its shadow; with global illumination both get `BOUNCE`."""
    light = np.array([0.5, 0.4, 0.3])
    irradiance = np.tile(light, (60, 80, 1))
    shaded, albedo, objects = irradiance.copy(), np.tile(WALL, (60, 80, 1)), np.zeros((60, 80), bool)
    shaded[SHADED] *= 0.7
    objects[COVERED] = True
    of_object = np.tile(OBJECT, (60, 80, 1))
    if transport == "gi":
        shaded[SHADED] += BOUNCE
        shaded[COVERED] += BOUNCE
    composite = np.where(objects[..., None], of_object, albedo) * shaded / units
    room: Any = SimpleNamespace(object_albedo=[of_object], albedo=lambda _surface: albedo[None])
    item = RoomSet(Path(), "key", "tex", transport)
    return SetTruth([albedo * irradiance / units], [composite], [objects], [], item, room, units, np.zeros((16, 3)))


@pytest.mark.parametrize("compare", [to_real, to_objects])
def test_bleeding_is_what_global_illumination_adds(compare: Callable[..., Bleeding]) -> None:
    """Codes of 8 bits leave a few percent."""
    gi, direct = bleeding_truth("gi", 1.1), bleeding_truth("direct", 0.9)
    exact = compare(gi, direct, gi.wanted, direct.wanted)
    assert exact.color.value == pytest.approx(1, abs=0.1)
    assert exact.luminance.value == pytest.approx(1, abs=0.1)
    without = direct.composites[0] * direct.units / gi.units
    assert compare(gi, direct, [srgb_codes(without)], direct.wanted).color.value == pytest.approx(0, abs=0.1)
    half = [srgb_codes((gi.composites[0] + without) / 2)]
    assert compare(gi, direct, half, direct.wanted).color.value == pytest.approx(0.5, abs=0.1)
    opposite = [srgb_codes(2 * without - gi.composites[0])]
    assert compare(gi, direct, opposite, direct.wanted).color.value == pytest.approx(-1, abs=0.2)


def test_a_grey_error_on_a_coloured_wall_is_no_bleeding() -> None:
    gi, direct = bleeding_truth("gi", 1.0), bleeding_truth("direct", 1.0)
    darker = gi.composites[0].copy()
    darker[SHADED] -= 0.1 * WALL
    found = to_real(gi, direct, [srgb_codes(darker)], direct.wanted)
    assert found.color.value == pytest.approx(1, abs=0.1)
    assert found.luminance.value < 0


def test_the_rim_of_an_object_does_not_count_as_lit() -> None:
    gi, direct = bleeding_truth("gi", 1.0), bleeding_truth("direct", 1.0)
    rim = gi.objects[0] & grown(~gi.objects[0], 1)
    mixed = gi.composites[0].copy()
    mixed[rim] = WALL
    assert to_objects(gi, direct, [srgb_codes(mixed)], direct.wanted).color.value == pytest.approx(1, abs=0.1)


def test_the_occluder_leaves_the_picture_and_the_ball_stays() -> None:
    turn = Turn(still=2, turning=3)
    camera, points = turning_camera(), ball_points()[0]
    assert len(turn.poses()) == 7
    rays = camera_rays(camera)
    shares = [(cast([TABLE, SLAB], camera, rays, pose)[1] == 1).mean() for pose in turn.poses()]
    assert min(shares[:2]) > 0.01
    assert max(shares[-2:]) == 0
    for pose in turn.poses():
        row, column = pixels_of(points, pose)
        assert 0 <= row.min() <= row.max() < camera.height
        assert 0 <= column.min() <= column.max() < camera.width
    np.testing.assert_allclose([pose[:3, 3] for pose in turn.poses()], np.tile(turn.poses()[0][:3, 3], (7, 1)))


def test_the_slab_shades_the_side_of_the_ball_that_faces_it() -> None:
    points, _normals = ball_points()
    np.testing.assert_allclose(np.linalg.norm(points - BALL_CENTER, axis=1), BALL_RADIUS_M)
    direction = rendering_turning.TOWARDS_LIGHT / np.linalg.norm(rendering_turning.TOWARDS_LIGHT)
    shadow = exact_shadow(disc_light(direction).sh)[:, 1]
    left = points[:, 0] < BALL_CENTER[0]
    assert shadow[left].mean() > 2 * shadow[~left].mean()
    assert shadow.mean() > 0.02


def test_a_shadow_is_what_the_slab_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendering_turning, "AVERAGED", 2)
    turn, camera = Turn(still=2, turning=1), turning_camera()
    bright, dark = (np.full((camera.height, camera.width, 3), code, np.uint8) for code in (200, 150))
    with_slab, without = [bright, dark, *[bright] * 3], [bright] * 5
    before, after = shadow_at(turn, with_slab, without, 2), shadow_at(turn, with_slab, without, 5)
    np.testing.assert_allclose(before, (linear_from_codes(bright) - linear_from_codes(dark))[0, 0, 0] / 2)
    np.testing.assert_array_equal(after, 0 * after)
    assert shadow_change(before, after) == pytest.approx(100)
    assert shadow_change(before, 1.04 * before) == pytest.approx(4)


def test_a_torus_has_its_triangles() -> None:
    assert all(2 * along * around == triangles for triangles, (along, around) in SECTIONS.items())
    mesh = torus(20_000)
    assert len(mesh.triangles) == 20_000
    size = np.ptp(mesh.vertices, axis=0)
    np.testing.assert_allclose(size, (0.38, 0.38, 0.12), rtol=0.02)


def test_effects_are_timed_one_by_one_and_give_what_they_give(engine: Engine) -> None:
    clock = StageClock(engine.queue)
    more: Effect[Any] = Effect(lambda number: number + 1)
    assert [clock.run_effect(more, {"number": number}) for number in (4, 5)] == [5, 6]
    assert set(clock.wall_ms) == set(clock.cpu_ms) == {"<lambda>"}
    assert len(clock.wall_ms["<lambda>"]) == 2


def test_frames_that_are_timed_are_computed(device: Device) -> None:
    """A camera at rest would have its pictures settled, and effects without a time."""
    part = speed_of(Run(device, False, SILENT), "rm", "160x120", 1_000)
    times = {row.name.split(": ")[1]: row.value for row in part.rows if "wall" in row.name}
    assert {"rasterize", "shadow_real", "shade_virtual", EVERYTHING} <= set(times)
    assert min(times.values()) > 0
    assert times[EVERYTHING] > times["shadow_real"] + times["shade_virtual"]


def test_pictures_of_changes(truth: CompositeTruth) -> None:
    change = change_picture(np.array([[-1.0, 0.0, 1.0]]))
    assert change[0].tolist() == [[0, 0, 255], [255, 255, 255], [255, 0, 0]]  # BGR
    assert tinted(np.zeros((1, 1, 3)))[0, 0].tolist() == [127, 127, 127]
    assert tinted(np.array([[[1.0, 0.0, -1.0]]]))[0, 0].tolist() == [0, 127, 255]
    rows, columns = around_objects(truth.objects[0])
    assert (rows.stop - rows.start, columns.stop - columns.start) == CROP
    assert truth.objects[0][rows, columns].sum() == truth.objects[0].sum()


def test_strips_are_stacked_into_a_sheet(truth: CompositeTruth, tmp_path: Path) -> None:
    assert not stack(tmp_path, "presets", tmp_path / "presets.jpg")
    preset_strip(tmp_path, "a", truth, {"rm": truth.wanted, "art4": truth.pasted}, 0)
    preset_strip(tmp_path, "b", truth, {"rm": truth.wanted}, 0)
    bounce = np.zeros((*SHAPE, 3))
    bounce_strip(tmp_path, "a", truth.pasted[0], truth.wanted[0], bounce, bounce, truth.objects[0])
    assert stack(tmp_path, "presets", tmp_path / "presets.jpg")
    sheet = cv2.imread(str(tmp_path / "presets.jpg"))
    height, width = 2 * (ENLARGED * CROP[0] + 28), ENLARGED * CROP[1]
    assert sheet.shape == (2 * height, 3 * width, 3)
    assert (sheet[height:, 2 * width :] > 250).all()  # the second row is shorter
    assert stack(tmp_path, "presets", tmp_path / "small.jpg", rows=("b",), share=0.5)
    assert cv2.imread(str(tmp_path / "small.jpg")).shape == (height // 2, width, 3)
    save_strip(tmp_path, "other", np.zeros((4, 4, 3), np.uint8))
    assert stack(tmp_path, "bounce", tmp_path / "bounce.jpg")


def test_the_report_shows_pictures_and_figures(tmp_path: Path) -> None:
    for name in ("key_white_gi", "bounce"):
        cv2.imwrite(str(tmp_path / f"{name}.jpg"), np.zeros((4, 4, 3), np.uint8))
    row = {"name": "a < b", "value": 0.25, "unit": "ms", "goal": "<= 0.1", "holds": False}
    missing = [{"name": "x", "reason": "no GPU"}]
    result = {"commit": "abc", "device": "device", "rows": [row], "unmeasured": missing}
    page = write_report(tmp_path, result).read_text()
    assert page.index("bounce.jpg") < page.index("key_white_gi.jpg")
    assert "a &lt; b" in page
    assert '<td>0.25<td>ms<td>&lt;= 0.1<td class="no">no' in page.replace("</td>", "")
    assert "x: no GPU" in page


def test_what_is_not_installed_is_named() -> None:
    require("numpy")
    with pytest.raises(UnmeasurableError, match=r"no_such_module not installed: make install-bench"):
        require("numpy", "no_such_module")


def test_a_rasteriser_that_nobody_has_measured_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendering, "RASTERIZE", ("tests.bench.no_such_module", "nothing"))
    part = rendering.rasterize_part(Run(None, True, SILENT))  # type: ignore[arg-type]
    assert not part.rows
    assert "no_such_module" in part.unmeasured[0].reason


def test_the_suite_has_all_parts_and_goes_on_without_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def measure(_run: Run) -> Part:
        made = Part(sizes={"frames": 1})
        made.add("row", 1.0, "", "<= 2")
        return made

    def refuse(_run: Run) -> Part:
        raise UnmeasurableError("no data")

    names = list(rendering.PARTS)
    assert {"key white", "studio tex", "stage", "turning", "speed", "rasterize"} <= set(names)
    monkeypatch.setattr(rendering, "PARTS", {names[0]: measure, names[1]: refuse})
    monkeypatch.setattr(rendering, "OUT", tmp_path)
    result = rendering.run_suite(True, SILENT)
    assert [(row["name"], row["holds"]) for row in result["rows"]] == [("row", True)]
    assert result["unmeasured"] == [{"name": names[1], "reason": "no data"}]
    assert (tmp_path / "result.json").is_file()
    assert (tmp_path / "report.html").is_file()


@pytest.mark.usefixtures("flip")
def test_the_stage_is_rendered_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: Device) -> None:
    """A very short run: two small frames, one preset."""
    monkeypatch.setattr(rendering_stage, "OUT", tmp_path)
    monkeypatch.setattr(rendering_stage, "PRESETS", ("gr15fast",))
    monkeypatch.setattr(rendering_stage, "SIZE", "240x180")
    monkeypatch.setattr(rendering_stage, "GUESTS", "ball")
    monkeypatch.setattr(rendering_stage, "QUICK_FRAMES", 2)
    monkeypatch.setattr(rendering_stage, "SETS", {"stage": "texture=town&light=4"})
    rows = values(rendering_stage.stage_part(Run(device, True, SILENT)))
    row = "stage: GR15FAST, true light"
    assert rows[f"{row}: FLIP of what the objects change"][1:] == ("<= 0.1", True)
    assert rows[f"{row}: FLIP over that of pasting"][0] < 0.8
    assert rows[f"{row}: shadow, correlation"][0] > 0.8
    assert 0.85 < rows[f"{row}: objects' mean luminance over the true"][0] < 1.15
    assert (tmp_path / "stage.jpg").is_file()
    assert (tmp_path / "stage" / "ball.ply").is_file()


def test_guests_of_the_stage_are_the_only_difference() -> None:
    spec = "synthetic:stage?size=96x72&frames=1"
    truth = rendering_stage.stage_truth(open_synthetic(spec), open_synthetic(f"{spec}&with=ball"))
    objects, change = truth.objects[0], truth.composites[0] - truth.pictures[0]
    assert 0.001 < objects.mean() < 0.1
    assert change[~objects].max() <= 0  # a shadow only takes light away
    assert change[~objects].min() < -0.02
    pasted_change = (truth.pasted[0] != truth.shown[0]).any(axis=-1)
    assert not pasted_change[~objects].any()
    assert pasted_change[objects].mean() > 0.8


@pytest.mark.data
@pytest.mark.usefixtures("flip")
def test_a_set_of_the_room_in_short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: Device) -> None:
    """One frame at the fastest preset: every kind of row is there, with its goal, and the pictures."""
    pytest.importorskip("open3d", reason="open3d is not installed: make install-bench")
    data_folder("mitsuba_room")
    monkeypatch.setattr(rendering_room, "OUT", tmp_path)
    monkeypatch.setattr(rendering_room, "QUICK_FRAMES", 1)
    monkeypatch.setattr(rendering_room, "PRESETS", ("gr15fast",))
    monkeypatch.setattr(rendering_room, "REFERENCE", "gr15fast")
    monkeypatch.setattr(rendering_room, "SHORT", {})
    monkeypatch.setattr(object_shading, "DIRECTIONS", 128)
    monkeypatch.setattr(whole_room, "EYES_M", whole_room.EYES_M[:1])
    rows = values(rendering_room.room_part(Run(device, True, SILENT), "key", "tex"))
    direct, gi = "key_tex_direct: GR15FAST, true light", "key_tex_gi: GR15FAST, true light"
    assert rows[f"{direct}: FLIP of what the objects change"][1] == "<= 0.1"
    assert rows[f"{gi}: FLIP of what the objects change"][1] == ""
    assert rows["key_tex_gi: RM, its own light: FLIP of what the objects change"][1] == "<= 0.12"
    assert rows[f"{gi}: indirect light of the room on objects, colour, slope"][1] == ">= 0.5"
    assert rows[f"{gi}: shadow, correlation"][1] == ">= 0.8"
    floor = "truth with the objects shaded by exact geometry, 16 coefficients"
    assert rows[f"key_tex_direct: {floor}, no indirect light: FLIP of what the objects change"][0] < 0.03
    assert 0.1 < rows["key_tex_direct: pasted without shadows: FLIP of what the objects change"][0] < 0.6
    brightness = "objects' mean luminance over the true"
    assert rows[f"{direct}: {brightness}"][0] == pytest.approx(1, abs=0.1)
    assert rows[f"key_tex_direct: {rendering_room.PART_SEEN}, true light: {brightness}"][0] > 1.3  # walls are missing
    assert {"key_tex_gi.jpg", "key_tex_direct.jpg"} <= {path.name for path in tmp_path.iterdir()}


@pytest.mark.data
def test_a_path_traced_composite_changes_the_objects_and_shades_what_is_near() -> None:
    pytest.importorskip("open3d", reason="open3d is not installed: make install-bench")
    folder = data_folder("mitsuba_room")
    item = RoomSet(folder, "key", "white", "direct")
    camera_path = rendering_room.open_source(str(item.folder))
    pose = camera_path[0].world_from_camera
    assert pose is not None
    truth = set_truth(item, RoomTruth(folder, camera_path.camera, [pose]))
    objects = truth.objects[0]
    assert truth.changed[0][objects].mean() > 0.9
    assert not truth.real[0][objects].any()
    change = (truth.composites[0] - truth.pictures[0])[truth.real[0]]
    assert change.max() < 0.02  # direct light: only shadows
    assert np.abs(truth.room.object_normals[0][objects]).sum(axis=-1).min() > 0  # nothing is pasted without a normal
    np.testing.assert_allclose(truth.light * truth.units, item.sh)
    assert PRESETS[0] == rendering_speed.PRESETS[0]
