"""Twin of shadow_cell in kept_shadows.clh, in plain integers."""

from __future__ import annotations

import numpy as np

from tests.reference.transfer_cache import cell_of, mixed
from tests.scenes.analytic import Floats

FACINGS = 5


def shadow_cell_of(
    position: Floats, normal: Floats, which: int, eye: Floats, spacing: float, places: int
) -> tuple[tuple[int, int], int]:
    """Key and place of the cell around a point of object `which`, -1 for real surface."""
    cell = cell_of(position, normal, eye, spacing, places)
    x, y, z = (int(v) + FACINGS // 2 for v in np.rint(normal * (FACINGS // 2)))
    own = 0 if which < 0 else 1 + ((which * FACINGS + z) * FACINGS + y) * FACINGS + x
    key = cell.key[0], cell.key[1] ^ mixed(own)
    return key, mixed(key[0] ^ mixed(key[1])) & (places - 1)
