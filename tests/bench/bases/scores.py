"""How near a light in some basis comes to the one it stands for (B9): as environment, and by what it shades.

As in `environment`, one factor is taken out first, common to all colours.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from server.maths.light_direction import direction_error_deg
from server.maths.sh import luminance_sh, spherical_fibonacci
from tests.bench.bases.bases import Basis
from tests.bench.bases.lights import HardLight
from tests.bench.light.environment import CUBE_SIDE, NORMALS, best_scale, cube_directions, relative_rmse

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Truth:
    """What is exactly known of a light in a scene."""

    linear: Floats
    """[4, 3] its first two bands."""
    irradiance: Floats
    """[NORMALS, 3] of open white surfaces, over pi."""
    cube_map: Floats
    """[6 CUBE_SIDE^2, 3]."""
    ball: Floats
    """[n, 3] what a white virtual ball receives."""
    floor: Floats
    """[n, 3] what white floor around it receives."""

    @classmethod
    def of(cls, light: HardLight, ball: Floats, floor: Floats) -> Truth:
        """Of `light`, with what it shades."""
        normals = spherical_fibonacci(NORMALS)
        return cls(light.sh(2), light.irradiance(normals), light.cube_map(), ball, floor)


@dataclass(frozen=True)
class Score:
    """Errors of one light."""

    direction_deg: float
    irradiance: float
    """Relative RMSE over normals."""
    msad: float
    """Mean absolute difference of environment maps' luminance over the truth's mean."""
    shading: float
    """Relative RMSE over a ball."""
    near: float
    """The same over the floor around it, on which its shadow lies."""
    least_radiance: float
    """Of luminance, over the truth's mean: negative where it rings."""
    least_irradiance: float
    """The same of open surfaces."""


@dataclass(frozen=True)
class Transfers:
    """Of the ball and of the floor in one basis, [n, size] each."""

    ball: Floats
    floor: Floats


def score_light(basis: Basis, coefficients: Floats, transfers: Transfers, truth: Truth) -> Score:
    """Of the light with `coefficients` [size, 3]."""
    open_transfer, cube = _probes(basis)
    irradiance, radiance = open_transfer @ coefficients, luminance_sh(cube @ coefficients)
    exact = luminance_sh(truth.cube_map)
    difference = np.abs(best_scale(radiance, exact) * radiance - exact).mean() / exact.mean()
    return Score(
        direction_deg=direction_error_deg(basis.sh[:, :4].T @ coefficients, truth.linear),
        irradiance=relative_rmse(irradiance, truth.irradiance),
        msad=float(difference),
        shading=relative_rmse(transfers.ball @ coefficients, truth.ball),
        near=relative_rmse(transfers.floor @ coefficients, truth.floor),
        least_radiance=float(radiance.min() / exact.mean()),
        least_irradiance=float(luminance_sh(irradiance).min() / luminance_sh(truth.irradiance).mean()),
    )


@cache
def _probes(basis: Basis) -> tuple[Floats, Floats]:
    """Open transfer of NORMALS normals and values at the pixels of an environment map."""
    return basis.open_transfer(spherical_fibonacci(NORMALS)), basis.values(cube_directions(CUBE_SIDE))
