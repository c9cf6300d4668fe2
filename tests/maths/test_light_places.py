from itertools import combinations

import numpy as np

from server.maths.light_places import MOST_PLACES, places_of
from tests.scenes.analytic import Floats


def farthest(middles: Floats, positions: Floats) -> float:
    """How far the worst of `middles` is from the nearest of `positions`."""
    return float(np.linalg.norm(middles[:, None] - positions, axis=2).min(axis=1).max())


def test_few_objects_have_places_of_their_own() -> None:
    middles = np.random.default_rng(1).uniform(0, 4, (MOST_PLACES, 3))
    places = places_of(middles)
    np.testing.assert_array_equal(places.positions[list(places.owners)], middles)
    np.testing.assert_array_equal(places_of(middles[:1]).positions, middles[:1])


def test_objects_at_one_place_share_it() -> None:
    places = places_of(np.array([[1.0, 2, 3], [1.0, 2, 3], [0.0, 0, 0]]))
    assert len(places.positions) == 2
    assert places.owners[0] == places.owners[1] != places.owners[2]


def test_many_objects_share_places_nearby() -> None:
    middles = np.random.default_rng(2).uniform(0, 4, (MOST_PLACES + 3, 3))
    places = places_of(middles)
    assert len(places.positions) == MOST_PLACES
    best = min(farthest(middles, middles[list(chosen)]) for chosen in combinations(range(len(middles)), MOST_PLACES))
    assert farthest(middles, places.positions) <= 2 * best
    own = np.linalg.norm(middles - places.positions[list(places.owners)], axis=1)
    assert own.max() == farthest(middles, places.positions)
