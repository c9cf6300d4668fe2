"""How plots of the benchmarks look: light, with large enough letters for a phone, drawn without a display."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

INK, GRID = "#222222", "#dddddd"
COLORS = ("#1f4e9c", "#d1662b", "#2b8a4b", "#8a5fb0", "#b8860b", "#0f8b8d", "#c2385a", "#6b6b6b")
PRESET_COLORS = dict(zip(("rm", "reg4", "reg8", "art1", "art4", "art8", "gr15", "gr15fast"), COLORS, strict=True))
STYLE = {
    "font.size": 11,
    "axes.edgecolor": INK,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": GRID,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "svg.fonttype": "none",
    "figure.facecolor": "white",
}
_DPI = 130


def panels(rows: int, columns: int, width: float, height: float, **options: Any) -> tuple[Any, Any]:
    """A figure of `width` by `height` inches and its axes [rows, columns]."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    mpl.rcParams.update(STYLE)
    return plt.subplots(rows, columns, figsize=(width, height), squeeze=False, layout="constrained", **options)


def save(figure: Any, path: Path) -> Path:
    """Write PNG, and let the figure go. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=_DPI)
    _close(figure)
    return path


def as_svg(figure: Any) -> str:
    """The `svg` element without what stands before it, and let the figure go."""
    stream = BytesIO()
    figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    _close(figure)
    text = stream.getvalue().decode()
    return text[text.index("<svg") :]


def show(axis: Any, picture: NDArray[Any], title: str = "", **options: Any) -> None:
    """A picture without axes."""
    axis.imshow(picture, interpolation="nearest", **options)
    bare(axis)
    if title:
        axis.set_title(title, fontsize=10, fontweight="normal")


def bare(axis: Any) -> None:
    """No ticks, no frame, no grid."""
    axis.set_xticks([])
    axis.set_yticks([])
    axis.grid(visible=False)
    for spine in axis.spines.values():
        spine.set_visible(False)


def spread_labels(values: Sequence[float], least: float) -> NDArray[np.float64]:
    """Places near `values`, in their order, `least` apart: labels beside marks that lie close together."""
    order = np.argsort(values, kind="stable")
    places = np.array(values, np.float64)[order]
    for _ in range(200):
        gaps = np.diff(places)
        tight = np.flatnonzero(gaps < least - 1e-9)
        if not len(tight):
            break
        for gap in tight:
            push = (least - (places[gap + 1] - places[gap])) / 2
            places[gap] -= push
            places[gap + 1] += push
    found = np.empty_like(places)
    found[order] = places
    return found


def _close(figure: Any) -> None:
    from matplotlib import pyplot as plt

    plt.close(figure)
