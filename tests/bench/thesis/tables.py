"""The thesis's tables 6.1, 6.2 and 6.3 in its own layout, its figures beside ours."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tests.bench.thesis.numbers import (
    DOTS,
    FAMILIES,
    MACHINES,
    MOVING,
    PRESETS,
    ROWS,
    STATIC,
    TABLE_6_2,
    TABLE_6_3,
    THESIS_NAME,
)
from tests.bench.thesis.speed import AS_THESIS, USUAL

Details = Mapping[str, Any]
OURS = "ours"
PACED = " A frame cannot take less than its processor time over the cores, and takes more where other programs run."


@dataclass(frozen=True)
class Table:
    """Texts, some of them ours."""

    title: str
    note: str
    heads: tuple[tuple[tuple[str, int], ...], ...]
    """Lines of (text, columns it stands over)."""
    rows: tuple[tuple[str, ...], ...]
    is_ours: tuple[bool, ...]
    """Of each column, or of each row where `by_row`."""
    by_row: bool = False

    def as_html(self) -> str:
        """A `table` element; what is ours has the class `ours`."""
        heads = "".join(f"<tr>{''.join(_head(*cell) for cell in line)}</tr>" for line in self.heads)
        rows = "".join(self._row(number, row) for number, row in enumerate(self.rows))
        return (
            f"<h3>{html.escape(self.title)}</h3><div class='wide'><table><thead>{heads}</thead>"
            f"<tbody>{rows}</tbody></table></div><p class='note'>{html.escape(self.note)}</p>"
        )

    def _row(self, number: int, row: Sequence[str]) -> str:
        cells = []
        for column, text in enumerate(row):
            is_ours = self.is_ours[number if self.by_row else column]
            cells.append(f"<td{' class=' + OURS if is_ours else ''}>{html.escape(text)}</td>")
        return f"<tr>{''.join(cells)}</tr>"


def _head(text: str, columns: int) -> str:
    return f"<th colspan={columns}>{html.escape(text)}</th>"


def table_6_1(details: Details) -> Table:
    """Dot products of dominant directions. details: of thesis_presets."""
    rows: list[tuple[str, ...]] = []
    for path in (STATIC, MOVING):
        dots = {preset: np.array(details[path]["presets"][preset]["dots"]) for preset in PRESETS}
        angles = {preset: np.degrees(np.arccos(np.clip(values, -1, 1))).mean() for preset, values in dots.items()}
        rows += [
            (f"{path}: Avg, thesis", *(f"{DOTS[path][p][0]:.4f}" for p in PRESETS)),
            ("Avg, here", *(f"{dots[p].mean():.4f}" for p in PRESETS)),
            ("Std, thesis", *(f"{DOTS[path][p][1]:.4f}" for p in PRESETS)),
            ("Std, here", *(f"{dots[p].std():.4f}" for p in PRESETS)),
            ("mean angle, here", *(f"{angles[p]:.1f}\N{DEGREE SIGN}" for p in PRESETS)),
        ]
    return Table(
        "Table 6.1: dot product of the estimated and the true dominant light direction",
        "1 is no error; the thesis's means are 15 to 20 degrees. Static camera above, moving camera below.",
        ((("", 1), *((preset.upper(), 1) for preset in PRESETS)),),
        tuple(rows),
        tuple("here" in row[0] for row in rows),
        by_row=True,
    )


def table_6_2(details: Details) -> Table:
    """Rows of a whole update of four methods. details: of thesis_speed."""
    groups = [
        (THESIS_NAME[preset], [("GTX 780", TABLE_6_2[preset])], _here(details, "6.2", preset)) for preset in FAMILIES
    ]
    return _of_groups("Table 6.2: whole update at 256^3 voxels over 2 m, 640x480, ms", groups, details)


def table_6_3(details: Details) -> Table:
    """The same of two methods with less geometry. details: of thesis_speed."""
    groups = []
    for preset, machines in TABLE_6_3.items():
        theirs = [(f"{name}", column) for name, column in machines.items()]
        groups.append((THESIS_NAME[preset], theirs, _here(details, "6.3", preset)))
    title = f"Table 6.3: at 64^3 voxels without D''', ms; {', '.join(f'{k}: {v}' for k, v in MACHINES.items())}"
    return _of_groups(title, groups, details)


Column = tuple[str, Mapping[str, float]]


def _here(details: Details, number: str, preset: str) -> list[Column]:
    return [("here", details[number][AS_THESIS][preset]), ("here, usual", details[number][USUAL][preset])]


def _of_groups(title: str, groups: Sequence[tuple[str, list[Column], list[Column]]], details: Details) -> Table:
    columns = [(name, words, column) for name, theirs, ours in groups for words, column in theirs + ours]
    is_ours = (
        False,
        *(is_of_us for _, theirs, ours in groups for is_of_us in [False] * len(theirs) + [True] * len(ours)),
    )
    rows = [(label, *(_text(column.get(key)) for _, _, column in columns)) for key, label in ROWS.items()]
    note = (
        "Here: medians on this device, one object in view, 81 directions; one albedo, no indirect light and rays of "
        "0.1 m as the thesis had them; 'usual' is what the program does by itself: albedos estimated, indirect light, "
        "rays through the room."
    )
    if not details["is_gpu"]:
        cores = details["cores"]
        rows.append((f"processor time / {cores} cores", *(_text(column.get("cpu")) for _, _, column in columns)))
        note += PACED
        rows.append(("FPS by it", *(_text(1e3 / c["cpu"] if c.get("cpu") else None) for _, _, c in columns)))
    heads = (
        (("", 1), *((name, len(theirs) + len(ours)) for name, theirs, ours in groups)),
        (("", 1), *((words, 1) for _, words, _ in columns)),
    )
    return Table(title, note, heads, tuple(rows), is_ours)


def _text(value: float | None) -> str:
    if value is None:
        return "\N{EN DASH}"
    return f"{value:.1f}" if value >= 100 else f"{value:.2f}"
