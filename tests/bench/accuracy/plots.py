"""Plots of a sweep: fronts of error against time, each point with its settings, and a curve a knob."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from protocol.messages import Wishes
from server.quality.settings import sampling_of
from server.transfer.sampling import PRESETS
from tests.bench.accuracy.front import front_of, interval, light_error, paced_ms, picture_error, wall_ms
from tests.bench.report.plotting import COLORS, INK, as_svg, panels, spread_labels

if TYPE_CHECKING:
    from tests.bench.accuracy.points import MeasuredPoint

NAMED = {"rm": "RM = GR12", "art4": "ART4 = GR14", "gr15": "GR15", "gr15fast": "GR15FAST"}
USUAL_PRESET = "reg4"
POINT, FRONT = "#8fa3bf", "#c2385a"
_OF_SAMPLING = {"stride": "stride", "interleave": "interleave", "upsampling": "upsampling"}
_SAME_AS_NONE = {"ray_length_m": "room"}
TITLES = {"light": "light error, degrees", "picture": "picture error, FLIP"}
ERRORS: dict[str, Callable[[MeasuredPoint], float]] = {"light": light_error, "picture": picture_error}


def front_figure(points: Sequence[MeasuredPoint], kind: str, cores: int) -> Any:
    """Error against time of one scene's points; `kind`: of ERRORS; `cores`: see accuracy_front.paced_ms."""
    error = ERRORS[kind]
    shown = [point for point in points if math.isfinite(error(point))]
    front = front_of(shown, lambda p: paced_ms(p, cores), error)
    figure, axes = panels(1, 1, 5.2, 4.2)
    axis = axes[0][0]
    axis.set_xscale("log")
    x = [paced_ms(point, cores) for point in front]
    axis.step(x, [error(point) for point in front], where="post", color=FRONT, lw=1.6, zorder=2)
    for number, point in enumerate(points):
        if point in shown:
            is_front = any(point is other for other in front)
            look = {"color": FRONT, "ms": 8} if is_front else {"color": POINT, "ms": 6}
            edge = INK if preset_of(point) in NAMED else "white"
            axis.plot(paced_ms(point, cores), error(point), "o", mec=edge, gid=f"point-{number}", zorder=3, **look)
    _label_presets(axis, shown, cores, error)
    axis.set(title=f"{points[0].scene}: {TITLES[kind]}", xlabel=_time_words(cores), ylabel=TITLES[kind])
    _plain_ticks(axis)
    return figure


def front_svg(points: Sequence[MeasuredPoint], kind: str, cores: int) -> str:
    """The figure as an `svg` element as wide as the page, in which each point has its settings as a title."""
    drawn = as_svg(front_figure(points, kind, cores))
    drawn = re.sub(r"<metadata>.*?</metadata>", "", drawn, flags=re.DOTALL)
    drawn = re.sub(r'<svg([^>]*?) width="[^"]*"', r"<svg\1", drawn, count=1)
    drawn = re.sub(r'<svg([^>]*?) height="[^"]*"', r"<svg\1", drawn, count=1)
    for number, point in enumerate(points):
        title = html.escape(describe(point, cores))
        drawn = drawn.replace(f'<g id="point-{number}">', f'<g id="point-{number}"><title>{title}</title>')
    return drawn


def describe(point: MeasuredPoint, cores: int) -> str:
    """One line: settings, time, errors."""
    words = [f"{point.words}: {paced_ms(point, cores):.0f} ms", f"{light_error(point):.2f} degrees"]
    if point.flip:
        words.append(f"FLIP {picture_error(point):.3f}")
    return ", ".join(words)


def preset_of(point: MeasuredPoint) -> str | None:
    """Its preset if nothing else is turned."""
    if not point.settings:
        return USUAL_PRESET
    return str(point.settings["preset"]) if set(point.settings) == {"preset"} else None


def knobs_of(points: Sequence[MeasuredPoint]) -> list[str]:
    """Knobs with more than the usual setting, in their order."""
    return [knob for knob in dict.fromkeys(point.knob for point in points) if knob != "usual"]


