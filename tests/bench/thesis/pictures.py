"""The thesis's figures that show pictures, drawn from what the parts kept: 5.5, 5.6, 5.7, 6.11 and 7.11."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from server.maths.sh import dominant_direction
from server.shading.composite import srgb_codes
from tests.bench.light.environment import lat_long_directions, radiance_from
from tests.bench.report.plotting import COLORS, INK, bare, panels, save, show
from tests.bench.thesis.families import ROWS
from tests.bench.thesis.light import MEASURES, NAIVE, OURS, SETS, WAYS, WHOLE
from tests.bench.thesis.numbers import FAMILIES, RAY_LENGTHS_M, THESIS_NAME
from tests.bench.thesis.probe import LP, PRESETS
from tests.bench.thesis.runs import load_picture

Details = Mapping[str, Any]
Floats = NDArray[np.float64]

MAP_ROWS = 64
"""Of an environment map: y is up, +z, where the first cameras stand, in the middle."""
WORLD_FROM_MAP = np.diag([-1.0, 1.0, -1.0])
PROBE_COLORS = {"rm": COLORS[6], "gr15": COLORS[0], "gr15fast": COLORS[5], LP: "#ffd400"}
TRUE_COLOR = "#35c435"
SHOWN_FLIP = 0.5


def environment(axis: Any, light: Floats, true: Floats, *, marked: bool = True) -> None:
    """Lat-long map of a light, white where it is brightest; the true direction a green ring, its own a white one."""
    directions = lat_long_directions(MAP_ROWS, WORLD_FROM_MAP)
    radiance = np.maximum(radiance_from(light, directions), 0)
    shown = srgb_codes(radiance / max(float(radiance.max()), 1e-9))
    axis.imshow(shown, interpolation="bilinear", extent=(-180, 180, -90, 90))
    bare(axis)
    if marked:
        mark(axis, dominant_direction(true), TRUE_COLOR)
    if marked and not np.array_equal(light, true):
        mark(axis, dominant_direction(light), "white")


def mark(axis: Any, direction: Floats, color: str, size: float = 8, *, filled: bool = False) -> None:
    """A ring, or a dot, on a lat-long map at unit `direction` [3]; nothing where it is zero."""
    if not np.any(direction):
        return
    azimuth, elevation = on_map(np.asarray(direction, np.float64))
    if filled:
        axis.plot(azimuth, elevation, "o", ms=size, mfc=color, mec=INK, mew=0.8)
        return
    for edge, width in ((INK, 3.2), (color, 1.8)):
        axis.plot(azimuth, elevation, "o", ms=size, mfc="none", mec=edge, mew=width)


def on_map(direction: Floats) -> tuple[float, float]:
    """Degrees right of the middle and above the horizon of a lat-long map."""
    x, y, z = np.linalg.inv(WORLD_FROM_MAP) @ direction
    return float(np.degrees(np.arctan2(x, -z))), float(np.degrees(np.arcsin(np.clip(y, -1, 1))))


def draw_sets(details: Details, path: Path, folder: Path) -> None:
    """Fig. 5.5: both sets under four lights: composite and environment map of each way, and its error."""
    lines = ("true", *WAYS)
    count = len(next(iter(details.values()))["cells"])
    sizes = [1.5, 1.0] * len(lines)
    figure, axes = panels(2 * len(lines), 2 * count, 15, 11.4, height_ratios=sizes)
    for block, name in enumerate(SETS):
        for column, cell in enumerate(details[name]["cells"]):
            true = np.array(cell["true"]["light"])
            for line, way in enumerate(lines):
                above, below = (axes[2 * line + k][block * count + column] for k in (0, 1))
                title = f"{name}: {SETS[name]}, light {column + 1}" if line == 0 else ""
                show(above, load_picture(folder, cell[way]["picture"]), title)
                environment(below, np.array(cell[way]["light"]), true)
                if way != "true":
                    below.set_title(f"{cell[way]['direction_deg']:.1f}\N{DEGREE SIGN}", fontsize=10)
                if block == column == 0:
                    above.set_ylabel(way, fontsize=11)
    save(figure, path)


def draw_robust(details: Details, path: Path, folder: Path) -> None:
    """Fig. 5.6: the set of many colours under the light that misleads the naive way most, larger."""
    cells = details["C"]["cells"]
    cell = cells[int(np.argmax([c[NAIVE]["direction_deg"] for c in cells]))]
    figure, axes = panels(2, 4, 14, 5.0, height_ratios=(1.5, 1))
    true = np.array(cell["true"]["light"])
    for column, way in enumerate((NAIVE, MEASURES, OURS, "true")):
        error = "" if way == "true" else f", {cell[way]['direction_deg']:.1f}\N{DEGREE SIGN} off"
        show(axes[0][column], load_picture(folder, cell[way]["picture"]), f"{way}{error}")
        environment(axes[1][column], np.array(cell[way]["light"]), true)
    save(figure, path)


def draw_reach(details: Details, path: Path, folder: Path) -> None:
    """Fig. 5.7: composites and maps by the rays' length, and the angle under each light."""
    names = [*(f"{reach:g} m" for reach in RAY_LENGTHS_M), WHOLE]
    figure = _blank(15, 6.8)
    upper, lower = figure.subfigures(2, 1, height_ratios=(1.4, 1))
    axes = upper.subplots(2, len(names) + 1, height_ratios=(1.5, 1))
    true = np.array(details["true"]["light"])
    for column, name in enumerate([*names, "true"]):
        cell = details["true"] if name == "true" else details["cells"][name]
        error = "" if name == "true" else f", {cell['direction_deg']:.1f}\N{DEGREE SIGN} off"
        words = {"true": "true", WHOLE: "through the room"}.get(name, f"rays of {name}")
        show(axes[0][column], load_picture(folder, cell["picture"]), f"{words}{error}")
        environment(axes[1][column], np.array(cell["light"]), true)
    axis = lower.subplots()
    errors = np.array([details["errors"][name] for name in names])
    for light, color in zip(errors.T, COLORS, strict=False):
        axis.plot(names, light, "o", color=color, alpha=0.6)
    axis.plot(names, errors.mean(axis=1), "-", color=INK, lw=2, label="mean of the lights")
    axis.set(title="angle to the true light, four lights", ylabel="degrees", ylim=(0, None))
    axis.legend()
    save(figure, path)


