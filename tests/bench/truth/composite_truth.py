"""Pictures whose composites with virtual objects are known, and how near a renderer's composites come to them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from server.input.measure import linear_values
from server.shading.composite import srgb_codes
from tests.bench.rendering.composites import (
    changed_pixels,
    luminance,
    real_pixels_around,
    shadow_correlation,
    shadow_slope,
)
from tests.bench.rendering.flip import Codes, flip_map

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def linear_from_codes(codes: Codes) -> Floats:
    """Linear values of sRGB codes."""
    return linear_values("srgb8").astype(np.float64)[codes]


@dataclass(frozen=True)
class CompositeTruth:
    """Some frames, each [h, w, ...]."""

    pictures: list[Floats]
    """Linear RGB without the virtual objects, as the camera gives it."""
    composites: list[Floats]
    """With them."""
    objects: list[Bools]
    """Pixels that show one."""
    pasted: list[Codes]
    """The baseline: the objects over the pictures, lit, without a shadow."""

    @cached_property
    def shown(self) -> list[Codes]:
        """sRGB codes of `pictures`."""
        return [srgb_codes(picture) for picture in self.pictures]

    @cached_property
    def wanted(self) -> list[Codes]:
        """sRGB codes of `composites`."""
        return [srgb_codes(picture) for picture in self.composites]

    @cached_property
    def changed(self) -> list[Bools]:
        """What the objects change: where the shown picture's codes differ."""
        return [changed_pixels(*pair) for pair in zip(self.wanted, self.shown, strict=True)]

    @cached_property
    def real(self) -> list[Bools]:
        """Real surface that the objects change, and a rim."""
        return [real_pixels_around(*pair) for pair in zip(self.changed, self.objects, strict=True)]

    def with_objects(self, linear: list[Floats]) -> list[Codes]:
        """The true composites with other radiance [n, 3] on the objects' pixels."""
        result = [codes.copy() for codes in self.wanted]
        for codes, mask, values in zip(result, self.objects, linear, strict=True):
            codes[mask] = srgb_codes(values)
        return result


@dataclass(frozen=True)
class Score:
    """How near composites are to the truth, over all pixels of all frames."""

    error: float
    """Mean FLIP of what the objects change."""
    last_error: float
    """Of the last frame alone."""
    object_error: float
    """Of the objects' pixels."""
    real_error: float
    """Of the real pixels that they change."""
    brightness: float
    """Mean luminance of the objects' pixels over the true one."""
    shadow_correlation: float
    shadow_slope: float


def score(truth: CompositeTruth, composites: list[Codes]) -> Score:
    """Compare sRGB codes with the truth. Raises ImportError where flip_evaluator is not installed."""
    errors = [flip_map(*pair) for pair in zip(truth.wanted, composites, strict=True)]
    found = [linear_from_codes(codes) for codes in composites]
    without = [linear_from_codes(codes) for codes in truth.shown]
    predicted = pixels_of(truth.real, [a - b for a, b in zip(found, without, strict=True)])
    true = pixels_of(truth.real, [a - b for a, b in zip(truth.composites, truth.pictures, strict=True)])
    on_objects = [luminance(pixels_of(truth.objects, side)).mean() for side in (found, truth.composites)]
    changed_real = [changed & real for changed, real in zip(truth.changed, truth.real, strict=True)]
    return Score(
        error=float(pixels_of(truth.changed, errors).mean()),
        last_error=float(errors[-1][truth.changed[-1]].mean()),
        object_error=float(pixels_of(truth.objects, errors).mean()),
        real_error=float(pixels_of(changed_real, errors).mean()),
        brightness=float(on_objects[0] / on_objects[1]),
        shadow_correlation=shadow_correlation(predicted, true),
        shadow_slope=shadow_slope(predicted, true).value,
    )


def pixels_of(masks: list[Bools], pictures: list[Floats]) -> Floats:
    """The pixels of all frames that lie in their masks."""
    return np.concatenate([picture[mask] for mask, picture in zip(masks, pictures, strict=True)])
