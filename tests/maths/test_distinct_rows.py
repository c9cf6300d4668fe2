"""Distinct rows, beside NumPy's own."""

from __future__ import annotations

import numpy as np
import pytest

from server.maths.distinct_rows import distinct_rows


@pytest.mark.parametrize("spread", [1, 3, 1000, 1 << 40], ids=["one", "few", "many", "too far apart for one number"])
@pytest.mark.parametrize("shape", [(1, 3), (400, 3), (900, 6)], ids=str)
def test_rows_are_numpys(spread: int, shape: tuple[int, int]) -> None:
    random = np.random.default_rng(4)
    rows = random.integers(-spread, spread, shape)
    rows = np.concatenate([rows, rows[random.integers(0, len(rows), 50)]])
    expected, places = np.unique(rows, axis=0, return_inverse=True)
    found, inverse = distinct_rows(rows)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(inverse, places.ravel())


def test_no_rows() -> None:
    found, inverse = distinct_rows(np.zeros((0, 3), np.int64))
    assert (found.shape, inverse.shape) == ((0, 3), (0,))
