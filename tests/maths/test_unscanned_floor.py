"""Floor that was not scanned sends back the light that arrives there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from server.light.shell.evidence import evidence_of
from server.light.shell.objective import step
from server.light.shell.shell import CELLS, FLOOR, SIDE, Shell
from server.light.shell.sources import near_sources
from server.light.shell.switches import Switches
from server.light.shell.transport import floor_shares
from server.light.shell.unknowns import Unknowns
from tests.scenes.analytic import Floats
from tests.scenes.half_floor import floor_radiance, half_floor_room
from tests.scenes.shell_room import SIZE_M


def corner_factor(x: Floats, y: Floats) -> Floats:
    """Configuration factor from a small surface to a parallel rectangle above it, a corner of which is over it, with
    sides `x` and `y` in units of the distance (Howell, catalog of configuration factors, B-3)."""
    first, second = np.sqrt(1 + x**2), np.sqrt(1 + y**2)
    return np.asarray((x / first * np.arctan(y / first) + y / second * np.arctan(x / second)) / (2 * np.pi))


@pytest.mark.parametrize("turn_deg", [0.0, 33.0])
def test_shares_of_a_ceiling_are_as_in_closed_form(turn_deg: float) -> None:
    cosine, sine = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    axes = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    shell = Shell(axes, np.array([-1.0, 2.0, 0.1]), np.array([3.0, 5.0, 2.5]), 0.1, np.zeros((2, 3)))
    shares = floor_shares(shell)
    assert shares.shape == (SIDE * SIDE, CELLS)
    np.testing.assert_allclose(shares.sum(axis=1), 1.0, atol=1e-5)
    assert not shares[:, FLOOR].any()
    middles = shell.centers[FLOOR]
    before, behind = (middles - shell.low)[:, :2] / 2.4, (shell.high - middles)[:, :2] / 2.4
    quarters = [corner_factor(x, y) for x in (before[:, 0], behind[:, 0]) for y in (before[:, 1], behind[:, 1])]
    np.testing.assert_allclose(shares[:, FLOOR.stop :].sum(axis=1), np.sum(quarters, axis=0), atol=0.015)


def test_floor_is_brighter_where_more_light_arrives() -> None:
    """In a room lit by one wall, of which the half of the floor away from it was scanned. About the mean of what
    pictures show, all of it is alike: twice as bright as it is far from the wall."""
    patches, transport, shell = half_floor_room()
    evidence = evidence_of(patches, patches.used, Switches())
    near = near_sources(transport, shell, patches, evidence.rows)
    middles = shell.centers[FLOOR] @ shell.axes
    is_inside = (middles[:, :2] < SIZE_M[:2] - 0.2).all(axis=1)
    true = floor_radiance(middles[is_inside]).mean(axis=1)
    assert true.max() > 2.5 * true.min()
    errors = []
    for sources in (near, replace(near, floor=None)):
        unknowns = Unknowns()
        for _ in range(25):
            step(unknowns, evidence, sources)
        errors.append(np.abs(np.log(unknowns.radiance[FLOOR][is_inside].mean(axis=1) / true)))
    assert np.median(errors[0]) < 0.15
    assert np.quantile(errors[0], 0.9) < 0.4
    assert np.median(errors[1]) > 0.4
