"""The photometric-stereo photographs `light_uw_photometric`: estimated lights against the known ones.

A grey ball and a statue under the same 12 lights, linear response. Axes: x right, y up, z towards the camera, which is
far away. The labels are themselves good to about 5 degrees; the mirror ball's highlights give the lights once more.
The ball's normals are a sphere's. The statue's come from photometric stereo (Woodham 1980) under some of the lights,
and are judged under the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from server.light.light_estimation import prior_precision
from server.maths.bayes import NormalEquations, solve_with_evidence
from server.maths.dominant import DominantLight, dominant_lights
from server.maths.sh import LUMINANCE, dominant_direction, lambert_transfer
from tests.bench.truth.probe import POOL, shading_equations

BANDS = 5
CLIPPED = 0.98
_RIM = 0.98  # of the ball's radius: beyond it a pixel mixes ball and background
_SHADOW = 0.02
_FOLDS = 4
_LEAST_ALBEDO = 0.05
_LEAST_FACING = 0.1
_OUTLIER_SIGMAS = 2.0
_MAD_TO_SIGMA = 1.4826
_SUM_STRIDE = 8  # of the pixels that the many sums are taken over
_TINY = 1e-9

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PhotometricSet:
    """The pictures of one folder."""

    lights: Floats
    """[12, 3] unit vectors towards the light, as labelled."""
    mirror_lights: Floats
    """[12, 3] the same from the mirror ball's highlights."""
    ball: Floats
    """[12, n, 3] linear RGB of the ball's pixels."""
    ball_normals: Floats
    """[n, 3]."""
    statue: Floats
    """[12, m, 3] linear RGB of the statue's pixels."""


@dataclass(frozen=True)
class Samples:
    """Surface points of known normal and albedo, without the light."""

    normals: Floats
    """[n, 3]."""
    albedo: Floats
    """[n] relative."""


@dataclass(frozen=True)
class FoundLight:
    """What one picture said."""

    sh: Floats
    """[25, 3]."""
    equations: NormalEquations
    lights: tuple[DominantLight, ...]

    @property
    def direction(self) -> Floats:
        """[3] towards the strongest light; zeros where there is none."""
        return self.lights[0].direction if self.lights else np.zeros(3)

    @property
    def mean_direction(self) -> Floats:
        """[3] from the linear coefficients, which the never-seen back of the sphere takes part in."""
        return dominant_direction(self.sh)


@dataclass(frozen=True)
class Sums:
    """How linear the light is in the picture."""

    shares: Floats
    """[sums, terms] how much of each single picture's light is in the sum's; 1 is right."""
    rests: Floats
    """[sums] what the sum's light is off from the sum of the single ones, as a part of the picture."""


def read_photometric_set(folder: Path) -> PhotometricSet:
    """Raises OSError or ValueError where it is not all there."""
    lights = np.loadtxt(folder / "lights.txt", skiprows=1)
    ball_mask = _mask(folder, "gray")
    center, radius = _circle(ball_mask)
    rows, columns = np.nonzero(ball_mask)
    x, y = (columns - center[0]) / radius, -(rows - center[1]) / radius
    inside = np.hypot(x, y) < _RIM
    x, y = x[inside], y[inside]
    pictures = _pictures(folder, "gray", len(lights))
    return PhotometricSet(
        lights=lights,
        mirror_lights=_mirror_lights(folder, len(lights)),
        ball=pictures[:, rows[inside], columns[inside]],
        ball_normals=np.stack([x, y, np.sqrt(1 - x * x - y * y)], axis=1),
        statue=_pictures(folder, "buddha", len(lights))[:, _mask(folder, "buddha")],
    )


def find_light(samples: Samples, picture: Floats, robust_steps: int = 5, pool: float = POOL) -> FoundLight:
    """The light of one picture [n, 3] of `samples`.

    `robust_steps` rounds of reweighting (Cauchy's function at 2 sigma) against cast shadows, highlights and dirt.
    pool: how many samples share their errors.
    """
    usable = picture.max(axis=1) < CLIPPED
    normals, albedo = samples.normals[usable], samples.albedo[usable]
    shading = picture[usable] / albedo[:, None]
    transfer, trust = lambert_transfer(normals, BANDS), albedo**2
    precision = prior_precision(BANDS)
    weights = trust
    for step in range(robust_steps + 1):
        equations = shading_equations(normals, shading, BANDS, weights, pool)
        light = solve_with_evidence(equations, precision).mean
        if step == robust_steps:
            break
        residual = albedo * ((shading - transfer @ light) @ LUMINANCE)
        sigma = _MAD_TO_SIGMA * float(np.median(np.abs(residual))) + _TINY
        weights = trust / (1 + (residual / (_OUTLIER_SIGMAS * sigma)) ** 2)
    return FoundLight(light, equations, dominant_lights(light, equations.matrix, sharp=True))


def ball_samples(photographs: PhotometricSet) -> Samples:
    """The grey ball's."""
    return Samples(photographs.ball_normals, np.ones(len(photographs.ball_normals)))


