"""What one solution of the objective says of a room: the light that arrives at a place, and what its shell sends."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from server.light.arrivals import trace_arrivals
from server.light.place_light import VALID_SPREAD_DEG, PlaceLight
from server.light.shell.lamps import ShellLamp, find_lamps
from server.light.shell.objective import Unknowns
from server.light.shell.shell import Shell
from server.light.shell.spread import spread_deg
from server.light.shell.transport import KNOWN, NO_CELL, Met, meet
from server.maths.sh import LUMINANCE, sh_basis, spherical_fibonacci
from server.opencl.engine import Engine
from server.volume.volume import Volume

BANDS = 4
DIRECTIONS = 1024
"""Directions in which the light at a place is looked up: 16 coefficients of a lamp of 10 degrees are good to 3 %."""

Floats = NDArray[np.float64]


@cache
def look_up_directions() -> Floats:
    """[1, DIRECTIONS, 3] unit, evenly spread."""
    return spherical_fibonacci(DIRECTIONS)[None]


@cache
def _basis(bands: int = BANDS) -> Floats:
    """[bands^2, DIRECTIONS] weights that project radiance on spherical harmonics."""
    return np.asarray(4 * np.pi / DIRECTIONS * sh_basis(look_up_directions()[0], bands).T)


@dataclass(frozen=True)
class Solution:
    """Of the whole objective at one frame; it never changes. World axes and metres."""

    shell: Shell
    hidden: Mapping[int, int]
    """As of Transport."""
    near: Unknowns
    """With all that is not scanned on the shell."""
    distant: Unknowns
    """With what comes in at open sides of the shell at infinity."""
    rows: NDArray[np.int64]
    """[n] of the patches that it explains."""
    shown: Floats
    """[n, 3] mean log radiance of these patches."""
    _beyond: dict[tuple[bytes, int], tuple[Floats, Floats, list[ShellLamp]]] = field(default_factory=dict)
    """What `beyond` found last."""

    def radiance_at(self, engine: Engine, volume: Volume, position: Floats, directions: Floats) -> Floats:
        """[m, 3] radiance that arrives at `position` [3] (world) against `directions` [m, 3]."""
        return np.asarray(self._radiance_of(self._looked_up(engine, volume, position[None], directions[None]))[0])

    def arriving_at(self, engine: Engine, volume: Volume, positions: Floats) -> list[PlaceLight]:
        """The light at each of `positions` [n, 3] (world)."""
        met = self._looked_up(engine, volume, positions, look_up_directions())
        radiance = self._radiance_of(met)
        places = zip(positions, radiance, met.columns, met.shares, strict=True)
        return [self._arriving(position, one, columns, shares) for position, one, columns, shares in places]

    def beyond(self, position: Floats, bands: int) -> tuple[Floats, Floats, list[ShellLamp]]:
        """The light from the shell as seen from `position` [3] (world), with no surface in between.

        [bands^2, 3] the whole, [bands^2, 3] what its lamps leave, and the lamps.
        """
        asked = position.tobytes(), bands
        if asked not in self._beyond:
            self._beyond.clear()
            self._beyond[asked] = self._seen_beyond(position, bands)
        return self._beyond[asked]

    def _seen_beyond(self, position: Floats, bands: int) -> tuple[Floats, Floats, list[ShellLamp]]:
        directions = look_up_directions()[0]
        start = np.broadcast_to(position, directions.shape)
        cells, shares = self.shell.exits(start, directions)
        ends = position + self.shell.distances(start, directions).min(axis=-1)[:, None] * directions
        radiance = np.einsum("mc,mcr->mr", shares, self.near.radiance[cells])
        lamps, rest = find_lamps(position, ends, radiance)
        return _basis(bands) @ radiance, _basis(bands) @ rest, lamps

    def _looked_up(self, engine: Engine, volume: Volume, positions: Floats, directions: Floats) -> Met:
        """What rays [n, m] meet; cells that the solution does not have are NO_CELL."""
        arrivals = trace_arrivals(engine, volume, positions - volume.origin_world, None, directions)
        turned = np.broadcast_to(directions[0], (len(positions), *directions[0].shape))
        met = meet(self.shell, self.hidden, positions, turned, arrivals.astype(np.float64))
        return replace(met, columns=np.where(met.columns < self.near.known, met.columns, NO_CELL))

    def _radiance_of(self, met: Met) -> Floats:
        """[n, m, 3]."""
        cells = self.near.radiance[np.maximum(met.columns, 0)]
        radiance = met.known + np.einsum("nmc,nmcr->nmr", met.shares, cells)
        mean = np.exp(self.near.mean)
        is_new = (met.columns[..., 0] == NO_CELL)[..., None]  # surface of which no patch has received light
        unseen = np.where(met.at_least.max(axis=-1, keepdims=True) > 0, met.at_least, mean)
        return np.where(is_new, unseen, np.maximum(radiance, met.at_least))

    def _arriving(self, position: Floats, radiance: Floats, columns: NDArray[np.int64], shares: Floats) -> PlaceLight:
        sh = _basis() @ radiance
        luminance = radiance @ LUMINANCE
        covariance, _ = self.near.covariance_of(self._gradient(columns, shares))
        std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        tint = radiance.mean(axis=0) / max(float(luminance.mean()), 1e-12)
        angle = spread_deg(sh @ LUMINANCE, covariance)
        return PlaceLight(
            position=position,
            sh=sh,
            std=np.outer(std, tint),
            spread_deg=angle,
            valid=angle <= VALID_SPREAD_DEG,
            seen=float((columns[:, 0] == KNOWN).mean()),
        )

    def _gradient(self, columns: NDArray[np.int64], shares: Floats) -> Floats:
        """[bands^2, known] of coefficients of luminance by z, for rays that end in `shares` [m, 4] of cells."""
        ray, corner = np.nonzero(columns >= 0)
        cells = columns[ray, corner]
        sent = shares[ray, corner] * (self.near.radiance @ LUMINANCE)[cells]
        bands = BANDS * BANDS
        place = cells * bands + np.arange(bands)[:, None]
        sums = np.bincount(place.ravel(), (_basis()[:, ray] * sent).ravel(), self.near.known * bands)
        return np.asarray(sums.reshape(-1, bands).T)
