"""Indirect light of a renderer against the path tracer's: how much of its colour is there, and how much of its light.

What global illumination adds is the composite of a set with it minus that of the set with the same light and one
bounce. Direct light and its shadows drop out, and both sides are divided by albedo, so that a shadow on a coloured
surface is not taken for bleeding. What is left is irradiance that came by way of other surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.bench.rendering.composites import EDGE_PX, Slope, bleeding_slope, grown, local_means, shadow_slope
from tests.bench.rendering.flip import Codes
from tests.bench.truth.composite_truth import linear_from_codes
from tests.bench.truth.room_composites import SetTruth

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LEAST_ALBEDO = 0.05
"""Of the surfaces that are compared."""


@dataclass(frozen=True)
class Bleeding:
    """Slopes of the predicted on the true irradiance."""

    color: Slope
    luminance: Slope


def to_real(gi: SetTruth, direct: SetTruth, of_gi: list[Codes], of_direct: list[Codes]) -> Bleeding:
    """What the objects change on real surface by way of indirect light.

    `of_gi`, `of_direct`: composites of the set with global illumination and of the one with direct light alone.
    """
    true = [_changes(truth.composites, truth.pictures) for truth in (gi, direct)]
    wanted = _added(gi, direct, *true)
    shown = _linear(gi.shown), _linear(direct.shown)  # as coarse as the composites
    found = _added(gi, direct, _changes(_linear(of_gi), shown[0]), _changes(_linear(of_direct), shown[1]))
    albedo = list(gi.room.albedo(gi.item.surface))
    masks = [real & (a.min(axis=-1) > LEAST_ALBEDO) for real, a in zip(gi.real, albedo, strict=True)]
    return _compare(found, wanted, albedo, masks)


def to_objects(gi: SetTruth, direct: SetTruth, of_gi: list[Codes], of_direct: list[Codes]) -> Bleeding:
    """What the room sends to the objects by way of indirect light; see `to_real`."""
    wanted = _added(gi, direct, gi.composites, direct.composites)
    found = _added(gi, direct, _linear(of_gi), _linear(of_direct))
    inner = [~grown(~objects, EDGE_PX) for objects in gi.objects]
    return _compare(found, wanted, gi.room.object_albedo, inner)


def _linear(composites: list[Codes]) -> list[Floats]:
    return [linear_from_codes(codes) for codes in composites]


def _changes(composites: list[Floats], without: list[Floats]) -> list[Floats]:
    """What the objects change."""
    return [a - b for a, b in zip(composites, without, strict=True)]


def _added(gi: SetTruth, direct: SetTruth, of_gi: list[Floats], of_direct: list[Floats]) -> list[Floats]:
    """Radiance that global illumination adds."""
    return [gi.units * a - direct.units * b for a, b in zip(of_gi, of_direct, strict=True)]


def _compare(found: list[Floats], wanted: list[Floats], albedo: list[Floats], masks: list[Bools]) -> Bleeding:
    """Over all frames, as means of the pixels around each."""
    predicted, true = _irradiance(found, albedo, masks), _irradiance(wanted, albedo, masks)
    return Bleeding(bleeding_slope(predicted, true), shadow_slope(predicted, true))


def _irradiance(radiance: list[Floats], albedo: list[Floats], masks: list[Bools]) -> Floats:
    """[n, 3] over pi."""
    parts = zip(radiance, albedo, masks, strict=True)
    return np.concatenate([local_means(r / np.maximum(a, LEAST_ALBEDO), mask) for r, a, mask in parts])
