"""Light from lobes (the default estimator): surfaces of unknown albedo, outliers, changes, nothing to see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from server.light.light_estimation import ASSUMED_ALBEDO
from server.light.light_model import LightModel
from server.light.lobe_estimator import LobeEstimator
from server.maths.lobes import cells_to_sh
from server.maths.sh import LUMINANCE
from tests.hard_cases.catalogue import Family, Found, Trial
from tests.scenes.light_pools import CONSTANT, GRID, Run, View, direction, halves, sun
from tests.scenes.lights import unit

Floats = NDArray[np.float64]

LOBES = Family("light by lobes", checkable=False)
UP = np.array([[0.0, -1.0, 0.0]])
_WALLS = {
    "one plane": UP,
    "two planes": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]),
}


def _direction(estimate_sh: Floats) -> Floats:
    """[3] unit, of the luminance."""
    return unit(direction(estimate_sh))


def _true(light: Floats) -> Floats:
    return _direction(cells_to_sh(4) @ light)


@LOBES.case(
    "normals all around",
    np.deg2rad(0.2),
    "rad",
    "1 % noise on 2000 pools fixes a direction to 0.1 degrees; what lobes cannot follow of it is as much again.",
    known=True,
)
def all_around(trial: Trial) -> Found:
    view, light = View.of(), sun()
    estimate = Run(trial.engine, 4).add(view, view.under(light))
    return Found(_direction(estimate.sh), _true(light), known=estimate.valid)


for _name, _normals in _WALLS.items():
    for _kind, _model in (("", LightModel()), (", one albedo", CONSTANT)):

        @LOBES.case(
            _name + _kind,
            0.05,
            "of the mean radiance",
            "the light explains what the walls show to 1 % noise, and its ridge and the held mean take a few percent.",
            known=False,
        )
        def few_normals(trial: Trial, normals: Floats = _normals, model: LightModel = _model) -> Found:
            view, light = View.of(normals), sun()
            pools = view.under(light)
            run = Run(trial.engine, 4, model)
            estimate = run.add(view, pools)
            assert run.light is not None
            shown = view.transfer @ run.light.cells / ASSUMED_ALBEDO
            groups = [(view.normals == normal).all(1) for normal in normals]
            found = np.array([shown[g].mean() for g in groups])
            truth = np.array([(view.transfer @ light @ LUMINANCE)[g].mean() for g in groups])
            return Found(found / truth.mean(), truth / truth.mean(), known=estimate.valid)


@LOBES.case(
    "no visible sky",
    0,
    "radiance",
    "a light that reaches no surface explains nothing, so it is none, and no deviation is said of it: exactly zero.",
    known=False,
)
def no_sky(trial: Trial) -> Found:
    view = View.of()
    view.transfer[:] = 0.0
    view.sent[:] = 0.5
    estimate = Run(trial.engine, 4).add(view, view.under(sun()))
    return Found(estimate.sh, 0, known=estimate.valid or estimate.std is not None)


for _dark, _bright in ((0.05, 0.8), (0.3, 0.6)):

    @LOBES.case(
        f"half of albedo {_dark}, half of {_bright}",
        np.deg2rad(0.5),
        "rad",
        "materials told apart by lightness leave the noise's 0.1 degrees and as much again of pools that are "
        "taken for the other.",
        known=True,
    )
    def black_and_white(trial: Trial, dark: float = _dark, bright: float = _bright) -> Found:
        light, (view, _) = sun(), halves(0, 0.65, dark, bright)
        estimate = Run(trial.engine, 4).add(view, view.under(light))
        return Found(_direction(estimate.sh), _true(light), known=estimate.valid)


@LOBES.case(
    "30 % outliers",
    np.deg2rad(0.5),
    "rad",
    "outliers of weight 1 / (1 + (r / 2 sigma)^2) with r of 20 sigma and more keep 1 % of theirs: 0.3 % of the light.",
    known=True,
)
def outliers(trial: Trial) -> Found:
    view, light = View.of(), sun()
    pools = view.under(light)
    random = np.random.default_rng(1)
    chosen = random.random(GRID.count) < 0.3
    pools.seen[chosen] *= random.uniform(0.0, 5.0, (int(chosen.sum()), 1))
    estimate = Run(trial.engine, 4).add(view, pools)
    return Found(_direction(estimate.sh), _true(light), known=estimate.valid)


@LOBES.case(
    "the brighter half saturated",
    np.deg2rad(0.5),
    "rad",
    "what is clipped is left out; the darker half of the normals fixes the direction to 0.3 degrees, thrice as "
    "badly as all.",
    known=True,
)
def saturated(trial: Trial) -> Found:
    view, light = View.of(), sun()
    pools = view.under(light)
    luminance = pools.seen @ LUMINANCE
    weights = np.where(luminance > np.median(luminance), 0.0, pools.weights)
    estimate = Run(trial.engine, 4).add(view, replace(pools, weights=weights))
    return Found(_direction(estimate.sh), _true(light), known=estimate.valid)


@LOBES.case(
    "a light that flickers",
    np.deg2rad(0.5),
    "rad",
    "a light that is 0.8 and 1.2 of itself in turn comes from one direction all the time.",
    known=True,
)
def flickers(trial: Trial) -> Found:
    run, light, found = Run(trial.engine, 4), sun(), []
    for k in range(trial.of(4, 20)):
        view = View.of(seed=k)
        estimate = run.add(view, view.under((0.8, 1.2)[k % 2] * light, seed=k))
        found.append(_direction(estimate.sh))
    return Found(found, np.tile(_true(light), (len(found), 1)), known=estimate.valid)


@LOBES.case(
    "a light that jumps",
    np.deg2rad(0.5),
    "rad",
    "shared surface tells the change at once, and earlier frames count for nothing after three.",
    known=True,
)
def jumps(trial: Trial) -> Found:
    before, after, run = sun(), sun((-0.8, -0.3, -0.1)), Run(trial.engine, 4)
    for k, light in enumerate([before] * trial.of(3, 12) + [after] * 3):
        view = View.of(seed=k)
        estimate = run.add(view, view.under(light, seed=k))
    return Found(_direction(estimate.sh), _true(after), known=estimate.valid)


@LOBES.case(
    "a light that goes out",
    0.02,
    "of the light before",
    "a hundredth of the light is left; earlier frames are dropped as by a jump, and albedos are told to 30 %.",
    apart=1e-3,
)
def goes_out(trial: Trial) -> Found:
    run, light = Run(trial.engine, 4), sun()
    for k, scale in enumerate([1.0] * trial.of(3, 12) + [0.01] * 3):
        view = View.of(seed=k)
        estimate = run.add(view, view.under(scale * light, seed=k))
    before = (cells_to_sh(4) @ light)[0]
    return Found(estimate.sh[0] / before, 0.01)


@LOBES.case("nothing seen", 0, "radiance", "no estimate is made of nothing: exactly zero.", known=False)
def nothing(trial: Trial) -> Found:
    estimate = LobeEstimator(trial.engine, 4).estimate()
    return Found(estimate.sh, 0, known=estimate.valid or estimate.std is not None)


@LOBES.case(
    "a sun 8 degrees wide, in cells",
    1e-12,
    "of the mean radiance",
    "cells are sums of non-negative lobes with non-negative amounts: no cell is below zero.",
)
def sun_in_cells(trial: Trial) -> Found:
    view = View.of(hidden=True)
    run = Run(trial.engine, 4)
    run.add(view, view.under(sun(width_deg=8.0)))
    assert run.light is not None
    return Found(np.minimum(run.light.cells, 0) / run.light.cells.mean(), 0)
