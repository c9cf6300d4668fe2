"""float64 twin of light_table.cl."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tests.reference.sh import sh_basis

Floats = NDArray[np.float64]


def arriving(sh: Floats, directions: Floats) -> Floats:
    """[places, n, 3] radiance, at least 0, of lights `sh` [places, bands^2, 3] from unit `directions` [n, 3]."""
    return np.maximum(sh_basis(directions, round(sh.shape[1] ** 0.5)) @ sh, 0.0)
