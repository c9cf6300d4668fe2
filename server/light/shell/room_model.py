"""The light of one room, from the pictures so far: evidence, solution, and the light that arrives at a place."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from server.frame_context import FrameContext
from server.light.arrivals import trace_arrivals
from server.light.light_estimation import LightEstimate
from server.light.place_light import VALID_SPREAD_DEG, PlaceLight
from server.light.shell.distant import distant_light
from server.light.shell.evidence import evidence_of
from server.light.shell.known_room import KnownRoom
from server.light.shell.lamps import ShellLamp, find_lamps
from server.light.shell.objective import Unknowns, step
from server.light.shell.patches import PATCH_M, Patches, Seen, gather_patches
from server.light.shell.shell import Shell, closed_sides, shell_around
from server.light.shell.sources import distant_sources, near_sources
from server.light.shell.spread import spread_deg
from server.light.shell.switches import Switches
from server.light.shell.transport import KNOWN, NO_CELL, Met, Transport
from server.maths.sh import LUMINANCE, sh_basis, spherical_fibonacci
from server.opencl.engine import Engine
from server.volume.volume import Volume

BANDS = 4
DIRECTIONS = 1024
"""Directions in which the light at a place is looked up: 16 coefficients of a lamp of 10 degrees are good to 3 %."""
MOST_STEPS = 16
"""Gauss-Newton steps of a frame: one, and others while the last one changed what patches receive by more than MOVED."""
MOVED, FIRST_MOVED = 0.05, 0.01
"""Of a logarithm; the second in a first frame, whose solution the others follow."""
LEAST_PATCHES = 12
"""Patches below which nothing is said."""
STEADY, CHANGED = 0.2, 0.3
"""Changes of log radiance, root mean square over the ways that patches face of their median: up to the first (.19 at
most in the real kitchen, whose exposure varies, .03 in rooms) nothing is forgotten, from the second (a lamp that goes
45 degrees around a table makes .32) everything is."""
SOLVE_EVERY = 3
"""Frames that one solution takes in, as long as the light is steady and little of the room is new: what frames show is
summed in between. The goal is that a change is followed within three."""
NEW_SHARE = 0.1
"""Share of new patches, or of frames that were not taken in, from which a frame is solved at once."""
STILL = 0.005
"""Change of the mean log radiance of patches, root mean square, or of what they receive by the last step, up to which
the solution stays as it is: half a per cent is less than a code of a picture."""
LEAST_FACING = 5
"""Patches that face one way, for a median."""

Floats = NDArray[np.float64]


@cache
def look_up_directions() -> Floats:
    """[1, DIRECTIONS, 3] unit, evenly spread."""
    return spherical_fibonacci(DIRECTIONS)[None]


@cache
def _basis(bands: int = BANDS) -> Floats:
    """[bands^2, DIRECTIONS] weights that project radiance on spherical harmonics."""
    return np.asarray(4 * np.pi / DIRECTIONS * sh_basis(look_up_directions()[0], bands).T)


class RoomModel:
    """Radiance of all that is not scanned surface, with the evidence for it. World axes and metres."""

    def __init__(self, switches: Switches | None = None) -> None:
        self._switches = switches or Switches()
        self._patches = Patches()
        self._transport = Transport()
        self._unknowns, self._distant = Unknowns(), Unknowns()
        self._shell: Shell | None = None
        self._waiting = self._frames = 0
        self._solved = np.zeros(0, np.int64), np.zeros((0, 3))
        """Rows of the patches of the last solution, and what they showed."""
        self._beyond: tuple[bytes, int, tuple[Floats, Floats, list[ShellLamp]]] | None = None

    @property
    def is_known(self) -> bool:
        """Whether anything has been solved."""
        return self._unknowns.known > 0

    def update(self, context: FrameContext, up: Floats) -> None:
        """Fold in one frame and take a step. up: [3] unit, world."""
        engine, volume, switches = context.engine, context.volume, self._switches
        seen = gather_patches(engine, context.camera, context.surface, context.scene_radiance, volume)
        if not seen.count:
            return
        change = self._change(seen) if switches.memory else 1.0
        self._patches.forget(change)
        self._patches.add(seen)
        self._waiting, self._frames = self._waiting + 1, self._frames + 1
        if not self._is_due(change):
            return
        traced = self._patches.trace(engine, volume, self._waiting)
        self._waiting, self._beyond = 0, None
        camera = context.volume_from_camera[:3, 3] + volume.origin_world
        with engine.profile.host():
            self._solve(traced, camera, up)

    def _is_due(self, change: float) -> bool:
        """Whether to solve with this frame. change: share of the evidence that it contradicts."""
        if not self.is_known or change > 0.0 or self._patches.fresh > NEW_SHARE * self.patches:
            return True
        return self._waiting > min(SOLVE_EVERY - 1, NEW_SHARE * self._frames) and not self._is_still()

    def _is_still(self) -> bool:
        """Whether what patches show has not changed since the last solution, which has settled."""
        rows, shown = self._solved
        moved = self._patches.logarithms[rows] - shown
        is_same = self._patches.fresh == 0 and float(np.sqrt(np.mean(moved**2))) <= STILL
        return is_same and self._unknowns.step <= STILL and self._distant.step <= STILL

    def _solve(self, traced: NDArray[np.int64], camera: Floats, up: Floats) -> None:
        patches, transport, switches, rows = self._patches, self._transport, self._switches, self._patches.used
        if len(rows) < LEAST_PATCHES:
            return
        positions, normals = patches.positions[rows], patches.normals[rows]
        self._shell = shell_around(positions, normals, camera[None], up, PATCH_M, self._shell)
        transport.update(patches, traced, self._shell)
        closed = closed_sides(positions, normals, self._shell.axes, PATCH_M)
        evidence = evidence_of(patches, rows, switches)
        near = near_sources(transport, self._shell, rows)
        distant = distant_sources(transport, closed, rows, with_indirect=switches.indirect)
        is_followed = self.is_known and switches.memory
        for unknowns, sources in ((self._unknowns, near), (self._distant, distant)):
            for _ in range(MOST_STEPS):
                step(unknowns, evidence, sources, switches)
                if unknowns.step < (MOVED if is_followed else FIRST_MOVED):
                    break
        self._solved = rows, patches.logarithms[rows]

    def estimate(self, bands: int) -> LightEstimate:
        """The light from beyond the scan."""
        return distant_light(self._distant, bands)

    def known(self) -> KnownRoom:
        """What it is solved from."""
        return KnownRoom(self._patches.known(), self._shell)

    def resume(self, known: KnownRoom) -> None:
        """Go on from there, with the next frame."""
        self._patches.resume(known.patches)
        self._shell = known.shell

    @property
    def patches(self) -> int:
        """Patches whose rays were traced."""
        return len(self._patches.used)

    def _change(self, seen: Seen) -> float:
        """Share of the evidence that a picture contradicts, from 0 to 1."""
        changes, facing = self._patches.changes(seen)
        counts = np.bincount(facing) if len(facing) else np.zeros(0)
        many = np.flatnonzero(counts >= LEAST_FACING)
        if counts[many].sum() < LEAST_PATCHES:
            return 0.0
        medians = np.array([np.median(changes[facing == number]) for number in many])
        change = np.sqrt(np.average(medians**2, weights=counts[many]))
        return float(np.clip((change - STEADY) / (CHANGED - STEADY), 0.0, 1.0))

    def radiance_at(self, engine: Engine, volume: Volume, position: Floats, directions: Floats) -> Floats:
        """[m, 3] radiance that arrives at `position` [3] (world) against `directions` [m, 3]; needs `is_known`."""
        return np.asarray(self._radiance_of(self._looked_up(engine, volume, position[None], directions[None]))[0])

    def arriving_at(self, engine: Engine, volume: Volume, positions: Floats) -> list[PlaceLight]:
        """The light at each of `positions` [n, 3] (world); needs `is_known`."""
        met = self._looked_up(engine, volume, positions, look_up_directions())
        radiance = self._radiance_of(met)
        places = zip(positions, radiance, met.columns, met.shares, strict=True)
        return [self._arriving(position, one, columns, shares) for position, one, columns, shares in places]

    def beyond(self, position: Floats, bands: int) -> tuple[Floats, Floats, list[ShellLamp]]:
        """The light from the shell as seen from `position` [3] (world), with no surface in between.

        [bands^2, 3] the whole, [bands^2, 3] what its lamps leave, and the lamps; needs `is_known`. Kept until the next
        solution.
        """
        asked = position.tobytes(), bands
        if self._beyond is None or self._beyond[:2] != asked:
            self._beyond = *asked, self._seen_beyond(position, bands)
        return self._beyond[2]

    def _seen_beyond(self, position: Floats, bands: int) -> tuple[Floats, Floats, list[ShellLamp]]:
        assert self._shell is not None
        directions = look_up_directions()[0]
        start = np.broadcast_to(position, directions.shape)
        cells, shares = self._shell.exits(start, directions)
        ends = position + self._shell.distances(start, directions).min(axis=-1)[:, None] * directions
        radiance = np.einsum("mc,mcr->mr", shares, self._unknowns.radiance[cells])
        lamps, rest = find_lamps(position, ends, radiance)
        return _basis(bands) @ radiance, _basis(bands) @ rest, lamps

    def _looked_up(self, engine: Engine, volume: Volume, positions: Floats, directions: Floats) -> Met:
        """What rays [n, m] meet; cells that the solution does not have are NO_CELL."""
        assert self._shell is not None
        arrivals = trace_arrivals(engine, volume, positions - volume.origin_world, None, directions)
        turned = np.broadcast_to(directions[0], (len(positions), *directions[0].shape))
        met = self._transport.meet(self._shell, positions, turned, arrivals.astype(np.float64))
        return replace(met, columns=np.where(met.columns < self._unknowns.known, met.columns, NO_CELL))

    def _radiance_of(self, met: Met) -> Floats:
        """[n, m, 3]."""
        cells = self._unknowns.radiance[np.maximum(met.columns, 0)]
        radiance = met.known + np.einsum("nmc,nmcr->nmr", met.shares, cells)
        mean = np.exp(self._unknowns.mean)
        is_new = (met.columns[..., 0] == NO_CELL)[..., None]  # surface of which no patch has received light
        unseen = np.where(met.at_least.max(axis=-1, keepdims=True) > 0, met.at_least, mean)
        return np.where(is_new, unseen, np.maximum(radiance, met.at_least))

    def _arriving(self, position: Floats, radiance: Floats, columns: NDArray[np.int64], shares: Floats) -> PlaceLight:
        sh = _basis() @ radiance
        luminance = radiance @ LUMINANCE
        covariance, _ = self._unknowns.covariance_of(self._gradient(columns, shares))
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
        sent = shares[ray, corner] * (self._unknowns.radiance @ LUMINANCE)[cells]
        bands = BANDS * BANDS
        place = cells * bands + np.arange(bands)[:, None]
        sums = np.bincount(place.ravel(), (_basis()[:, ray] * sent).ravel(), self._unknowns.known * bands)
        return np.asarray(sums.reshape(-1, bands).T)
