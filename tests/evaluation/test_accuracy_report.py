"""The page of the suite of accuracy: fronts, intervals, and that all of it is in one file that fetches nothing."""

from __future__ import annotations

import html
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from tests.bench.accuracy.front import front_of, interval
from tests.bench.accuracy.plots import curve_of, preset_of
from tests.bench.accuracy.points import MeasuredPoint, words_of
from tests.bench.accuracy.report import write_report
from tests.bench.accuracy.thesis import PRESETS as PRESETS_PART
from tests.bench.accuracy.thesis import SPEED
from tests.bench.report.finished import Part
from tests.bench.report.plotting import spread_labels
from tests.bench.thesis.numbers import ROWS
from tests.bench.thesis.tables import table_6_2
from tests.evaluation.made_up import presets_details, speed_details

pytest.importorskip("matplotlib", reason="matplotlib is not installed: make install-bench")

RESULT = {
    "device": "a <device>",
    "commit": "abc1234",
    "rows": [
        {"name": "held", "value": 1.5, "unit": "deg", "goal": "<= 2", "holds": True},
        {"name": "missed", "value": 3.0, "unit": "deg", "goal": "<= 2", "holds": False},
    ],
    "unmeasured": [{"name": "a GPU row", "reason": "no GPU at hand"}],
    "sizes": {"frames": 4},
}


def point(
    ms: float, error_deg: float, scene: str = "table", knob: str = "rays", flip: float = 0.1, **settings: Any
) -> MeasuredPoint:
    frames = 4
    around = np.array([0.9, 1.1, 0.8, 1.2])
    return MeasuredPoint(
        scene=scene,
        knob=knob,
        settings=settings,
        words=words_of(settings),
        frames=list(range(frames)),
        direction_deg=list(error_deg * around),
        irradiance=[0.1] * frames,
        msad=[0.2] * frames,
        flip=[flip] * frames if flip else [],
        ssim=[],
        jod=[],
        ms={"total": list(2 * ms * around)},
        cpu_ms=list(2 * ms * around),
        device_bytes=2**20,
    )


POINTS = [
    point(40, 3.0, knob="usual"),
    point(90, 2.0, knob="preset", preset="rm"),
    point(30, 2.5, knob="preset", preset="gr15fast"),
    point(20, 5.0, rays=25),
    point(80, 2.9, rays=169),
    point(35, 3.5, knob="ray_length_m", ray_length_m=0.1),
    point(33, 3.1, knob="smooth_depth", smooth_depth=False),
    point(40, 9.0, "room", "usual", flip=0),
    point(50, 8.0, "room", "preset_and_rays", flip=0, preset="art4", rays=25),
]


def beaten(one: tuple[float, float], others: list[tuple[float, float]]) -> bool:
    return any(a <= one[0] and b <= one[1] and (a, b) != one for a, b in others)


def test_the_front_is_what_nothing_beats() -> None:
    generator = np.random.default_rng(3)
    for count in (1, 2, 7, 60):
        pairs = [(float(a), float(b)) for a, b in generator.integers(0, 12, (count, 2))]  # with many ties
        front = front_of(pairs, lambda p: p[0], lambda p: p[1])
        assert sorted(front) == sorted(pair for pair in pairs if not beaten(pair, pairs))
        assert front == sorted(front)


def test_what_is_not_known_is_on_no_front() -> None:
    pairs = [(1.0, np.nan), (np.inf, 0.0), (2.0, 3.0)]
    assert front_of(pairs, lambda p: p[0], lambda p: p[1]) == [(2.0, 3.0)]
    assert front_of([], lambda p: p[0], lambda p: p[1]) == []


@pytest.mark.parametrize("of", [np.mean, np.median])
def test_intervals_are_those_of_scipy(of: Any) -> None:
    values = np.random.default_rng(8).lognormal(0, 0.5, 40)
    theirs = stats.bootstrap((values,), of, method="percentile", n_resamples=8000, rng=np.random.default_rng(1))
    ours = interval(list(values), of=of)
    width = theirs.confidence_interval.high - theirs.confidence_interval.low
    assert ours == pytest.approx(tuple(theirs.confidence_interval), abs=0.1 * width)


def test_intervals_of_few_values() -> None:
    assert interval([4.0]) == (4.0, 4.0)
    low, high = interval([1.0, 3.0])  # the mean of two draws: 1, 2 or 3
    assert (low, high) == (1.0, 3.0)
    with pytest.raises(ValueError, match="no values"):
        interval([])


