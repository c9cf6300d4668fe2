"""Differences from a mean picture against their float64 twin."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from server.opencl.engine import Engine
from server.reuse.frame_difference import MeanPicture
from tests.reference import frame_difference as twin

KINDS = {"color": (3, np.uint8, 255), "linear color": (3, np.uint16, 65535), "depth": (1, np.uint16, 65535)}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [(64, 48), (61, 43), (5, 3)])
def test_matches_twin(engine: Engine, kind: str, size: tuple[int, int]) -> None:
    channels, dtype, top = KINDS[kind]
    rng = np.random.default_rng(len(kind) + size[0])
    shape: tuple[int, ...] = (size[1], size[0], 3) if channels == 3 else (size[1], size[0])
    scene = rng.uniform(0, top, shape)
    pictures: list[Any] = [np.rint(scene + rng.normal(0, top / 50, shape)).clip(0, top).astype(dtype) for _ in "abcd"]
    for picture in pictures:
        picture[rng.random(shape) < 0.1] = 0
        picture[rng.random(shape) < 0.1] = top
    mean = MeanPicture(engine)
    for picture in pictures[:-1]:
        mean.add(mean.upload(picture))
    found = mean.compare(mean.upload(pictures[-1]))

    exact = twin.mean_of([picture.astype(np.float64) for picture in pictures[:-1]])
    sums, squares, count, flipped = twin.differences(pictures[-1].astype(np.float64), exact).T
    np.testing.assert_array_equal(found.count, count)
    np.testing.assert_array_equal(found.flipped, flipped)
    known = np.maximum(count, 1)
    # 192 numbers are added one after the other; a mean is off by some units in the last place of its greatest.
    np.testing.assert_allclose(found.mean, sums / known, atol=200 * top * 2.0**-24)
    np.testing.assert_allclose(found.mean_square, squares / known, rtol=4e-5, atol=1e-9 * top**2)


def test_it_begins_anew(engine: Engine) -> None:
    mean = MeanPicture(engine)
    mean.add(mean.upload(np.full((9, 9), 1000, np.uint16)))
    mean.forget()
    mean.add(mean.upload(np.zeros((9, 9), np.uint16)))
    found = mean.compare(mean.upload(np.full((9, 9), 1000, np.uint16)))
    assert found.flipped.sum() == 81
    assert not found.count.any()
