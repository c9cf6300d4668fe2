"""The thesis's figures about presets, drawn from what thesis_presets measured: 6.5, 6.6, 6.7 and 6.8."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from tests.bench.report.plotting import INK, PRESET_COLORS, bare, panels, save, show, spread_labels
from tests.bench.thesis.numbers import MOVING, PRESETS, STATIC, TRANSFER_MS
from tests.bench.thesis.presets import VISIBLE
from tests.bench.thesis.runs import WARM_UP, load_picture

Details = Mapping[str, Any]

SEQUENCES = (STATIC, MOVING)


def draw_speed(details: Details, path: Path, *, is_gpu: bool) -> None:
    """Fig. 6.5: median frames/s, frames/s of every frame; and transfer + estimation beside the thesis's."""
    figure, axes = panels(1, 3, 13, 4)
    clock = _clock(is_gpu)
    bars, lines, both = axes[0]
    middle = [1e3 / _over_sequences(details, preset, clock) for preset in PRESETS]
    drawn = bars.bar(range(len(PRESETS)), middle, color=[PRESET_COLORS[p] for p in PRESETS])
    bars.bar_label(drawn, [f"{value:.1f}" for value in middle], fontsize=10)
    bars.set_xticks(range(len(PRESETS)), [p.upper() for p in PRESETS])
    bars.set(title="median, both sequences", ylabel=_speed_words(is_gpu))
    for preset in PRESETS:
        times = [t for s in SEQUENCES for t in details[s]["presets"][preset]["times"][clock][WARM_UP:]]
        lines.plot([1e3 / t for t in times], color=PRESET_COLORS[preset], lw=1.6, label=preset.upper())
    lines.set(title="over the frames: static, then moving", xlabel="frame", ylim=(0, None))
    lines.xaxis.get_major_locator().set_params(integer=True)
    lines.legend(ncols=3, fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.16))
    ours = [_over_sequences(details, p, "radiance_transfer", "light_estimation") for p in PRESETS]
    theirs = [TRANSFER_MS[p] for p in PRESETS]
    places = np.arange(len(PRESETS))
    for shift, values, label, color in ((-0.2, theirs, "thesis", "#bbbbbb"), (0.2, ours, "here", "#1f4e9c")):
        shares = [100 * value / values[0] for value in values]
        drawn = both.bar(places + shift, shares, 0.4, label=label, color=color)
        both.bar_label(drawn, [f"{value:.0f}" for value in values], fontsize=8)
    both.set_xticks(places, [p.upper() for p in PRESETS])
    both.set(title="transfer + estimation, ms", ylabel="% of RM's")
    both.legend(loc="upper right")
    save(figure, path)


def draw_maps(details: Details, path: Path, *, is_gpu: bool) -> None:
    """Fig. 6.6: environment map error, median and spread over frames; and against the picture's difference from RM."""
    del is_gpu
    figure, (left, right) = _row(panels(1, 2, 10, 4.2))
    for shift, sequence in ((-0.2, STATIC), (0.2, MOVING)):
        found = details[sequence]["presets"]
        values = np.array([median(found[p]["msad"]) for p in PRESETS])
        quartiles = np.array([np.percentile(found[p]["msad"], (25, 75)) for p in PRESETS]).T
        drawn = left.bar(
            np.arange(len(PRESETS)) + shift,
            values,
            0.4,
            yerr=np.abs(quartiles - values),
            color=[PRESET_COLORS[p] for p in PRESETS],
            alpha=1.0 if sequence == STATIC else 0.5,
            error_kw={"ecolor": INK, "lw": 1},
        )
        left.bar_label(drawn, [f"{v:.2f}" for v in values], fontsize=8, padding=1)
    left.set_xticks(range(len(PRESETS)), [p.upper() for p in PRESETS])
    left.set(title="environment map, relative MSAD", ylabel="median, quartiles")
    left.text(0.01, 0.98, "strong: static, pale: moving", transform=left.transAxes, va="top", fontsize=9)
    for sequence, marker in ((STATIC, "o"), (MOVING, "^")):
        found = details[sequence]["presets"]
        x = [median(found[p]["msad"]) for p in PRESETS]
        y = [median(found[p]["difference"]) for p in PRESETS]
        right.scatter(x, y, 60, [PRESET_COLORS[p] for p in PRESETS], marker=marker)
    right.set(title="map error against picture difference", xlabel="environment map, relative MSAD")
    right.set_ylabel("difference from RM's picture, codes")
    for preset in PRESETS:
        right.plot([], [], "s", color=PRESET_COLORS[preset], label=preset.upper())
    for words, marker in (("static", "o"), ("moving", "^")):
        right.plot([], [], marker, color="#777777", label=words)
    right.legend(fontsize=9, loc="center left", bbox_to_anchor=(1.0, 0.5))
    save(figure, path)