def knob_figure(points: Sequence[MeasuredPoint], knob: str, cores: int) -> Any:
    """Light error, picture error and time against the knob's value, a colour a scene, bars of 95 %."""
    scenes = [s for s in dict.fromkeys(p.scene for p in points) if any(p.knob == knob and p.scene == s for p in points)]
    curves = {scene: curve_of([p for p in points if p.scene == scene], knob) for scene in scenes}
    labels = list(dict.fromkeys(label for curve in sorted(curves.values(), key=len)[::-1] for label, _ in curve))
    lines: list[tuple[str, Callable[[MeasuredPoint], Sequence[float]]]] = [
        ("light error, degrees", lambda p: p.direction_deg),
        ("picture error, FLIP", lambda p: p.flip),
        (
            "ms a frame",
            lambda p: [ms / cores for ms in p.cpu_ms] if cores else p.ms["total"],
        ),
    ]
    if not any(point.flip for curve in curves.values() for _, point in curve):
        del lines[1]
    figure, axes = panels(len(lines), 1, 5.2, 1.75 * len(lines) + 1.1, sharex=True)
    for (axis,), (words, values) in zip(axes, lines, strict=True):
        for number, (scene, curve) in enumerate(curves.items()):
            shift = 0.1 * (number - (len(curves) - 1) / 2)
            drawn = [(labels.index(label) + shift, values(point)) for label, point in curve if values(point)]
            of = np.median if values is lines[-1][1] else np.mean
            joined = "-" if all(_is_number(label) for label in labels) else ""
            _curve(axis, drawn, of, {"fmt": f"o{joined}", "color": COLORS[number % len(COLORS)], "label": scene})
        axis.set_ylabel(words, fontsize=10)
        axis.set_ylim(bottom=0)
    bottom = axes[-1][0]
    bottom.set_xticks(range(len(labels)), labels)
    if sum(map(len, labels)) > 36:
        bottom.tick_params(axis="x", labelrotation=40)
        for label in bottom.get_xticklabels():
            label.set(ha="right", rotation_mode="anchor")
    axes[0][0].set_title(knob.replace("_", " "))
    figure.legend(*axes[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    return figure


def curve_of(points: Sequence[MeasuredPoint], knob: str) -> list[tuple[str, MeasuredPoint]]:
    """One scene's points of a knob with what to write below them, in the order of their values; the usual one too,
    where the knob alone is what they differ from it by."""
    turned = [point for point in points if point.knob == knob]
    usual = next((point for point in points if not point.settings), None)
    varying = _varying(turned)
    if len(varying) != 1 or not all(varying[0] in point.settings for point in turned):
        labelled = [(_words(point), point) for point in turned]
        return [("usual", usual), *labelled] if usual is not None else labelled
    key = varying[0]
    chosen = [(point.settings[key], point) for point in turned]
    is_alone = all(set(point.settings) == {key} for point in turned)
    if usual is not None and is_alone and usual_value(key) not in [value for value, _ in chosen]:
        chosen.append((usual_value(key), usual))
    return [(_shown(key, value), point) for value, point in sorted(chosen, key=lambda item: _rank(key, item[0]))]


def usual_value(key: str) -> Any:
    """Of a wish that nobody made; None where only the scene tells."""
    wishes = Wishes()
    return getattr(sampling_of(wishes), _OF_SAMPLING[key]) if key in _OF_SAMPLING else getattr(wishes, key, None)


def _varying(points: Sequence[MeasuredPoint]) -> list[str]:
    """Settings that are not the same in all; of one point alone, all of them."""
    keys = dict.fromkeys(key for point in points for key in point.settings)
    if len(points) == 1:
        return list(keys)
    return [key for key in keys if len({repr(point.settings.get(key)) for point in points}) > 1]


def _rank(key: str, value: Any) -> tuple[int, float, str]:
    """Numbers by size, then words; what is usual without a number is first, rays through the room last."""
    if value is None:
        return (2, 0.0, "") if key in _SAME_AS_NONE else (-1, 0.0, "")
    if key == "preset":
        return (1, float(list(PRESETS).index(value)), "")
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return (0, float(value), "") if is_number else (1, 0.0, str(value))


def _shown(key: str, value: Any) -> str:
    if value is None:
        return _SAME_AS_NONE.get(key, "usual")
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _words(point: MeasuredPoint) -> str:
    return " ".join(_shown(key, value) for key, value in point.settings.items())


def _curve(axis: Any, drawn: Sequence[tuple[float, Sequence[float]]], of: Any, look: dict[str, Any]) -> None:
    if not drawn:
        return
    middle = np.array([of(values) for _, values in drawn])
    bars = np.array([interval(values, of=of) for _, values in drawn])
    around = np.abs(bars.T - middle)
    axis.errorbar([place for place, _ in drawn], middle, around, lw=1.6, ms=4.5, elinewidth=1, capsize=2.5, **look)


def _is_number(label: str) -> bool:
    """Whether a value is one, or what stands for one."""
    return label in _SAME_AS_NONE.values() or label.replace(".", "", 1).isdigit()


def _label_presets(axis: Any, points: Sequence[MeasuredPoint], cores: int, error: Callable[[Any], float]) -> None:
    named = [(NAMED[str(preset_of(p))], p) for p in points if preset_of(p) in NAMED]
    if not points:
        return
    highest = max(error(point) for point in points)
    times = [paced_ms(point, cores) for point in points]
    axis.set_ylim(0, 1.22 * max(highest, 1e-6))
    axis.set_xlim(min(times) / 1.25, max(times) * 2.2)
    places = spread_labels([error(point) + 0.06 * highest for _, point in named], 0.075 * highest)
    for (name, point), place in zip(named, places, strict=True):
        x, y = paced_ms(point, cores), error(point)
        arrow = {"arrowstyle": "-", "color": INK, "lw": 0.7, "shrinkA": 0, "shrinkB": 4}
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.5}
        axis.annotate(name, (x, y), (x * 1.08, place), fontsize=10, va="center", arrowprops=arrow, bbox=box, zorder=4)


def _plain_ticks(axis: Any) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

    axis.xaxis.set_major_locator(LogLocator(base=10, subs=(1, 2, 5)))
    axis.xaxis.set_major_formatter(ScalarFormatter())
    axis.xaxis.set_minor_formatter(NullFormatter())


def _time_words(cores: int) -> str:
    return f"ms a frame, processor time over {cores} cores" if cores else "ms a frame, median"


__all__ = ["curve_of", "describe", "front_figure", "front_svg", "knob_figure", "knobs_of", "preset_of", "wall_ms"]
