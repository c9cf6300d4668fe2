"""The distinct rows of a table of whole numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_MOST = 1 << 62

Ints = NDArray[np.int64]


def distinct_rows(rows: Ints) -> tuple[Ints, Ints]:
    """[k, c] the distinct ones of `rows` [n, c] in ascending order, and [n] which of them each row is.

    As np.unique along axis 0, which takes ten times as long: it compares rows, here each becomes one number.
    """
    if not rows.size:
        return rows, np.zeros(len(rows), np.int64)
    low = rows.min(axis=0)
    spans = [int(span) for span in rows.max(axis=0) - low + 1]
    if np.prod([float(span) for span in spans]) > _MOST:
        found, inverse = np.unique(rows, axis=0, return_inverse=True)
        return found, inverse.ravel()
    numbers, inverse = np.unique(np.ravel_multi_index(tuple((rows - low).T), spans), return_inverse=True)
    return np.stack(np.unravel_index(numbers, spans), axis=1) + low, inverse