def test_a_curve_has_the_usual_point_where_its_value_lies() -> None:
    table = [p for p in POINTS if p.scene == "table"]
    assert [label for label, _ in curve_of(table, "rays")] == ["25", "81", "169"]
    assert [label for label, _ in curve_of(table, "preset")] == ["rm", "reg4", "gr15fast"]
    assert [label for label, _ in curve_of(table, "ray_length_m")] == ["0.1", "room"]
    assert [label for label, _ in curve_of(table, "smooth_depth")] == ["no", "yes"]
    assert curve_of(table, "rays")[1][1] is POINTS[0]
    assert [p.words for _, p in curve_of(POINTS[7:], "preset_and_rays")] == ["as usual", POINTS[8].words]


def test_only_a_preset_alone_has_its_name() -> None:
    assert [preset_of(p) for p in POINTS[:4]] == ["reg4", "rm", "gr15fast", None]
    assert preset_of(POINTS[8]) is None


def test_labels_are_moved_apart_and_no_further() -> None:
    placed = spread_labels([0.0, 0.1, 5.0, 0.05], 1.0)
    assert np.diff(np.sort(placed)).min() >= 1 - 1e-6
    assert list(np.argsort(placed)) == [0, 3, 1, 2]
    assert placed[2] == 5.0


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    parts = {SPEED: Part(details=speed_details())}
    return write_report(tmp_path_factory.mktemp("report"), POINTS, parts, RESULT)


def test_the_page_is_one_file_that_fetches_nothing(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert not re.findall(r"""(?:src|href|url)\s*[=(]\s*["']?(?!data:|#)[^"'>\s]""", text.replace("xlink:href", "href"))
    for tag in ("<script", "<link", "<iframe", "@import"):
        assert tag not in text
    assert text.count("data:image/png;base64,") == 5  # knobs
    assert {path.name for path in (page.parent / "figures").iterdir()} >= {"front_table_light.png", "knob_rays.png"}


def test_the_page_says_every_point_and_its_settings(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for item in POINTS:
        assert f"<td>{html.escape(item.words)}" in text
        assert re.search(rf"<title>{re.escape(html.escape(item.words))}: \d+ ms", text), item.words
    assert "front_room_picture.png" not in {path.name for path in (page.parent / "figures").iterdir()}


def test_front_points_are_marked(page: Path) -> None:
    """Of the table's scene on the light's front: rays 25, GR15FAST, RM."""
    text = page.read_text(encoding="utf-8")
    first = text[text.index("<h2>table</h2>") : text.index("<details>")]
    marked = re.findall(r"<tr class=front-point><td>([^<]*)</td>.*?<td>([^<]*)</td></tr>", first)
    assert [words for words, on in marked if "light" in on] == [
        "--rays 25",
        "--preset gr15fast (GR15FAST)",
        "--preset rm (RM = GR12)",
    ]


def test_the_page_says_what_it_is_of(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for words in (
        "a &lt;device&gt;",
        "abc1234",
        "no GPU at hand",
        "<td class=no>no</td>",
        "Table 6.2",
        "How to read it",
    ):
        assert words in text
    assert len(re.findall("<li>", text[text.index("How to read it") : text.index("</ol>")])) == 5


def test_times_are_of_the_processor_where_it_runs_the_kernels(page: Path, tmp_path: Path) -> None:
    assert "ms of 2 cores" in page.read_text(encoding="utf-8")
    parts = {SPEED: Part(details={**speed_details(), "is_gpu": True})}
    text = write_report(tmp_path, POINTS[:3], parts, RESULT).read_text(encoding="utf-8")
    assert "ms of" not in text
    assert "processor time" not in text
    assert "FPS by it" not in table_6_2({**speed_details(), "is_gpu": True}).as_html()


def test_tables_and_figures_are_in_the_page(tmp_path: Path) -> None:
    details = presets_details(tmp_path)
    text = write_report(tmp_path, [], {PRESETS_PART: Part(details=details)}, RESULT).read_text(encoding="utf-8")
    assert "Table 6.1" in text
    for number in ("6.5", "6.6", "6.7", "6.8"):
        assert f"Figure {number}." in text
        assert (tmp_path / "figures" / f"figure_{number.replace('.', '_')}.png").stat().st_size > 5000
    assert "Table 6.2" not in text
    assert len(ROWS) == 9