def statue_samples(photographs: PhotometricSet, known: list[int]) -> tuple[Samples, NDArray[np.bool_]]:
    """Normals and albedo from the pictures under the lights `known`, and which [m] of the statue's pixels have any.

    Least squares, reweighted against shadows and highlights.
    """
    lights = photographs.lights[known]
    seen = photographs.statue[known] @ LUMINANCE
    lit = (seen > _SHADOW).astype(np.float64)
    weights = lit
    for _ in range(6):
        matrix = np.einsum("kn,ki,kj->nij", weights, lights, lights) + 1e-6 * np.eye(3)
        vector = np.einsum("kn,ki,kn->ni", weights, lights, seen)
        scaled = np.linalg.solve(matrix, vector[..., None])[..., 0]
        allowed = 0.05 * np.linalg.norm(scaled, axis=1) + 0.005
        weights = lit / (1 + ((seen - lights @ scaled.T) / allowed) ** 2)
    albedo = np.linalg.norm(scaled, axis=1)
    normals = scaled / np.maximum(albedo, _TINY)[:, None]
    good = (albedo > _LEAST_ALBEDO) & (normals[:, 2] > _LEAST_FACING)
    return Samples(normals[good], albedo[good]), good


def find_ball_lights(photographs: PhotometricSet, robust_steps: int = 5) -> list[FoundLight]:
    """From every picture of the ball."""
    samples = ball_samples(photographs)
    return [find_light(samples, picture, robust_steps) for picture in photographs.ball]


def find_statue_lights(photographs: PhotometricSet, robust_steps: int = 5) -> list[FoundLight]:
    """From every picture of the statue, with the normals that the pictures of the other folds give."""
    count = len(photographs.lights)
    found: dict[int, FoundLight] = {}
    for fold in range(_FOLDS):
        judged = range(fold, count, _FOLDS)
        samples, good = statue_samples(photographs, [k for k in range(count) if k not in judged])
        for k in judged:
            found[k] = find_light(samples, photographs.statue[k, good], robust_steps)
    return [found[k] for k in range(count)]


def judge_sums(samples: Samples, pictures: Floats, terms: int) -> Sums:
    """Lights of all sums of `terms` of `pictures` [k, n, 3] against the lights of the single ones.

    In the metric of the sum's normal equations. Without reweighting, which follows the picture and is not linear.
    """
    usable = np.flatnonzero(pictures.max(axis=(0, 2)) < CLIPPED)[::_SUM_STRIDE]
    samples = Samples(samples.normals[usable], samples.albedo[usable])
    pictures, pool = pictures[:, usable], POOL / _SUM_STRIDE
    singles = np.stack([find_light(samples, p, 0, pool).sh @ LUMINANCE for p in pictures], axis=1)
    shares, rests = [], []
    for chosen in combinations(range(len(pictures)), terms):
        # Of the sum's mean: what is clipped is the sensor's affair, and a sum has no clipped pixels of its own.
        found = find_light(samples, pictures[list(chosen)].mean(axis=0), 0, pool)
        parts, whole, metric = singles[:, chosen], terms * found.sh @ LUMINANCE, found.equations.matrix
        shares.append(np.linalg.solve(parts.T @ metric @ parts, parts.T @ metric @ whole))
        expected = parts.sum(axis=1)
        rest = whole - expected
        rests.append(np.sqrt((rest @ metric @ rest) / (expected @ metric @ expected)))
    return Sums(np.array(shares), np.array(rests))


def angles_deg(found: list[FoundLight], truth: Floats) -> Floats:
    """[k] degrees between the strongest lights and the true ones; 180 where none was found."""
    cosines = [
        light.direction @ direction if light.lights else -1.0 for light, direction in zip(found, truth, strict=True)
    ]
    return np.asarray(np.degrees(np.arccos(np.clip(cosines, -1, 1))))


def _pictures(folder: Path, name: str, count: int) -> Floats:
    """[count, h, w, 3] linear RGB in [0, 1]."""
    return np.stack([_read(folder / name / f"{name}.{k}.png") for k in range(count)])


def _mask(folder: Path, name: str) -> NDArray[np.bool_]:
    return np.asarray(_read(folder / name / f"{name}.mask.png")[..., 0] > 0.5)


def _read(path: Path) -> Floats:
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise OSError(f"{path} cannot be read")
    return np.asarray(picture[..., ::-1].astype(np.float64) / 255)


def _circle(mask: NDArray[np.bool_]) -> tuple[Floats, float]:
    """Centre (x, y) and radius in pixels."""
    rows, columns = np.nonzero(mask)
    low, high = np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()])
    return (low + high) / 2, float((high - low + 1).mean() / 2)


def _mirror_lights(folder: Path, count: int) -> Floats:
    """[count, 3] from the largest clipped spot on the mirror ball: the view reflected at its normal."""
    mask = _mask(folder, "chrome")
    center, radius = _circle(mask)
    lights = []
    for picture in _pictures(folder, "chrome", count):
        spots = ((picture.max(axis=2) >= CLIPPED) & mask).astype(np.uint8)
        _, _, sizes, middles = cv2.connectedComponentsWithStats(spots)
        x, y = (middles[1 + int(sizes[1:, cv2.CC_STAT_AREA].argmax())] - center) / radius * [1, -1]
        normal = np.array([x, y, np.sqrt(1 - x * x - y * y)])
        lights.append(2 * normal[2] * normal - [0, 0, 1])
    return np.stack(lights)
