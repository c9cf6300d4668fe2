"""B9's picture: each basis's error against the time of its kernels, a panel a measure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

COLORS = {"SH": "#1f4e9c", "SG": "#d1662b", "Haar": "#2b8a4b", "Haar, largest": "#8a5fb0"}
TITLES = {
    "direction_deg": "dominant direction, degrees",
    "irradiance": "irradiance, relative RMSE",
    "msad": "environment map, relative MSAD",
    "shading": "virtual ball, relative RMSE",
    "near": "floor under the ball, relative RMSE",
}
ROWS = {
    "known": "light known",
    "estimated": "light estimated",
    "estimated, not negative": "light estimated, not negative",
    "estimated, best weight of the prior": "estimated, best weight of the prior",
}


def draw_bases(points: Sequence[dict[str, Any]], path: Path) -> None:
    """PNG of B9's points (tests.bench.bases.comparison), means over scenes; bars: standard errors over lights.

    Bases of as many coefficients are drawn at one time, the median of theirs: the kernels and their sizes are the same.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    sizes = {p["coefficients"] for p in points}
    times = {size: float(np.median([p["ms_ratio"] for p in points if p["coefficients"] == size])) for size in sizes}
    figure, panels = plt.subplots(len(ROWS), len(TITLES), figsize=(17, 13), squeeze=False, sharex=True)
    for line, (variant, label) in zip(panels, ROWS.items(), strict=True):
        for panel, (key, title) in zip(line, TITLES.items(), strict=True):
            for name, color in COLORS.items():
                of_basis = [p for p in points if p["variant"] == variant and _family(p) == name]
                _draw_basis(panel, of_basis, key, color, times)
            panel.set_title(f"{label}:\n{title}", fontsize=9)
            panel.set_ylim(bottom=0)
            panel.grid(color="0.9")
    for panel in panels[-1]:
        panel.set_xlabel("time of transfer and sums, SH 16 = 1", fontsize=9)
    handles = [plt.Line2D([], [], color=color, marker="o", label=name) for name, color in COLORS.items()]
    handles.append(plt.Line2D([], [], color=COLORS["Haar"], marker="s", mfc="white", label="cells, no wavelets"))
    figure.legend(handles=handles, loc="upper center", ncols=len(handles), frameon=False)
    figure.suptitle("B9: error against time, numbers of coefficients beside the marks", y=0.965, fontsize=10)
    figure.tight_layout(rect=(0, 0, 1, 0.965))
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _family(point: dict[str, Any]) -> str:
    """Cells stand for the wavelets that do not exist with their number."""
    return "Haar" if point["basis"] == "cells" else str(point["basis"])


def _draw_basis(panel: Any, points: list[dict[str, Any]], key: str, color: str, times: Mapping[int, float]) -> None:
    sizes = sorted({p["coefficients"] for p in points})
    groups = [[p for p in points if p["coefficients"] == size] for size in sizes]
    if not groups:
        return
    time = [times[size] for size in sizes]
    error = [float(np.mean([p[key] for p in group])) for group in groups]
    spread = [float(np.mean([p[f"{key}_error"] for p in group]) / np.sqrt(len(group))) for group in groups]
    panel.errorbar(time, error, spread, color=color, lw=1.2, elinewidth=0.6, capsize=2)
    for x, y, size, group in zip(time, error, sizes, groups, strict=True):
        is_cells = group[0]["basis"] == "cells"
        panel.plot(x, y, "s" if is_cells else "o", color=color, mfc="white" if is_cells else color, ms=5)
        panel.annotate(str(size), (x, y), textcoords="offset points", xytext=(4, 3), fontsize=7, color=color)
