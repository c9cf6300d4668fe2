"""Light from normal equations (GR12, thesis 5.1.3): what few normals, no sky and no light leave of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from server.light.light_estimation import LightEstimator
from server.maths.bayes import NormalEquations, solve_plain, solve_with_evidence
from server.maths.sh import LUMINANCE
from tests.hard_cases.cases.seen import COUNT, FLOAT, LIGHT, SEEN, around, shading, sums, walls
from tests.hard_cases.catalogue import Family, Found, Trial
from tests.reference.sh import open_transfer
from tests.scenes.lights import lobe_and_sky, uniform, unit

Floats = NDArray[np.float64]

LIGHT_SUMS = Family("light by normal equations")
SCALE = float(np.abs(LIGHT).max())
NOISE = 0.01
_UP, _SIDE, _FRONT = (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
_FEW_NORMALS = (
    "noise of 0.01 over 3072 samples leaves 4 standard deviations of 0.0015 of what the walls show, "
    "doubled for pooling."
)


@LIGHT_SUMS.case(
    "normals all around",
    2 * 66 * FLOAT * 16 * 4,
    "of the largest coefficient",
    "sums of 64 products of three float32 round 66 times 2^-24, times the normal matrix's condition of 16 and 4 "
    "for its "
    "four columns, doubled for the inputs' own rounding.",
    known=True,
)
def normals_all_around(trial: Trial) -> Found:
    estimate = LightEstimator(4).update(sums(trial.engine, around()))
    return Found(estimate.sh[SEEN] / SCALE, LIGHT[SEEN] / SCALE, known=estimate.valid)


def _few(trial: Trial, light: Floats, normals: tuple[tuple[float, float, float], ...]) -> Found:
    """What the walls show, under the light found from them; what they do not show is said to be unknown."""
    estimate = LightEstimator(4).update(sums(trial.engine, walls(*normals), light, noise=NOISE))
    truth = open_transfer(unit(normals), 4) @ light
    unknown = estimate.std is not None and bool(estimate.std[1:4].max() > 0.1 * np.abs(LIGHT[1:4]).max())
    return Found(shading(estimate, unit(normals)), truth, known=estimate.valid or not unknown)


for _name, _normals in {
    "one plane": (_UP,),
    "two planes": (_UP, _SIDE),
    "room corner": (_UP, _SIDE, _FRONT),
}.items():

    @LIGHT_SUMS.case(_name, 2 * 4 * 0.0015, "radiance", _FEW_NORMALS, known=False)
    def few_normals(trial: Trial, normals: tuple[tuple[float, float, float], ...] = _normals) -> Found:
        return _few(trial, np.outer(LIGHT @ LUMINANCE, np.ones(3)), normals)


@LIGHT_SUMS.case(
    "room corner, coloured light",
    0.03,
    "radiance",
    "a colour is taken no farther than leaves no direction negative; of three walls that is 0.02 of a radiance of 0.5.",
    apart=2 * 4 * 0.0015,
    known=False,
)
def coloured_corner(trial: Trial) -> Found:
    return _few(trial, LIGHT, (_UP, _SIDE, _FRONT))


@LIGHT_SUMS.case(
    "normals within one degree",
    2 * 4 * 0.0015,
    "radiance",
    "as one plane: " + _FEW_NORMALS,
    known=False,
)
def one_direction(trial: Trial) -> Found:
    """The normal matrix's condition is beyond what float32 sums can tell from singular."""
    near = unit(np.array(_UP) + np.deg2rad(1) * np.random.default_rng(5).normal(size=(COUNT, 3)) / 3)
    estimate = LightEstimator(4).update(sums(trial.engine, near, noise=NOISE))
    return Found(shading(estimate, _UP), open_transfer(np.array(_UP), 4) @ LIGHT, known=estimate.valid)


@LIGHT_SUMS.case("no visible sky", 0, "radiance", "nothing is summed, so nothing is found: exactly zero.", known=False)
def no_sky(trial: Trial) -> Found:
    estimate = LightEstimator(4).update(sums(trial.engine, around(), openness=0.0))
    return Found(estimate.sh, 0, known=estimate.valid or estimate.std is not None)


@LIGHT_SUMS.case("all black", 1e-6, "radiance", "float32 noise far below a code value is no light.", known=False)
def all_black(trial: Trial) -> Found:
    estimate = LightEstimator(4).update(sums(trial.engine, around(), 0 * LIGHT, noise=1e-9))
    return Found(estimate.sh, 0, known=estimate.valid)


@LIGHT_SUMS.case("all clipped", 0, "radiance", "marked pixels are not summed: exactly zero.", known=False)
def all_white(trial: Trial) -> Found:
    estimate = LightEstimator(4).update(sums(trial.engine, around(), marks=0.0))
    return Found(estimate.sh, 0, known=estimate.valid or estimate.std is not None)