def draw_probe(details: Details, path: Path) -> None:
    """Fig. 6.11: each light's panorama with the median directions, and the angles to LP by scene."""
    cells = details["cells"]
    lights, places = (list(dict.fromkeys(cell[key] for cell in cells)) for key in ("light", "place"))
    figure = _blank(14, 7)
    upper, lower = figure.subfigures(2, 1, height_ratios=(1, 1.6))
    for column, (axis, light) in enumerate(zip(upper.subplots(1, len(lights)), lights, strict=True)):
        of_light = [cell for cell in cells if cell["light"] == light]
        true = np.array(of_light[0]["true"])
        environment(axis, true, true, marked=False)
        mark(axis, dominant_direction(true), TRUE_COLOR, 13)
        for name in (LP, *PRESETS):
            found = [d for cell in of_light for d in cell["directions"][name]]
            mark(axis, _middle(np.array(found)), PROBE_COLORS[name], 7, filled=True)
        axis.set_title(f"light {column + 1}", fontsize=11)
    labels = {LP: "LP", **{p: THESIS_NAME[p] for p in PRESETS}}
    for name, label in labels.items():
        axis.plot([], [], "o", mfc=PROBE_COLORS[name], mec=INK, label=label)
    axis.plot([], [], "o", mfc="none", mec=TRUE_COLOR, mew=1.8, ms=11, label="true")
    upper.legend(loc="lower center", ncols=5)
    axes = lower.subplots(1, len(PRESETS), sharey=True)
    for axis, preset in zip(axes, PRESETS, strict=True):
        angles = [[a for c in cells if c["place"] == place for a in c["to_lp"][preset]] for place in places]
        axis.boxplot(angles, showmeans=True, meanline=True, medianprops={"color": INK}, meanprops={"color": "#d02020"})
        axis.set_xticks(range(1, len(places) + 1), [place.partition(" ")[2].replace(", ", ",\n") for place in places])
        axis.tick_params(axis="x", labelsize=9)
        axis.set_title(f"{THESIS_NAME[preset]}: angle to LP (red: mean)")
    axes[0].set(ylabel="degrees", ylim=(0, None))
    save(figure, path)


def draw_families(details: Details, path: Path, folder: Path) -> None:
    """Fig. 7.11: each family's close-up beside the truth, with its FLIP map, by the length of rays."""
    rows = [row for row in ROWS if row in details]
    figure, axes = panels(2 * len(rows), 1 + len(FAMILIES), 15, 5.4 * len(rows))
    for block, row in enumerate(rows):
        show(axes[2 * block][0], load_picture(folder, details["true"]), "truth")
        axes[2 * block][0].set_ylabel(row, fontsize=10)
        bare(axes[2 * block + 1][0])
        axes[2 * block + 1][0].text(0.5, 0.5, f"FLIP against the truth,\nwhite at {SHOWN_FLIP:g}", ha="center")
        for column, preset in enumerate(FAMILIES, 1):
            cell = details[row][preset]
            show(axes[2 * block][column], load_picture(folder, cell["picture"]), THESIS_NAME[preset])
            if "flip" in cell:
                errors = load_picture(folder, cell["flip"]) / 255
                show(axes[2 * block + 1][column], errors, cmap="magma", vmin=0, vmax=SHOWN_FLIP)
            bare(axes[2 * block + 1][column])
    save(figure, path)


def _middle(directions: Floats) -> Floats:
    """The one of [n, 3] that is nearest to all, by summed angle: their median on the sphere."""
    angles = np.arccos(np.clip(directions @ directions.T, -1, 1))
    chosen: Floats = directions[int(angles.sum(axis=1).argmin())]
    return chosen


def _blank(width: float, height: float) -> Any:
    figure, axes = panels(1, 1, width, height)
    axes[0][0].remove()
    return figure
