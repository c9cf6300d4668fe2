"""An even sky and a few lights, each of a direction, a strength and a spread, fitted to coefficients of radiance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import pi

import numpy as np
from numpy.typing import NDArray

from server.maths.sh import band_of, sh_basis, spherical_fibonacci
from server.maths.sh_polynomials import sh_with_slope

_WIDEST_RAD = 0.9
_SPREADS_RAD = (0.0, 0.45, 0.9)
_DIRECTIONS = 256
_LEAST_LENGTH = 1e-9
_MOST_STEPS = 40
_CONVERGED = 1e-10  # of the target's energy
_LEAST_STEP_GAIN = 1e-4

Floats = NDArray[np.float64]


def directional_sh(direction: Floats, spread_rad: float, bands: int) -> Floats:
    """Coefficients [..., bands^2] of a light from `direction` [..., 3] that lets a white surface facing it shade to 1
    (whole series, spread 0)."""
    band = band_of(bands * bands)
    return np.asarray(pi * np.exp(-band * (band + 1) * spread_rad**2 / 2) * sh_basis(direction, bands))


@dataclass(frozen=True)
class DirectionalFit:
    """Least squares of `target` [rows] = `root` [rows, bands^2] x.

    Parameters [1 + 4 lights]: the sky, then of each light its vector s d [3] and its spread's square / 2.
    """

    root: Floats
    target: Floats
    bands: int
    sharp: bool
    """No spread."""

    def sky(self) -> Floats:
        """Parameters of the best even sky alone."""
        column = self.root[:, 0]
        return np.array([max(0.0, float(column @ self.target) / max(float(column @ column), 1e-300))])

    def linearised(self, parameters: Floats) -> tuple[Floats, Floats]:
        """[rows] model less target, and its derivatives [rows, parameters]."""
        flatness, length, unit = _taken_apart(parameters)
        values, slopes = sh_with_slope(unit, self.bands)
        band, energy = _band_and_energy(self.bands)
        fading = pi * np.exp(-flatness * energy)
        faded = fading * values
        # s Y(d) = s^(1-l) P(v): its gradient by v is that of P less what P grows along v by itself.
        derivatives = np.empty((*values.shape, 4))  # [lights, bands^2, 4]
        derivatives[..., :3] = fading[..., None] * slopes + ((1 - band) * faded)[..., None] * unit[:, None]
        derivatives[..., 3] = 0.0 if self.sharp else -length * faded * energy
        jacobian = np.empty((len(self.root), len(parameters)))
        jacobian[:, 0] = self.root[:, 0]
        jacobian[:, 1:] = self.root @ derivatives.transpose(1, 0, 2).reshape(len(band), -1)
        model = self.root @ np.sum(length * faded, axis=0)
        return parameters[0] * self.root[:, 0] + model - self.target, jacobian

    def misfit(self, parameters: Floats) -> float:
        """Squared error."""
        return float(np.sum(self.linearised(parameters)[0] ** 2))

    def unit_lights(self, parameters: Floats) -> Floats:
        """[rows, 1 + lights]: the sky and the lights of `parameters`, each of strength 1."""
        flatness, _, unit = _taken_apart(parameters)
        lights = pi * np.exp(-flatness * _band_and_energy(self.bands)[1]) * sh_with_slope(unit, self.bands)[0]
        return np.column_stack([self.root[:, 0], self.root @ lights.T])

    def with_next(self, found: Floats) -> Floats:
        """`found` and the light that lessens its misfit most: all candidates are tried at once."""
        spreads = (0.0,) if self.sharp else _SPREADS_RAD
        directions, atoms = _candidates(self.bands, spreads)
        atoms = self.root @ atoms
        spanned = np.linalg.qr(self.unit_lights(found))[0]  # what the found ones can take over does not count
        atoms = atoms - spanned @ (spanned.T @ atoms)
        products = -self.linearised(found)[0] @ atoms
        norms = np.maximum(np.sum(atoms**2, axis=0), 1e-300)
        best = int((np.maximum(products, 0.0) ** 2 / norms).argmax())
        strength = max(float(products[best] / norms[best]), _LEAST_LENGTH)
        flatness = spreads[best // _DIRECTIONS] ** 2 / 2
        return np.array([*found, *(strength * directions[best % _DIRECTIONS]), flatness])

    def refined(self, start: Floats) -> Floats:
        """The nearest parameters of least error (Levenberg-Marquardt within the limits)."""
        low, high = _limits(len(start))
        here, damping = start, 1e-3
        residual, jacobian = self.linearised(here)
        cost = float(residual @ residual)
        enough = _CONVERGED * float(self.target @ self.target)
        for _ in range(_MOST_STEPS):
            if cost <= enough or damping > 1e9:
                break
            normal, slope = jacobian.T @ jacobian, jacobian.T @ residual
            free = ~((here <= low) & (slope > 0) | (here >= high) & (slope < 0))
            normal.flat[:: len(here) + 1] += damping * normal.diagonal() + 1e-12 * normal.max()
            tried = here.copy()
            if free.all():
                tried -= np.linalg.solve(normal, slope)
            else:
                tried[free] -= np.linalg.solve(normal[np.ix_(free, free)], slope[free])
            tried = np.minimum(np.maximum(tried, low), high)
            tried_residual, tried_jacobian = self.linearised(tried)
            misfit = float(tried_residual @ tried_residual)
            if misfit >= cost:
                damping *= 8
                continue
            gain = cost - misfit
            here, cost, residual, jacobian = tried, misfit, tried_residual, tried_jacobian
            damping = max(damping / 8, 1e-12)
            if gain <= _LEAST_STEP_GAIN * cost:
                break
        return here


def _taken_apart(parameters: Floats) -> tuple[Floats, Floats, Floats]:
    """Parameters of the lights: half the squared spread [k, 1], strength [k, 1], direction [k, 3]."""
    lights = parameters[1:].reshape(-1, 4)
    vectors = lights[:, :3]
    length = np.maximum(np.sqrt(np.sum(vectors * vectors, axis=1, keepdims=True)), _LEAST_LENGTH)
    return lights[:, 3:], length, vectors / length


@cache
def _band_and_energy(bands: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """[bands^2] l and l (l + 1)."""
    band = band_of(bands * bands)
    return band, band * (band + 1)


def _limits(count: int) -> tuple[Floats, Floats]:
    """Least and most of each of `count` parameters: no negative sky, no spread beyond what four bands can tell."""
    low, high = np.full(count, -np.inf), np.full(count, np.inf)
    low[0], low[4::4], high[4::4] = 0.0, 0.0, _WIDEST_RAD**2 / 2
    return low, high


@cache
def _candidates(bands: int, spreads: tuple[float, ...]) -> tuple[Floats, Floats]:
    """Directions [d, 3], and lights along them [bands^2, spreads * d], spread by spread."""
    directions = spherical_fibonacci(_DIRECTIONS)
    lights = np.concatenate([directional_sh(directions, spread, bands) for spread in spreads])
    return directions, np.ascontiguousarray(lights.T)
