"""How near a composite is to the path tracer's: picture error, shadows and indirect light, each as one figure.

Pictures are linear RGB in the units of the camera's linear picture, or sRGB codes where it says so. A *change* is the
picture with the virtual objects minus the one without them, which is what differential rendering predicts.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.bench.rendering.flip import Codes, flip_map

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Rec. 709."""
RIM_PX = 4
"""Around what the objects change: shadows that are predicted where there is none count too."""
EDGE_PX = 1
"""Around the objects: pixels that are partly theirs say nothing of real surface."""
NOISE = 2 / 255
"""Of a path-traced change of irradiance; what is smaller is not measured by its own size."""
SMOOTHED_PX = 3
"""To each side: means of so many pixels are compared, because noise of the truth would make every slope too small."""


@dataclass(frozen=True)
class Slope:
    """What of a true quantity is predicted: the least squares factor from the true to the predicted one."""

    value: float
    """1 is all of it, 0 none, less than 0 the wrong sign; NaN where nothing is large enough to tell."""
    correlation: float
    """Uncentred, from -1 to 1."""
    samples: int


def changed_pixels(with_objects: Codes, without: Codes) -> Bools:
    """[h, w] the object, its shadows, its bounce: where the codes [h, w, 3] of the true pictures differ."""
    changed: Bools = (with_objects != without).any(axis=-1)
    return changed


def picture_errors(reference: Codes, test: Codes, changed: Bools) -> Floats:
    """[n] FLIP of the `changed` pixels of a composite. Raises ImportError, see `flip_map`."""
    return flip_map(reference, test)[changed]


def grown(mask: Bools, by_px: int) -> Bools:
    """`mask` and what lies within `by_px` pixels of it, in a square."""
    kernel = np.ones((2 * by_px + 1, 2 * by_px + 1), np.uint8)
    larger: Bools = cv2.dilate(mask.astype(np.uint8), kernel) > 0
    return larger


def real_pixels_around(changed: Bools, objects: Bools) -> Bools:
    """[h, w] real surface that the objects change and the rim around it, without the objects' own border."""
    return grown(changed, RIM_PX) & ~grown(objects, EDGE_PX)


def luminance(linear: Floats) -> Floats:
    """Rec. 709 luminance of linear RGB [..., 3]."""
    shown: Floats = linear @ LUMINANCE
    return shown


def shadow_correlation(predicted: Floats, true: Floats) -> float:
    """Pearson correlation of two changes [n, 3] in luminance; 0 where one of them is even."""
    a, b = (luminance(change) - luminance(change).mean() for change in (predicted, true))
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / norm if norm > 0 else 0.0


def shadow_slope(predicted: Floats, true: Floats) -> Slope:
    """How much of the true darkening [n, 3] is predicted, in luminance."""
    return slope_of(luminance(predicted), luminance(true))


def chroma(linear: Floats) -> Floats:
    """[..., 2] red and blue against green of linear RGB [..., 3]: zero for grey."""
    return np.stack([linear[..., 0] - linear[..., 1], linear[..., 2] - linear[..., 1]], axis=-1)


def local_means(values: Floats, mask: Bools) -> Floats:
    """[n, 3] of the n pixels of `mask`: the mean of values [h, w, 3] over the pixels of `mask` around each."""
    box = (2 * SMOOTHED_PX + 1, 2 * SMOOTHED_PX + 1)
    total = cv2.boxFilter(np.where(mask[..., None], values, 0.0), -1, box, borderType=cv2.BORDER_CONSTANT)
    count = cv2.boxFilter(mask.astype(np.float64), -1, box, borderType=cv2.BORDER_CONSTANT)
    means: Floats = np.asarray(total[mask], np.float64) / count[mask][:, None]
    return means


def bleeding_slope(predicted: Floats, true: Floats, noise: float = NOISE) -> Slope:
    """How much of the colour of a true change [n, 3] is predicted, where that is more than `noise`.

    Of irradiance, so that a shadow on a coloured surface, which changes its colour too, is not taken for bleeding.
    """
    wanted, found = chroma(true), chroma(predicted)
    telling = np.linalg.norm(wanted, axis=-1) > noise
    return slope_of(found[telling].ravel(), wanted[telling].ravel())


def slope_of(predicted: Floats, true: Floats) -> Slope:
    """Regression through the origin of `predicted` [n] on `true` [n]."""
    energy = float(true @ true)
    if energy == 0:
        return Slope(np.nan, 0.0, 0)
    both = float(np.linalg.norm(predicted)) * energy**0.5
    product = float(predicted @ true)
    return Slope(product / energy, product / both if both > 0 else 0.0, len(true))
