"""Discs of the light at objects: none under an object, all of it from a radius off the box on."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from server.maths.direct_lights import DirectLight, SplitLight, lamp_at
from server.shading.touched_discs import without_touched
from tests.scenes.analytic import Floats

RADIUS_M = 0.1
DISTANT = DirectLight(np.array([0.0, 0.0, 1.0]), np.ones(3), 0.1)


class Box:
    """What is asked of an object: 2 x 4 x 6 units of its own."""

    bounds = (np.array([-1.0, -2.0, -3.0]), np.array([1.0, 2.0, 3.0]))


def placed(scale_m: float = 0.1) -> tuple[Any, Floats]:
    """Turned by a quarter about z, at (1, 2, 3)."""
    volume_from_model = np.eye(4)
    volume_from_model[:3, :3] = scale_m * np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    volume_from_model[:3, 3] = (1.0, 2.0, 3.0)
    return Box(), volume_from_model


def left_of(offset_m: Floats) -> float:
    """Share that is left of a disc whose middle is `offset_m` [3] from the box's."""
    disc = lamp_at(np.array([1.0, 2.0, 3.0]) + offset_m, RADIUS_M, np.ones(3))
    split = SplitLight(np.zeros((16, 3)), (DISTANT, disc))
    found = without_touched(split, [placed()]).discs
    np.testing.assert_array_equal(found[0].irradiance, DISTANT.irradiance)
    return float(found[1].irradiance[0] / disc.irradiance[0]) if len(found) > 1 else 0.0


@pytest.mark.parametrize(
    ("offset_m", "share"),
    [
        ((0.0, 0.0, 0.0), 0.0),
        ((0.19, 0.0, 0.0), 0.0),  # inside: the long side lies along x of the volume
        ((0.0, 0.0, -0.31), 0.1),
        ((0.25, 0.0, 0.0), 0.5),
        ((0.0, 0.15, 0.0), 0.5),
        ((0.0, 0.17, 0.37), 0.07 * 2**0.5 / RADIUS_M),
        ((0.0, 0.21, 0.0), 1.0),
        ((1.0, 1.0, 1.0), 1.0),
    ],
)
def test_a_disc_fades_towards_an_object(offset_m: tuple[float, ...], share: float) -> None:
    assert left_of(np.array(offset_m)) == pytest.approx(share, abs=1e-9)


def test_without_objects_nothing_is_left_out() -> None:
    split = SplitLight(np.zeros((16, 3)), (DISTANT, lamp_at(np.zeros(3), RADIUS_M, np.ones(3))))
    assert [disc.irradiance[0] for disc in without_touched(split, []).discs] == [
        disc.irradiance[0] for disc in split.discs
    ]
