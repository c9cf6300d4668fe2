"""What one solution of the objective says of a room: the light that arrives at a place, and what its shell sends."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix

from server.light.arrivals import PendingArrivals, RayGroup, begin_arrivals, trace_arrivals
from server.light.light_estimation import LightEstimate
from server.light.place_light import VALID_SPREAD_DEG, PlaceLight
from server.light.shell.distant import distant_light
from server.light.shell.emitters import Emitters
from server.light.shell.lamps import ShellLamp, emitting_lamps, find_lamps
from server.light.shell.patches import Patches
from server.light.shell.shell import SIDE, Shell
from server.light.shell.solved import Solved
from server.light.shell.spread import deviations, spread_deg
from server.light.shell.transport import KNOWN, NO_CELL, Met, columns_of, emitter_keys, meet
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
        met = self._met(position[None], directions, arrivals)
        radiance = np.array(self._radiance_of(met)[0], np.float64)
        lamp = self.emitters.lamp_met(position, directions, met.distances[0])
        radiance[lamp >= 0] = self._sent_by_emitters[1][lamp[lamp >= 0]]
        return radiance

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
        met, to_sh = self._with_emitters(positions, look_up.towards, met, visible)
        columns, sent = self._sent_by_emitters
        sh = _basis() @ self._radiance_of(met) + to_sh @ sent
        luminance, tints = sh @ LUMINANCE, sh[:, 0] / np.maximum(sh[:, :1] @ LUMINANCE, 1e-12)
        gradients = self._gradients(met)
        for column, gradient in zip(columns, (to_sh * (sent @ LUMINANCE)).transpose(2, 0, 1), strict=True):
            gradients[:, column] += gradient  # several emitters may share the last one
        covariances = self.near.covariance_of(gradients.swapaxes(1, 2))
        seen = (met.columns[..., 0] == KNOWN).mean(axis=1)
        return [
            _place_light(*of_place)
            for of_place in zip(positions, sh, luminance, covariances, tints, seen.tolist(), strict=True)
        ]

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
        _, sent = self._sent_by_emitters
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
        from_emitters = towards.T @ (self._emitting_angles(position)[:, None] * self._sent_by_emitters[1])
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

    @cached_property
    def _sent_by_emitters(self) -> tuple[NDArray[np.int64], Floats]:
        """[k] columns, and [k, 3] radiance beyond what is photographed, 0 where no patch has received light."""
        columns = columns_of(self.hidden, emitter_keys(self.emitters))
        is_known = (columns >= 0) & (columns < self.near.known)
        columns = np.where(is_known, columns, 0)
        return columns, np.where(is_known[:, None], self.near.radiance[columns], 0.0)

    def _met(self, positions: Floats, directions: Floats, arrivals: NDArray[np.float32]) -> Met:
        """What rays from `positions` [n, 3] along `directions` [m, 3] met; cells that the solution does not have are
        NO_CELL. arrivals: [n, m, 4] as of trace_arrivals."""
        turned = np.broadcast_to(directions, (len(positions), *directions.shape))
        met = meet(self.shell, self.hidden, positions, turned, arrivals)
        is_known = met.columns < self.near.known
        columns, shares = np.where(is_known, met.columns, NO_CELL), np.where(is_known, met.shares, 0.0)
        return replace(met, columns=columns, shares=shares)

    def _with_emitters(
        self, positions: Floats, towards: Floats, met: Met, visible: NDArray[np.bool_]
    ) -> tuple[Met, Floats]:
        """What evenly spread rays from `positions` [n, 3] met, less what rays `towards` [n, k, 3] the emitters,
        `visible` [n, k] or not, bring; and [n, bands^2, k] weights that project what emitters send on harmonics."""
        emitters = self.emitters
        solid_angles = emitters.solid_angles(positions)
        weights = emitters.weights(solid_angles / (4 * np.pi), DIRECTIONS)
        place, ray = np.nonzero(met.is_saturated)
        ends = positions[place] + met.distances[place, ray, None] * look_up_directions()[0, ray]
        shares = met.shares.copy()
        shares[place, ray] *= emitters.left_to_others(weights, place, ends)[:, None]
        basis = sh_basis(towards.reshape(-1, 3), BANDS).reshape(*towards.shape[:2], BANDS * BANDS)
        brought = weights * solid_angles * visible
        return replace(met, shares=shares), (basis * brought[..., None]).swapaxes(1, 2)

    def _radiance_of(self, met: Met) -> NDArray[np.floating]:
        """[..., 3]."""
        radiance = met.known.copy()
        is_cell, is_new = met.columns[..., 0] >= 0, met.columns[..., 0] == NO_CELL
        cells = self.near.radiance[met.columns[is_cell]]
        radiance[is_cell] += np.einsum("nc,ncr->nr", met.shares[is_cell], cells)
        # Where it is new, no patch has received light from there.
        radiance[is_new] = np.where(radiance[is_new].any(axis=-1)[:, None], radiance[is_new], np.exp(self.near.mean))
        return radiance

    def _gradients(self, met: Met) -> Floats:
        """[n, known, bands^2] of coefficients of luminance by z, of evenly spread rays from n places."""
        columns, shares = (np.moveaxis(part, 0, 1) for part in (met.columns, met.shares))  # by ray
        ray, place, corner = np.nonzero(columns >= 0)
        cells = columns[ray, place, corner]
        sent = shares[ray, place, corner] * (self.near.radiance @ LUMINANCE)[cells]
        starts, count = np.searchsorted(ray, np.arange(DIRECTIONS + 1)), len(met.columns)
        shape = (count * self.near.known, DIRECTIONS)
        by_ray = csc_matrix((sent, place * self.near.known + cells, starts), shape=shape)
        return np.asarray(by_ray @ _basis().T).reshape(count, self.near.known, BANDS * BANDS)


def _place_light(
    position: Floats, sh: Floats, luminance: Floats, covariance: Floats, tint: Floats, seen: float
) -> PlaceLight:
    angle = spread_deg(luminance, covariance)
    std = deviations(sh, covariance, tint)
    return PlaceLight(position, sh, std, angle, valid=angle <= VALID_SPREAD_DEG, seen=seen)


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