def draw_quality(details: Details, path: Path, *, is_gpu: bool) -> None:
    """Fig. 6.7: picture difference from RM against frames/s, as codes, in percent, as FLIP, and what can be seen."""
    clock = _clock(is_gpu)
    columns: tuple[tuple[str, str, Callable[[Details, Details], float | None]], ...] = (
        ("median absolute difference", "codes of 255", lambda found, _: median(found["difference"])),
        ("in percent of the best", "RM is 100, without the thing 0", _percent),
        ("predicted quality", "1 - FLIP", lambda found, _: _median(found["flip"], lambda v: 1 - v)),
        (f"visible: FLIP above {VISIBLE:g}", "% of the pixels", lambda found, _: _median(found["visible"], _hundred)),
    )
    figure, axes = panels(2, 4, 15, 7.4)
    for line, sequence in zip(axes, SEQUENCES, strict=True):
        of_sequence = details[sequence]
        for axis, (title, words, value) in zip(line, columns, strict=True):
            y = [value(of_sequence["presets"][p], of_sequence) for p in PRESETS]
            x = [1e3 / _medians(of_sequence, p)[clock] for p in PRESETS]
            if any(v is None for v in y):
                axis.text(0.5, 0.5, "flip_evaluator\nnot installed", transform=axis.transAxes, ha="center")
                continue
            _labelled(axis, x, [float(v) for v in y if v is not None])
            axis.set(title=f"{sequence}: {title}", xlabel=_speed_words(is_gpu), ylabel=words)
    save(figure, path)


def draw_close_ups(details: Details, path: Path, folder: Path) -> None:
    """Fig. 6.8: close-ups of each preset, below them where FLIP against RM is visible."""
    figure, axes = panels(4, len(PRESETS), 14, 8.6)
    last = None
    for block, sequence in enumerate(SEQUENCES):
        kept = details[sequence]["close_ups"]
        for column, preset in enumerate(PRESETS):
            above, below = axes[2 * block][column], axes[2 * block + 1][column]
            show(above, load_picture(folder, kept[preset]), preset.upper())
            if f"{preset} flip" in kept:
                errors = load_picture(folder, kept[f"{preset} flip"]) / 255
                below.imshow(errors, cmap="magma", vmin=0, vmax=0.3, interpolation="nearest")
                last = below.images[0]
            bare(below)
        axes[2 * block][0].set_ylabel(f"{sequence} camera")
        axes[2 * block + 1][0].set_ylabel("FLIP against RM")
    if last is not None:
        bar = figure.colorbar(last, ax=axes[:, -1], shrink=0.5, label=f"FLIP; visible above {VISIBLE:g}")
        bar.ax.axhline(VISIBLE, color="white", lw=2)
    save(figure, path)


def _labelled(axis: Any, x: list[float], y: list[float]) -> None:
    """Marks with their presets' names, moved apart where they would touch."""
    axis.scatter(x, y, 55, [PRESET_COLORS[p] for p in PRESETS], zorder=3)
    low, high = min(y), max(y)
    room = max(high - low, 1e-9)
    axis.set_ylim(low - 0.15 * room, high + 0.15 * room)
    axis.set_xlim(0, 1.35 * max(x))
    places = spread_labels(y, 0.09 * 1.3 * room)
    for preset, across, value, place in zip(PRESETS, x, y, places, strict=True):
        axis.annotate(
            preset.upper(),
            (across, value),
            (across + 0.05 * 1.35 * max(x), place),
            fontsize=9,
            va="center",
            color=PRESET_COLORS[preset],
            arrowprops={"arrowstyle": "-", "color": PRESET_COLORS[preset], "lw": 0.6, "shrinkA": 0, "shrinkB": 3},
        )


def _percent(found: Details, of_sequence: Details) -> float:
    return 100 * (1 - median(found["difference"]) / max(median(of_sequence["without"]), 1e-9))


def _median(values: list[float], shown: Callable[[float], float]) -> float | None:
    return shown(median(values)) if values else None


def _hundred(share: float) -> float:
    return 100 * share


def _clock(is_gpu: bool) -> str:
    return "total" if is_gpu else "cpu"


def _speed_words(is_gpu: bool) -> str:
    return "frames/s" if is_gpu else "frames/s by processor time"


def _medians(of_sequence: Details, preset: str) -> dict[str, float]:
    found: dict[str, float] = of_sequence["presets"][preset]["medians"]
    return found


def _over_sequences(details: Details, preset: str, *rows: str) -> float:
    return float(np.mean([sum(_medians(details[s], preset)[row] for row in rows) for s in SEQUENCES]))


def _row(drawn: tuple[Any, Any]) -> tuple[Any, Any]:
    figure, axes = drawn
    return figure, axes[0]
