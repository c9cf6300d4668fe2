"""The light that arrives at a place: of scanned surface where a direction meets it, from beyond the scan elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from math import pi

import numpy as np
from numpy.typing import NDArray

from server.light.arrivals import RayGroup, trace_arrivals
from server.maths.sh import sh_basis, spherical_fibonacci
from server.opencl.engine import Engine
from server.volume.volume import Volume

DIRECTIONS = 1024
"""Directions from a place. Each stands for 0.012 sr, a cone of 3.6 degrees radius; the finest of 16 coefficients turns
once in 120 degrees. The cost grows with their number; a place may take at most 2 ms."""
BANDS = 4
"""SH bands of the light at a place: 16 coefficients, as in the wire format."""

_FAR_M = 1e5
"""Largest distance from the origin at which a place is looked up; farther places are moved here. From so far away no
direction meets the volume, which is some metres wide."""

Floats = NDArray[np.float64]
BeyondScan = Callable[[Floats, Floats], Floats]
"""Points [n, 3] (world metres) and unit directions [m, 3] (world axes) -> radiance [n, m, 3] from beyond the scan."""


def distant_light(sh: Floats) -> BeyondScan:
    """Light from infinitely far, the same at every point. sh: [bands^2, 3]; where its radiance is negative it is 0."""
    bands = round(len(sh) ** 0.5)

    def radiance(points: Floats, directions: Floats) -> Floats:
        return np.broadcast_to(np.maximum(sh_basis(directions, bands) @ sh, 0.0), (len(points), len(directions), 3))

    return radiance


def arriving_radiance(
    engine: Engine, volume: Volume, points: Floats, directions: Floats, beyond: BeyondScan
) -> tuple[Floats, NDArray[np.bool_]]:
    """Radiance [n, m, 3] that arrives at `points` [n, 3] from unit `directions` [m, 3], and where surface was met.

    Points are world metres, directions world axes. Where the first thing met is photographed surface, its radiance;
    elsewhere, also where a surface's back is met, what `beyond` says. The mask [n, m] is true in the first case.
    """
    # The volume's axes are the world's. Float32 rays need finite places.
    in_volume = np.clip(points + volume.volume_from_world()[:3, 3], -_FAR_M, _FAR_M)
    met = trace_arrivals(engine, volume, RayGroup(in_volume, None, directions[None])).astype(np.float64)
    is_seen = met[..., 3] > 0
    return np.where(is_seen[..., None], met[..., :3], beyond(points, directions)), is_seen


def arriving_sh(engine: Engine, volume: Volume, points: Floats, beyond: BeyondScan) -> tuple[Floats, Floats]:
    """SH [n, 16, 3] of the radiance that arrives at `points` [n, 3] (world metres), and the share [n] seen there."""
    directions, projection = _quadrature()
    radiance, is_seen = arriving_radiance(engine, volume, points, directions, beyond)
    return projection @ radiance, is_seen.mean(axis=1)


@cache
def _quadrature() -> tuple[Floats, Floats]:
    """Directions [DIRECTIONS, 3], and the weights [16, DIRECTIONS] that project radiance along them."""
    directions = spherical_fibonacci(DIRECTIONS)
    return directions, sh_basis(directions, BANDS).T * (4 * pi / DIRECTIONS)
