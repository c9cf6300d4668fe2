"""The page of `probeless bench accuracy`: fronts, knobs, the thesis's tables and figures, all in one HTML file."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tests.bench.accuracy import thesis as names
from tests.bench.accuracy.front import front_of, light_error, paced_ms, picture_error, wall_ms
from tests.bench.accuracy.plots import ERRORS, NAMED, front_figure, front_svg, knob_figure, knobs_of, preset_of
from tests.bench.bases.comparison import draw_bases
from tests.bench.report.finished import Part
from tests.bench.report.plotting import save
from tests.bench.thesis.captions import THESIS_FIGURES
from tests.bench.thesis.tables import table_6_1, table_6_2, table_6_3

if TYPE_CHECKING:
    from tests.bench.accuracy.points import MeasuredPoint

PAGE = "report.html"
FIGURES = "figures"

HOW_TO_READ = (
    "Each mark of the first plots is one way to run the program: to the right it takes longer, higher up it errs more.",
    "The red line joins those that nothing else beats in both; for any other mark there is one that is at "
    "least as fast and errs no more.",
    "Light error is the angle between the light found and the true one; picture error is FLIP, 0 where two pictures "
    "look the same, about 0.1 where a difference is just noticed.",
    "A knob's curve turns that knob alone; its bars show between which figures it lies with 95 %, by the frames.",
    "Tables and figures that carry a number are the thesis's own, made anew here; in tables what is blue is ours, what "
    "is black is the thesis's.",
)

STYLE = """
body{font:16px/1.5 system-ui,sans-serif;color:#222;background:#fff;max-width:72rem;margin:0 auto;padding:1rem}
h1{font-size:1.6rem}h2{margin-top:2.5rem;border-bottom:2px solid #ddd}h3{margin-bottom:.3rem}
img,svg{max-width:100%;height:auto}.front{display:flex;flex-wrap:wrap;gap:1rem}
.front>*{flex:1 1 20rem;min-width:0;max-width:35rem}.wide{overflow-x:auto}
table{border-collapse:collapse;font-size:.85rem}td,th{padding:.2rem .55rem;border-bottom:1px solid #ddd}
td{text-align:right;white-space:nowrap}td:first-child,.points td:first-child{text-align:left}
td.ours{color:#1f4e9c;font-weight:600}tr.front-point{background:#fdeef2}td.no{color:#b00020;font-weight:700}
.note{font-size:.85rem;color:#555}figure{margin:1.2rem 0}
.large img{width:100%;min-width:44rem;max-width:none}figcaption{font-size:.9rem;color:#444}
details{margin:.8rem 0}summary{cursor:pointer;font-weight:600}
"""


def write_report(
    folder: Path, points: Sequence[MeasuredPoint], parts: Mapping[str, Part], result: Mapping[str, Any]
) -> Path:
    """Write `folder`/report.html, one file that needs no other, and its figures as PNG beside it. Raises OSError.

    folder: where the parts kept their pictures. result: of the suite, see tests.bench.report.report.
    """
    speed = parts[names.SPEED].details if names.SPEED in parts else {}
    cores = 0 if speed.get("is_gpu") else int(speed.get("cores", 0))
    body = [
        _head(result),
        *(_scene(folder, [p for p in points if p.scene == scene], cores) for scene in _scenes(points)),
        _knobs(folder, points, cores),
        _tables(parts),
        _figures(folder, parts, is_gpu=bool(speed.get("is_gpu"))),
        _bases(folder, parts),
        _rows(result),
    ]
    page = (
        "<!doctype html><html lang='en'><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width, initial-scale=1'>"
        f"<title>probeless: what accuracy costs</title><style>{STYLE}</style><body>{''.join(body)}</body></html>"
    )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / PAGE).write_text(page, encoding="utf-8")
    return folder / PAGE


def _scenes(points: Sequence[MeasuredPoint]) -> list[str]:
    return list(dict.fromkeys(point.scene for point in points))


def _head(result: Mapping[str, Any]) -> str:
    sizes = ", ".join(f"{name}: {count}" for name, count in result.get("sizes", {}).items())
    lines = "".join(f"<li>{html.escape(line)}</li>" for line in HOW_TO_READ)
    return (
        "<h1>What accuracy costs in time</h1>"
        f"<p><b>{html.escape(str(result['device']))}</b>, commit {html.escape(str(result['commit']))}, "
        f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC.</p><p class='note'>{html.escape(sizes)}</p>"
        f"<h2>How to read it</h2><ol>{lines}</ol>"
    )


def _scene(folder: Path, points: Sequence[MeasuredPoint], cores: int) -> str:
    """Both fronts and the table of all points, fastest first."""
    name = points[0].scene
    drawn = []
    for kind, error in ERRORS.items():
        if any(math.isfinite(error(point)) for point in points):
            save(front_figure(points, kind, cores), folder / FIGURES / f"front_{name}_{kind}.png")
            drawn.append(f"<div>{front_svg(points, kind, cores)}</div>")
    return (
        f"<h2>{html.escape(name)}</h2><div class='front'>{''.join(drawn)}</div>"
        f"<p class='note'>Point at a mark to see its settings.</p>{_point_table(points, cores)}"
    )


def _point_table(points: Sequence[MeasuredPoint], cores: int) -> str:
    """What is on a front or has a name, and below it everything."""
    fronts = {
        kind: {id(point) for point in front_of(points, lambda p: paced_ms(p, cores), error)}
        for kind, error in ERRORS.items()
    }
    on = {id(point): [kind for kind, members in fronts.items() if id(point) in members] for point in points}
    ordered = sorted(points, key=lambda p: paced_ms(p, cores))
    chosen = [point for point in ordered if on[id(point)] or preset_of(point) in NAMED]
    return (
        f"<h3>On a front, and the thesis's presets, fastest first</h3>{_points(chosen, on, cores)}"
        f"<details><summary>All {len(points)} points, fastest first</summary>{_points(ordered, on, cores)}</details>"
    )


def _points(points: Sequence[MeasuredPoint], on: Mapping[int, list[str]], cores: int) -> str:
    rows = []
    for point in points:
        figures = (
            point.words + (f" ({NAMED[str(preset_of(point))]})" if preset_of(point) in NAMED else ""),
            f"{paced_ms(point, cores):.1f}",
            f"{wall_ms(point):.1f}",
            _number(light_error(point), 2),
            _number(_mean(point.irradiance), 3),
            _number(_mean(point.msad), 3),
            _number(picture_error(point), 3),
            _number(_mean(point.ssim), 3),
            _number(_mean(point.jod), 2),
            f"{point.device_bytes / 2**20:.0f}",
            " and ".join(on[id(point)]),
        )
        cells = "".join(f"<td>{html.escape(text)}</td>" for text in figures)
        rows.append(f"<tr{' class=front-point' if on[id(point)] else ''}>{cells}</tr>")
    time = f"ms of {cores} cores" if cores else "ms"
    heads = ("settings", time, "ms, wall", "light, deg", "irradiance", "MSAD", "FLIP", "SSIM", "JOD", "MiB", "front of")
    head = "".join(f"<th>{html.escape(text)}</th>" for text in heads)
    return (
        f"<div class='wide'><table class='points'><thead><tr>{head}</tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _knobs(folder: Path, points: Sequence[MeasuredPoint], cores: int) -> str:
    drawn = []
    for knob in knobs_of(points):
        path = save(knob_figure(points, knob, cores), folder / FIGURES / f"knob_{knob}.png")
        drawn.append(_picture(path, f"{knob.replace('_', ' ')}, everything else as usual"))
    time = f"Times are of the processor over {cores} cores." if cores else "Times are medians."
    note = f"<p class='note'>{time} Bars: 95 %, bootstrap over the frames.</p>"
    return f"<h2>One knob at a time</h2>{note}<div class='front'>{''.join(drawn)}</div>" if drawn else ""


def _tables(parts: Mapping[str, Part]) -> str:
    tables = []
    if names.PRESETS in parts and parts[names.PRESETS].details:
        tables.append(table_6_1(parts[names.PRESETS].details).as_html())
    if names.SPEED in parts and parts[names.SPEED].details:
        tables += [table(parts[names.SPEED].details).as_html() for table in (table_6_2, table_6_3)]
    return f"<h2>The thesis's tables</h2>{''.join(tables)}" if tables else ""


def _figures(folder: Path, parts: Mapping[str, Part], *, is_gpu: bool) -> str:
    drawn = []
    for figure in THESIS_FIGURES:
        if figure.part not in parts or not parts[figure.part].details:
            continue
        path = folder / FIGURES / f"figure_{figure.number.replace('.', '_')}.png"
        figure.draw({**parts[figure.part].details, **({"is_gpu": True} if is_gpu else {})}, path, folder)
        drawn.append(_picture(path, f"Figure {figure.number}. {figure.caption}", is_large=True))
    return f"<h2>The thesis's figures</h2>{''.join(drawn)}" if drawn else ""


def _bases(folder: Path, parts: Mapping[str, Part]) -> str:
    if names.BASES not in parts or not parts[names.BASES].details.get("points"):
        return ""
    path = folder / FIGURES / "bases.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    draw_bases(parts[names.BASES].details["points"], path)
    words = "Spherical harmonics, spherical Gaussians and Haar wavelets of as many coefficients (B9)."
    return f"<h2>Another basis at equal cost</h2>{_picture(path, words, is_large=True)}"


def _rows(result: Mapping[str, Any]) -> str:
    """What is held against a goal, and what was not measured."""
    rows = []
    for row in result["rows"]:
        if row["goal"]:
            holds = "<td>yes</td>" if row["holds"] else "<td class=no>no</td>"
            value = f"<td>{row['value']:.4g} {html.escape(row['unit'])}</td><td>{html.escape(row['goal'])}</td>"
            rows.append(f"<tr><td>{html.escape(row['name'])}</td>{value}{holds}</tr>")
    missing = "".join(
        f"<li>{html.escape(item['name'])}: {html.escape(item['reason'])}</li>" for item in result["unmeasured"]
    )
    held = (
        "<h2>Held against a goal</h2><div class='wide'><table><thead><tr><th>row<th>value<th>goal<th>holds</tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table></div>"
        if rows
        else ""
    )
    return held + (f"<h2>Not measured</h2><ul>{missing}</ul>" if missing else "")


def _picture(path: Path, words: str, *, is_large: bool = False) -> str:
    """`is_large`: of many small pictures, which a narrow page scrolls instead of shrinking them."""
    data = base64.b64encode(path.read_bytes()).decode()
    text = html.escape(words)
    image = f"<img alt='{text}' src='data:image/png;base64,{data}'>"
    return f"<figure>{_large(image) if is_large else image}<figcaption>{text}</figcaption></figure>"


def _large(image: str) -> str:
    return f"<div class='wide large'>{image}</div>"


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.nan


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else ""
