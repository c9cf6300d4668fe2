"""What of a room's model outlasts its session: the patches and the shell. Rays are traced and light is solved anew."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from server.light.shell.shell import Shell

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class KnownPatches:
    """The patches of a room, see Patches; n of them."""

    keys: NDArray[np.int64]
    """[n, 7]; in saves of programs with one grid, [n, 6]."""
    positions: Floats
    normals: Floats
    logarithms: Floats
    """[n, 3] each."""
    variances: Floats
    clipped: Floats
    weights: Floats
    """[n] each."""
    side_m: float = 0.15
    """Of the grids' cells. Saves of earlier programs do not tell it: it was this one."""


@dataclass(frozen=True)
class KnownRoom:
    """State of a room's model."""

    patches: KnownPatches
    shell: Shell | None