@LIGHT_SUMS.case(
    "the brighter half clipped",
    4 * 66 * FLOAT * 1000,
    "of the largest coefficient",
    "half of the normals leave a condition of below 1000; marked pixels are left out, not taken for what they show.",
    known=True,
)
def half_clipped(trial: Trial) -> Found:
    normals = around()
    bright = (open_transfer(normals, 4) @ LIGHT).sum(-1)
    marks = np.where(bright > np.median(bright), 0.0, 1.0)
    estimate = LightEstimator(4).update(sums(trial.engine, normals, marks=marks))
    return Found(estimate.sh[SEEN] / SCALE, LIGHT[SEEN] / SCALE, known=estimate.valid)


@LIGHT_SUMS.case(
    "a uniform sky",
    4 * 66 * FLOAT * 16 * 4,
    "radiance",
    "as normals all around; there is no direction, and none may be said to be known.",
    known=False,
)
def uniform_sky(trial: Trial) -> Found:
    estimate = LightEstimator(4).update(sums(trial.engine, around(), uniform()))
    return Found(estimate.sh[SEEN], uniform()[SEEN], known=estimate.valid)


def _conditioned(condition: float, noise: float = 0.0, n: int = 16) -> tuple[NormalEquations, Floats]:
    """Normal equations of this condition number, of noisy samples, and the solution without noise."""
    random = np.random.default_rng(3)
    left, right = (np.linalg.qr(random.normal(size=shape))[0] for shape in ((400, n), (n, n)))
    columns = left * np.logspace(0, -0.5 * np.log10(condition), n) @ right.T
    x = random.normal(size=(n, 1))
    y = columns @ x + noise * random.normal(size=(400, 1))
    return NormalEquations(columns.T @ columns, columns.T @ y, (y**2).sum(0), 400), x


for _condition in (1e2, 1e4, 1e6, 1e8):

    @LIGHT_SUMS.case(
        f"condition {_condition:.0e}, plain",
        4 * 16 * 2.0**-52 * _condition + 2 * 1e-13 * _condition,
        "absolute",
        "forward error of a float64 solve, 4 n epsilon times the condition, and the least prior of 1e-13 times it.",
    )
    def plain_condition(_trial: Trial, condition: float = _condition) -> Found:
        equations, x = _conditioned(condition)
        return Found(solve_plain(equations, np.ones(16)).mean, x)

    @LIGHT_SUMS.case(
        f"condition {_condition:.0e}, by evidence",
        5.0,
        "standard deviations",
        "of 16 normal errors one is beyond 5 of the standard deviations that the posterior says in 1 of 100 000 draws.",
    )
    def evidence_condition(_trial: Trial, condition: float = _condition) -> Found:
        equations, x = _conditioned(condition, noise=1e-3)
        found = solve_with_evidence(equations, np.ones(16))
        return Found((found.mean - x)[:, 0] / np.maximum(found.std(0), 1e-300), 0)


@LIGHT_SUMS.case(
    "a light that flickers",
    0.2,
    "of the mean light",
    "the light is 0.8 and 1.2 of itself in turn: an estimate farther from the mean than that would overshoot.",
    apart=1e-3,
    known=True,
)
def flickers(trial: Trial) -> Found:
    estimator, scales = LightEstimator(4), []
    frames = [sums(trial.engine, around(), scale * LIGHT, noise=0.003) for scale in (0.8, 1.2)]
    for k in range(30):
        estimate = estimator.update(frames[k % 2])
        scales.append(float((estimate.sh[SEEN] * LIGHT[SEEN]).sum() / (LIGHT[SEEN] ** 2).sum()))
    return Found(scales[1:], 1.0, known=estimate.valid)


@LIGHT_SUMS.case(
    "a light that jumps",
    0.02,
    "of the way to the new light",
    "what is kept of the old light, 0.3 to the power of 10 frames at the least and 0.9 after the first, is under 2 %.",
    apart=1e-3,
    known=True,
)
def jumps(trial: Trial) -> Found:
    before, after = lobe_and_sky((1, 0.5, 0)), lobe_and_sky((-1, 0.5, 0.3))
    estimator = LightEstimator(4)
    old, new = (sums(trial.engine, around(), light, noise=0.003) for light in (before, after))
    for frame in [old] * 20 + [new] * 10:
        estimate = estimator.update(frame)
    way = (after - before)[SEEN]
    share = float(((estimate.sh - before)[SEEN] * way).sum() / (way * way).sum())
    return Found(share, 1.0, known=estimate.valid)


@LIGHT_SUMS.case(
    "a light that goes out",
    0.02,
    "of the light before",
    "as a light that jumps: after 10 frames of darkness under 2 % of it are left.",
    apart=1e-3,
)
def goes_out(trial: Trial) -> Found:
    estimator = LightEstimator(4)
    on, off = (sums(trial.engine, around(), light, noise=0.001) for light in (LIGHT, 0 * LIGHT))
    for frame in [on] * 20 + [off] * 10:
        estimate = estimator.update(frame)
    return Found(estimate.sh / SCALE, 0)
