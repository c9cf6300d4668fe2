"""Lights from real photographs: the photometric-stereo set's ball and statue, and the bust in a room."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tests.bench.report.finished import Part
from tests.bench.report.run import Run, data_folder
from tests.bench.truth.photometric_set import (
    FoundLight,
    PhotometricSet,
    angles_deg,
    ball_samples,
    find_ball_lights,
    find_statue_lights,
    judge_sums,
    read_photometric_set,
    statue_samples,
)
from tests.bench.truth.socrates import (
    BustView,
    find_effects,
    fit_light,
    plain_fit,
    read_views,
    without_effects,
)

BALL_GOAL_DEG = 5.0
STATUE_GOAL_DEG = 8.0
SUM_GOAL_PERCENT = 5.0
VIEWS_GOAL_DEG = 10.0
_CORRECTED = "exposures and the camera's side fitted"

Floats = NDArray[np.float64]


def photographs_part(run: Run) -> Part:
    """`light_uw_photometric`: 12 known lights, and sums of them."""
    photographs = read_photometric_set(data_folder("light_uw_photometric"))
    part = Part(sizes={"known lights": len(photographs.lights)})
    run.say("grey ball ...")
    _direction_rows(part, "grey ball", find_ball_lights(photographs), photographs, BALL_GOAL_DEG)
    run.say("statue ...")
    _direction_rows(part, "statue", find_statue_lights(photographs), photographs, STATUE_GOAL_DEG)
    apart = np.degrees(np.arccos(np.clip(np.sum(photographs.lights * photographs.mirror_lights, axis=1), -1, 1)))
    part.add("known lights: labels to the mirror ball's highlights, mean", float(apart.mean()), "deg")
    run.say("sums of lights ...")
    ball = ball_samples(photographs)
    statue, good = statue_samples(photographs, list(range(len(photographs.lights))))
    for name, samples, pictures in (
        ("grey ball", ball, photographs.ball),
        ("statue", statue, photographs.statue[:, good]),
    ):
        for terms, words in ((2, "two"), (3, "three")):
            sums = judge_sums(samples, pictures, terms)
            error = 100 * np.abs(sums.shares - 1)
            goal, head = f"<= {SUM_GOAL_PERCENT:g}", f"{name}: sum of {words} lights"
            part.add(f"{head}, error of a term's share, largest", float(error.max()), "%", goal)
            part.add(f"{head}, error of a term's share, median", float(np.median(error)), "%")
            within = 100 * np.mean(error.max(axis=1) <= SUM_GOAL_PERCENT)
            part.add(f"{head}, sums with no share off by more", float(within), "%")
            part.add(f"{head}, light off from that of its terms, largest", float(100 * sums.rests.max()), "%", goal)
    return part


def socrates_part(run: Run) -> Part:
    """`rgbd_socrates_natural_light`: how much of the shading one light explains, and whether views agree."""
    views = read_views(data_folder("rgbd_socrates_natural_light"), run.device)
    part = Part(sizes={"views of the bust": len(views), "samples of the bust": sum(len(v.luminance) for v in views)})
    plain = plain_fit(views)
    part.add("bust: R2 of 9 coefficients, least squares, no visibility", plain, "")
    part.add("bust: R2 of one light from all views", fit_light(views).explained, "", f">= {plain:.4f}")
    effects = find_effects(views)
    corrected = without_effects(views, effects)
    part.add(f"bust: R2 of one light from all views, {_CORRECTED}", fit_light(corrected).explained, "")
    part.add("bust: R2 of 9 coefficients, likewise", plain_fit(corrected), "")
    _agreement_rows(part, views, "", "")
    _agreement_rows(part, corrected, f", {_CORRECTED}", f"<= {VIEWS_GOAL_DEG:g}")
    part.details["exposures of the bust's views"] = effects.exposures.tolist()
    part.details["luminance that what faces the camera lacks, of the mean"] = effects.hidden / float(
        np.mean(np.concatenate([view.luminance for view in corrected]))
    )
    return part


def _agreement_rows(part: Part, views: list[BustView], words: str, goal: str) -> None:
    """How far the lights of single views are from that of all."""
    whole, singles = fit_light(views), [fit_light([view]) for view in views]
    strongest = _degrees(np.array([single.direction @ whole.direction for single in singles]))
    linear = _degrees(np.array([single.linear_direction @ whole.linear_direction for single in singles]))
    part.add(f"bust: strongest light of each view to that of all views{words}, largest", strongest.max(), "deg", goal)
    part.add(f"bust: strongest light of each view to that of all views{words}, mean", strongest.mean(), "deg")
    part.add(f"bust: l = 1 direction of each view to that of all views{words}, largest", linear.max(), "deg")


def _direction_rows(
    part: Part, name: str, found: list[FoundLight], photographs: PhotometricSet, goal_deg: float
) -> None:
    errors = angles_deg(found, photographs.lights)
    part.add(f"{name}: direction to the labelled light, mean", float(errors.mean()), "deg", f"<= {goal_deg:g}")
    part.add(f"{name}: direction to the labelled light, largest", float(errors.max()), "deg")
    mirror = angles_deg(found, photographs.mirror_lights)
    part.add(f"{name}: direction to the mirror ball's highlight, mean", float(mirror.mean()), "deg")
    linear = _degrees(np.array([f.mean_direction @ light for f, light in zip(found, photographs.lights, strict=True)]))
    part.add(f"{name}: l = 1 direction of the whole light to the label, mean", float(linear.mean()), "deg")
    part.add(
        f"{name}: pictures in which another light than the one is found", sum(len(f.lights) != 1 for f in found), ""
    )


def _degrees(cosines: Floats) -> Floats:
    return np.degrees(np.arccos(np.clip(cosines, -1, 1)))
