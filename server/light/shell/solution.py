"""What one solution of the objective says of a room: the light that arrives at a place, and what its shell sends."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix

from server.light.arrivals import PendingArrivals, RayGroup, begin_arrivals, trace_arrivals
from server.light.light_estimation import LightEstimate
from server.light.place_light import VALID_SPREAD_DEG, PlaceLight
from server.light.shell.bright_surface import Emitters
from server.light.shell.distant import distant_light
from server.light.shell.lamps import ShellLamp, emitting_lamps, find_lamps
from server.light.shell.patches import Patches
from server.light.shell.shell import CORNERS, SIDE, Shell
from server.light.shell.solved import Solved
from server.light.shell.spread import deviations, spread_deg
from server.light.shell.transport import KNOWN, NO_CELL, Met, bright_keys, columns_of, meet
from server.maths.dominant import MOST_LIGHTS
from server.maths.sh import LUMINANCE, in_bundles, sh_basis, spherical_fibonacci
from server.opencl.engine import Engine
from server.volume.volume import Volume

BANDS = 4
DIRECTIONS = 1024
"""Directions in which the light at a place is looked up. The 16 coefficients of a lamp of 10 degrees have errors of 3
%."""

Floats = NDArray[np.float64]


@cache
def look_up_directions() -> Floats:
    """[1, DIRECTIONS, 3] unit, evenly spread."""
    return in_bundles(spherical_fibonacci(DIRECTIONS))[None]


@cache
def _basis(bands: int = BANDS) -> Floats:
    """[bands^2, DIRECTIONS] weights that project radiance on spherical harmonics."""
    return np.asarray(4 * np.pi / DIRECTIONS * sh_basis(look_up_directions()[0], bands).T)


@dataclass(frozen=True)
class _Rays:
    """[m] rays from a place, and what they meet."""

    basis: Floats
    """[bands^2, m] weights that project their radiance on spherical harmonics."""
    columns: NDArray[np.int64]
    shares: Floats
    known: Floats
    """As in Met."""


@dataclass(frozen=True)
class Solution:
    """A solution of the whole objective at one frame; it never changes. World axes and metres."""

    shell: Shell
    hidden: Mapping[int, int]
    """As of Transport."""
    emitters: Emitters
    near: Solved
    """With all that is not scanned on the shell."""
    distant: Solved
    """With what comes in at open sides of the shell at infinity; the covariance is that of the lobes."""
    rows: NDArray[np.int64]
    """[n] of the patches that it explains."""
    shown: Floats
    """[n, 3] mean log radiance of these patches."""
    behind: float = 0.0
    """By what share the light that it tells differs from the one that was solved (fade.py)."""
    _beyond: dict[tuple[bytes, int], tuple[Floats, Floats, list[ShellLamp]]] = field(default_factory=dict)
    """What `beyond` found last."""
    _estimates: dict[int, LightEstimate] = field(default_factory=dict)
    """Of `estimate`, by the number of bands."""

    def change_in(self, patches: Patches) -> float:
        """By how much the logarithm of what its patches show has changed since, root mean square."""
        return float(np.sqrt(np.mean((patches.logarithms[self.rows] - self.shown) ** 2)))

    def radiance_at(self, engine: Engine, volume: Volume, position: Floats, directions: Floats) -> Floats:
        """[m, 3] radiance that arrives at `position` [3] (world) against `directions` [m, 3]."""
        rays = RayGroup(position[None] - volume.origin_world, None, directions[None])
        arrivals = trace_arrivals(engine, volume, rays)
        return np.asarray(self._radiance_of(self._met(position[None], directions, arrivals))[0])

    def look_up(self, engine: Engine, volume: Volume, positions: Floats) -> LookUp:
        """Begin to trace what `arriving` needs for each of `positions` [n, 3] (world)."""
        evenly = np.broadcast_to(look_up_directions(), (len(positions), DIRECTIONS, 3))
        towards = self.emitters.directions_from(positions)
        rays = RayGroup(positions - volume.origin_world, None, np.concatenate([evenly, towards], axis=1))
        return LookUp(self, volume, positions, towards, begin_arrivals(engine, volume, [rays]))

    def arriving(self, look_up: LookUp) -> list[PlaceLight]:
        """The light at each position of a look-up of this solution."""
        positions, arrivals = look_up.positions, look_up.rays.results()[0]
        met = self._met(positions, look_up_directions()[0], arrivals[:, :DIRECTIONS])
        visible = self.emitters.visible(look_up.volume, positions, arrivals[:, DIRECTIONS:])
        rays = self._with_emitters(positions, look_up.towards, met, visible)
        return [self._arriving(position, of_place) for position, of_place in zip(positions, rays, strict=True)]

    def beyond(self, positions: Floats, bands: int) -> tuple[Floats, Floats, list[ShellLamp]]:
        """The light from the shell as seen from `positions` [n, 3] (world), with no surface in between.

        [n, bands^2, 3] the whole, [n, bands^2, 3] what its lamps leave, and the lamps as they are seen from the middle.
        """
        asked = positions.tobytes(), bands
        if asked not in self._beyond:
            self._beyond.clear()
            self._beyond[asked] = self._seen_beyond(positions, bands)
        return self._beyond[asked]

    def beyond_at(self, position: Floats) -> Floats:
        """[BANDS^2, 3] the whole of `beyond` at one position [3]."""
        return self._whole(position, self._sent_by_shell(position)[1], BANDS)

    def estimate(self, bands: int) -> LightEstimate:
        """The light from beyond the scan, the same for all places."""
        if bands not in self._estimates:
            self._estimates[bands] = distant_light(self.distant, bands)
        return self._estimates[bands]

    def _seen_beyond(self, positions: Floats, bands: int) -> tuple[Floats, Floats, list[ShellLamp]]:
        middle = positions.mean(axis=0)
        ends, radiance, blur_m2 = self._sent_by_shell(middle)
        sent = self._sent_by_emitters
        emitting = emitting_lamps(middle, self.emitters, sent, 4 * np.pi / DIRECTIONS * float(radiance.sum()))
        emitted = DIRECTIONS / (4 * np.pi) * float((self._emitting_angles(middle) @ sent).sum())
        lamps, parts = find_lamps(middle, ends, radiance, blur_m2, MOST_LIGHTS - len(emitting), emitted)
        whole, rest = [], []
        for position in positions:
            ends, radiance, _ = self._sent_by_shell(position)
            whole.append(self._whole(position, radiance, bands))
            rest.append(_basis(bands) @ parts.rest(ends, radiance))
        return np.array(whole), np.array(rest), [*emitting, *lamps]

    def _whole(self, position: Floats, from_shell: Floats, bands: int) -> Floats:
        """[bands^2, 3] of the shell and the emitters. from_shell: [DIRECTIONS, 3]."""
        towards = sh_basis(self.emitters.directions_from(position[None])[0], bands)
        from_emitters = towards.T @ (self._emitting_angles(position)[:, None] * self._sent_by_emitters)
        return np.asarray(_basis(bands) @ from_shell + from_emitters)

    def _sent_by_shell(self, position: Floats) -> tuple[Floats, Floats, Floats]:
        """[DIRECTIONS, 3] where look-up directions from `position` end on the shell, its radiance, likewise, and
        [DIRECTIONS] Shell.blur_m2 there."""
        directions = look_up_directions()[0]
        start = np.broadcast_to(position, directions.shape)
        cells, shares = self.shell.exits(start, directions)
        ends = position + self.shell.distances(start, directions).min(axis=-1)[:, None] * directions
        radiance = np.einsum("mc,mcr->mr", shares, self.near.radiance[cells])
        return ends, radiance, self.shell.blur_m2[cells[:, 0] // SIDE**2]

    def _emitting_angles(self, position: Floats) -> Floats:
        """[k] sr under which each emitter is seen from `position`."""
        return np.asarray(self.emitters.presence * self.emitters.solid_angles(position[None])[0])

    @property
    def _sent_by_emitters(self) -> Floats:
        """[k, 3] radiance beyond what is photographed."""
        columns = columns_of(self.hidden, bright_keys(self.emitters.centers))
        is_known = (columns >= 0) & (columns < self.near.known)
        return np.where(is_known[:, None], self.near.radiance[np.where(is_known, columns, 0)], 0.0)

    def _met(self, positions: Floats, directions: Floats, arrivals: NDArray[np.float32]) -> Met:
        """What rays from `positions` [n, 3] along `directions` [m, 3] met; cells that the solution does not have are
        NO_CELL. arrivals: [n, m, 4] as of trace_arrivals."""
        turned = np.broadcast_to(directions, (len(positions), *directions.shape))
        met = meet(self.shell, self.hidden, positions, turned, arrivals.astype(np.float64))
        is_known = met.columns < self.near.known
        columns, shares = np.where(is_known, met.columns, NO_CELL), np.where(is_known, met.shares, 0.0)
        return replace(met, columns=columns, shares=shares)

    def _with_emitters(self, positions: Floats, towards: Floats, met: Met, visible: NDArray[np.bool_]) -> list[_Rays]:
        """What evenly spread rays from `positions` [n, 3] met, and rays `towards` [n, k, 3] the emitters, `visible`
        [n, k] or not."""
        emitters = self.emitters
        solid_angles = emitters.solid_angles(positions)
        weights = emitters.weights(solid_angles / (4 * np.pi), DIRECTIONS)
        place, ray = np.nonzero(met.is_saturated)
        ends = positions[place] + met.distances[place, ray, None] * look_up_directions()[0, ray]
        shares = met.shares.copy()
        shares[place, ray] *= emitters.left_to_others(weights, place, ends)[:, None]
        columns = columns_of(self.hidden, bright_keys(emitters.centers))
        columns = np.where(columns < self.near.known, columns, NO_CELL)
        brought = weights * solid_angles * visible * (columns >= 0)
        basis = sh_basis(towards.reshape(-1, 3), BANDS).reshape(*brought.shape, BANDS * BANDS)
        return [
            _Rays(
                np.concatenate([_basis(), basis[k].T * brought[k]], axis=1),
                np.concatenate([met.columns[k], np.repeat(columns[:, None], CORNERS, axis=1)]),
                np.concatenate([shares[k], np.eye(1, CORNERS).repeat(len(columns), axis=0)]),
                np.concatenate([met.known[k], np.zeros((len(columns), 3))]),
            )
            for k in range(len(positions))
        ]

    def _radiance_of(self, met: Met | _Rays) -> Floats:
        """[..., 3]."""
        cells = self.near.radiance[np.maximum(met.columns, 0)]
        radiance = met.known + np.einsum("...c,...cr->...r", met.shares, cells)
        is_new = (met.columns[..., 0] == NO_CELL) & (met.known.max(axis=-1) <= 0)
        # Where it is new, no patch has received light from there.
        return np.asarray(np.where(is_new[..., None], np.exp(self.near.mean), radiance))

    def _arriving(self, position: Floats, rays: _Rays) -> PlaceLight:
        radiance = self._radiance_of(rays)
        sh = rays.basis @ radiance
        luminance = radiance @ LUMINANCE
        covariance = self.near.covariance_of(self._gradient(rays))
        tint = radiance.mean(axis=0) / max(float(luminance.mean()), 1e-12)
        angle = spread_deg(sh @ LUMINANCE, covariance)
        return PlaceLight(
            position=position,
            sh=sh,
            std=deviations(sh, covariance, tint),
            spread_deg=angle,
            valid=angle <= VALID_SPREAD_DEG,
            seen=float((rays.columns[:DIRECTIONS, 0] == KNOWN).mean()),
        )

    def _gradient(self, rays: _Rays) -> Floats:
        """[bands^2, known] of coefficients of luminance by z."""
        is_cell = rays.columns >= 0
        cells = rays.columns[is_cell]
        sent = rays.shares[is_cell] * (self.near.radiance @ LUMINANCE)[cells]
        ends = np.concatenate([[0], np.cumsum(is_cell.sum(axis=1))])
        by_ray = csc_matrix((sent, cells, ends), shape=(self.near.known, len(is_cell)))
        return np.asarray((by_ray @ rays.basis.T).T)


@dataclass(frozen=True)
class LookUp:
    """Rays from places on their way, for Solution.arriving."""

    solution: Solution
    volume: Volume
    positions: Floats
    """[n, 3] world."""
    towards: Floats
    """[n, k, 3] unit, to the solution's emitters."""
    rays: PendingArrivals
    """Along look_up_directions, then towards the solution's emitters."""
