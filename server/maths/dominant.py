"""The dominant lights of a spherical-harmonics light (thesis P4, 7.5): one, or each of several.

Several: the light is taken for an even sky and a few lights of their own direction, spread, intensity and colour,
x = sky Y_00 + sum_k s_k pi exp(-l (l + 1) spread_k^2 / 2) Y(d_k), all s >= 0, found one after the other where what is
left is largest (deflation), all of them moved again after each (Levenberg-Marquardt on the vectors s_k d_k).
A spread of 0 is a light from one direction; the others are round Gaussians on the sphere (its heat kernel).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import pi

import numpy as np
from numpy.typing import NDArray

from server.maths.directional_fit import DirectionalFit
from server.maths.sh import LUMINANCE, dominant_direction, luminance_sh, sh_basis

MOST_LIGHTS = 3
LEAST_SHARE = 0.1
"""Share of the strongest light's intensity. Weaker lights may as well be ringing of the harmonics."""
LEAST_GAIN = 0.02
"""Share of the energy, beyond an even sky, that a further light must explain."""
_SLOANS_UNIT = 16 * pi / 17
_REMEMBERED = 32

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class DominantLight:
    """One light of several."""

    direction: Floats
    """[3] unit, towards the light, in the coefficients' axes."""
    irradiance: Floats
    """[3] RGB radiance of a white surface that faces it, lit by it alone."""
    spread_rad: float
    """Standard deviation along either axis; 0 for a light from one direction."""

    @property
    def intensity(self) -> float:
        """Luminance of `irradiance`."""
        return float(self.irradiance @ LUMINANCE)


def radiance_intensity(coefficients: Floats) -> float:
    """Luminance of a directional light along the dominant direction, as `dominant_intensity` is.

    Least squared error of the *radiance* with a free even sky, order 2: 289 / (512 pi) sum L_i Ld_i over i >= 1,
    Ld = (16 pi / 17) Y(d). 1 / (289 / (512 pi)) is the sum of Ld_i^2, as 1 / (867 / (316 pi)) is that of A_l^2 Ld_i^2.
    Negative results mean no directional light: 0.
    """
    direction = dominant_direction(coefficients)
    if not direction.any():
        return 0.0
    nine = luminance_sh(coefficients)[1:9]
    unit_light = _SLOANS_UNIT * sh_basis(direction, 3)[1 : 1 + len(nine)]
    return max(0.0, float(289 / (512 * pi) * np.sum(nine * unit_light)))


def dominant_lights(
    coefficients: Floats,
    precision: Floats | None = None,
    *,
    most: int = MOST_LIGHTS,
    sharp: bool = False,
    least_gain: float = LEAST_GAIN,
) -> tuple[DominantLight, ...]:
    """The lights that `coefficients` [n, 3] of radiance are made of, strongest first; () where there is none.

    Minimises (x - model)^T `precision` (x - model) of luminance: with none, the error of the radiance; with an
    estimate's own information matrix [n, n], the error of the picture it was made from. `sharp`: no spread.
    `least_gain`: of the energy that an even sky leaves, what a further light must explain.
    Colours are fitted to the found directions by the same error.
    """
    light = luminance_sh(coefficients)
    key = light.tobytes(), None if precision is None else np.asarray(precision, np.float64).tobytes(), sharp
    fit = _fit_of(*key)
    found, left = _found(*key, 0)
    energy = left
    if energy <= 1e-12 * float(np.sum(fit.target**2)):
        return ()
    for count in range(min(most, len(light) // 4)):
        tried, misfit = _found(*key, count + 1)
        if left - misfit < least_gain * energy:
            break
        found, left = tried, misfit
    return _colored(fit, found, fit.root @ coefficients)


def _fit_of(light: bytes, precision: bytes | None, sharp: bool) -> DirectionalFit:
    """light: luminance [n]; precision: [n, n], None for the radiance's error."""
    values = np.frombuffer(light, np.float64)
    count = len(values)
    root = np.eye(count) if precision is None else _root(np.frombuffer(precision, np.float64).reshape(count, count))
    return DirectionalFit(root, root @ values, round(count**0.5), sharp)


@lru_cache(_REMEMBERED)
def _found(light: bytes, precision: bytes | None, sharp: bool, count: int) -> tuple[Floats, float]:
    """The parameters of a sky and `count` lights, and their misfit. A frame asks for the same light more than once."""
    fit = _fit_of(light, precision, sharp)
    found = fit.refined(fit.with_next(_found(light, precision, sharp, count - 1)[0])) if count else fit.sky()
    return found, fit.misfit(found)


def _colored(fit: DirectionalFit, found: Floats, targets: Floats) -> tuple[DominantLight, ...]:
    """The lights of `found` in the colours that fit `targets` [rows, 3] best, strongest first, without weak ones."""
    lights = found[1:].reshape(-1, 4)
    if not len(lights):
        return ()
    unit = lights[:, :3] / np.linalg.norm(lights[:, :3], axis=1, keepdims=True)
    atoms = fit.unit_lights(found)
    colors = np.linalg.lstsq(atoms, targets, rcond=None)[0]
    for channel in np.flatnonzero(colors.min(axis=0) < 0):
        colors[:, channel] = _nonnegative(atoms, targets[:, channel])
    colored = [
        DominantLight(direction, color, float(np.sqrt(2 * flatness)))
        for direction, color, flatness in zip(unit, colors[1:], lights[:, 3], strict=True)
    ]
    strongest = max(light.intensity for light in colored)
    kept = (light for light in colored if light.intensity > 0 and light.intensity >= LEAST_SHARE * strongest)
    return tuple(sorted(kept, key=lambda light: -light.intensity))


def _nonnegative(atoms: Floats, target: Floats) -> Floats:
    """Least squares of a few columns whose factors may not be negative: the most negative is left out, in turn."""
    free = list(range(atoms.shape[1]))
    factors = np.zeros(atoms.shape[1])
    while free:
        solved = np.linalg.lstsq(atoms[:, free], target, rcond=None)[0]
        if solved.min() >= 0:
            factors[free] = solved
            break
        del free[int(solved.argmin())]
    return factors


def _root(precision: Floats) -> Floats:
    """R with R^T R = `precision`, symmetric positive semidefinite."""
    values, vectors = np.linalg.eigh(precision)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)
