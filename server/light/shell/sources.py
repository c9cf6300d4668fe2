"""Where light may come from, as columns of the objective: cells of the shell, lobes at infinity, hidden surface."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from server.light.light_estimation import LEAST_OPENNESS
from server.light.shell import weights
from server.light.shell.evidence import DARKEST, log_chroma
from server.light.shell.patches import Patches
from server.light.shell.shell import CELLS, SIDE, Shell, neighbours
from server.light.shell.transport import Transport
from server.maths.lobes import LOBES, lobe_directions

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_PAIRS = neighbours()


@dataclass(frozen=True)
class Floor:
    """The shell's floor sends back what arrives there."""

    shares: NDArray[np.float32]
    """[SIDE^2, CELLS] as Transport.floor."""
    is_scanned: NDArray[np.bool_]
    """[n] patches that are of scanned floor."""


@dataclass(frozen=True)
class Sources:
    """Sources of one radiance each, and what is known of them beforehand. [n] patches, [k] sources."""

    shares: NDArray[np.float32]
    """[n, k] of a patch's cosine-weighted hemisphere."""
    known: Floats
    """[n, 3] radiance that photographed surface brings."""
    clipped: Floats
    """[k, 3] radiance of saturated sources as pictures show it, 0 for others."""
    is_saturated: NDArray[np.bool_]
    offset: Floats
    """[k] prior mean of the log radiance over the mean; of saturated ones, of their relative excess."""
    deviation: Floats
    """[k] standard deviation of it; of lobes, that of a normal distribution as wide where theirs is highest."""
    pairs: Ints
    """[m, 2] neighbours."""
    lobes: int = 0
    """Number of lobes, which come first; the prior of their radiance is a gamma distribution, highest at `offset`."""
    finds_level: bool = True
    """The mean albedo of the materials, and so the level of the light, is found with the rest; else it is given."""
    least_share: float = 0.0
    """Patches that receive less than this share of their light from sources and known surface say nothing."""
    floor: Floor | None = None
    """Where the first CELLS sources are the shell's. None: its floor is like all that is not seen."""

    @property
    def count(self) -> int:
        """Number of sources."""
        return len(self.offset)

    @cached_property
    def known_logs(self) -> Floats:
        """[n, 3] as of log_chroma, of what photographed surface brings."""
        return log_chroma(np.log(np.maximum(self.known, DARKEST)))

    @cached_property
    def known_level(self) -> Floats:
        """[n] exp of its mean logarithm over the channels; 0 where there is none."""
        return np.where(self.known.max(axis=1) > 0, np.exp(self.known_logs[:, 0]), 0.0)

    @cached_property
    def says_nothing(self) -> NDArray[np.bool_]:
        """[n] patches that receive no more than `least_share` of their light from all that is here."""
        return np.asarray((self.known_level == 0) & (self.shares.sum(axis=1) <= self.least_share))


def near_sources(transport: Transport, shell: Shell, patches: Patches, rows: Ints) -> Sources:
    """All that is not scanned lies on the shell, for the `patches` in `rows` [n]."""
    count = transport.columns
    offset, deviation = _priors(transport)
    deviation[:CELLS] = np.where(shell.is_low, weights.CELL_LOW, weights.CELL_HIGH)
    return Sources(
        shares=transport.shares[rows, :count],
        known=transport.known[rows],
        clipped=transport.clipped[:count],
        is_saturated=transport.is_saturated[:count],
        offset=offset,
        deviation=deviation,
        pairs=_PAIRS,
        floor=Floor(transport.floor, shell.is_on_floor(patches.positions[rows], patches.normals[rows])),
    )


def _priors(transport: Transport) -> tuple[Floats, Floats]:
    """[k] offset and deviation of Sources; those of hidden surface for the shell's cells."""
    count = transport.columns
    is_saturated, lit = transport.is_saturated[:count], transport.lit[:count]
    offset = lit * np.log(weights.LIT_EXCESS) + (1 - lit) * np.log(weights.LAMP_EXCESS)
    spread = lit * weights.LIT_SPREAD + (1 - lit) * weights.LAMP_SPREAD
    return np.where(is_saturated, offset, 0.0), np.where(is_saturated, spread, weights.CELL_HIDDEN)


def distant_sources(transport: Transport, closed: Floats, up: Floats, rows: Ints, *, with_indirect: bool) -> Sources:
    """What leaves through open sides of the shell goes to infinity; closed sides are wall.

    closed: [6] from 0, open, to 1. up: [3] unit, world. The first LOBES sources are the lobes. with_indirect: surfaces
    send light.
    """
    columns = np.flatnonzero(~transport.is_lamp[: transport.columns])
    count = len(columns)
    is_closed = closed.astype(np.float32)
    beyond = np.einsum("nfl,f->nl", transport.beyond[rows], 1 - is_closed)
    shares = np.empty((len(rows), LOBES + count), np.float32)
    shares[:, :LOBES], near = beyond, shares[:, LOBES:]
    near[:] = transport.shares[rows][:, columns]
    near[:, :CELLS] *= np.repeat(is_closed, SIDE * SIDE)
    known = transport.known[rows]
    if not with_indirect:
        near[:, CELLS:], known = 0.0, np.zeros_like(known)
    offset, deviation = (prior[columns] for prior in _priors(transport))
    return Sources(
        shares=shares,
        known=known,
        clipped=np.concatenate([np.zeros((LOBES, 3)), transport.clipped[columns]]),
        is_saturated=np.concatenate([np.zeros(LOBES, bool), transport.is_saturated[columns]]),
        offset=np.concatenate([np.log(weights.LOBE) + weights.LOBE_UP * (lobe_directions() @ up), offset]),
        deviation=np.concatenate([np.full(LOBES, weights.LOBE_SHAPE**-0.5), deviation]),
        pairs=_PAIRS + LOBES,
        lobes=LOBES,
        finds_level=False,
        least_share=0.0 if with_indirect else LEAST_OPENNESS,
    )
