"""The thesis's figures in the report: which part each is of, how it is drawn, what is said below it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from tests.bench.accuracy import thesis as names
from tests.bench.thesis import figures as thesis_figures
from tests.bench.thesis import pictures as thesis_pictures


@dataclass(frozen=True)
class Figure:
    """One of the thesis's: which part it is of, how it is drawn, what to say."""

    number: str
    part: str
    draw: Callable[[Mapping[str, Any], Path, Path], None]
    caption: str


def _with_clock(draw: Callable[..., None], details: Mapping[str, Any], path: Path, _folder: Path) -> None:
    draw(details, path, is_gpu=bool(details.get("is_gpu")))


def _without_folder(draw: Callable[..., None], details: Mapping[str, Any], path: Path, _folder: Path) -> None:
    draw(details, path)


THESIS_FIGURES = (
    Figure(
        "5.5",
        names.ROBUST,
        thesis_pictures.draw_sets,
        "A grey and a coloured stage set under four lights with a virtual ball: the truth; plain least squares; with "
        "the thesis's measures against bad samples; ours. Below each picture the light as an environment map, white "
        "where it is brightest: the green ring is the true direction, the white one what was found.",
    ),
    Figure("5.6", names.ROBUST, thesis_pictures.draw_robust, "The light that misleads plain least squares most."),
    Figure(
        "5.7",
        names.REACH,
        thesis_pictures.draw_reach,
        "Longer visibility rays: the thesis goes from 0 to 0.2 m and sees the light improve.",
    ),
    Figure(
        "6.5",
        names.PRESETS,
        partial(_with_clock, thesis_figures.draw_speed),
        "Frames/s by preset and over the frames; on the right transfer and estimation alone, beside the thesis's.",
    ),
    Figure("6.6", names.PRESETS, partial(_with_clock, thesis_figures.draw_maps), "Error of the environment maps."),
    Figure(
        "6.7",
        names.PRESETS,
        partial(_with_clock, thesis_figures.draw_quality),
        "Pictures against RM's, over what the virtual thing changes. The best method is at the upper right, but for "
        "differences at the lower right. The thesis predicts quality by HDR-VDP-2, here it is FLIP.",
    ),
    Figure(
        "6.8",
        names.PRESETS,
        thesis_figures.draw_close_ups,
        "Close-ups of the last frames, and where they would look otherwise than RM's.",
    ),
    Figure(
        "6.11",
        names.PROBE,
        partial(_without_folder, thesis_pictures.draw_probe),
        "Dominant directions against a passive light probe (LP): medians on the panoramas of the lights, and angles by "
        "scene, over lights and frames.",
    ),
    Figure(
        "7.11",
        names.FAMILIES,
        thesis_pictures.draw_families,
        "Volume rays, accelerated ones, image space and its fast variant, under the light that each estimates.",
    ),
)
