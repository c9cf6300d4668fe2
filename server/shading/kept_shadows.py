"""How long what virtual things take from the light stays true where it was found.

What they take from a place of real surface, R' / R of eq. 7.1, depends on the place, on the things and on the light
from all sides, but not on the camera. So does what real and virtual things take from virtual surface. Both are kept by
cell of the world (shadow_cells.py). A value is found anew in the next frame, because a young scan grows from frame to
frame; if all samples of the cell find the same, after two, four, LONGEST; if not, in the next one again. When a thing
has moved, or the light has become another, all are found anew. The light of a room is estimated every few frames and
moves a little each time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from server.objects.rasterize import Placed
from server.shading.traced_scene import TracedScene
from server.transfer.radiance_transfer import Directions
from server.volume.volume import Volume

LONGEST = 8
"""Frames after which a value in view is found anew at the latest; a power of two. Half of those after which transfer is
traced again for the first time."""
STEADY = 0.05
"""How much the light may differ from the one that a shadow was found under, as a share of its coefficients' norm at the
same level: so much of a shadow's depth, in the mean over directions. A solution of the real kitchen moves its light by
.02; pictures of its frames 20 to 49 differ from those that are traced anew, with four times as many samples of the
object, by FLIP .0021 with and without kept shadows."""
_REMEMBERED = 80
"""Frames. What was found earlier is found anew when it is seen again."""


@dataclass(frozen=True)
class SplitSh:
    """Coefficients of a light, [places, bands^2, 3] each."""

    rest: NDArray[np.float64]
    """Without discs: what R and R' are of."""
    discs: NDArray[np.float64]
    """The discs' own."""


@dataclass(frozen=True)
class ShadowCause:
    """What shadows depend on besides the surface that they fall on."""

    volume: Volume
    objects: Sequence[Placed]
    light: SplitSh
    is_sent: bool
    """Whether surfaces send light."""
    by_views: bool
    """Whether visibility is looked up in depth views; else rays are traced."""
    rays: Directions
    ray_length_m: float

    @staticmethod
    def of(scene: TracedScene) -> ShadowCause:
        """The scene's."""
        light = SplitSh(scene.light.rest, scene.light.sh - scene.light.rest)
        is_sent, by_views = scene.light.surface_gain > 0.0, scene.depth_views is not None
        return ShadowCause(scene.volume, scene.objects, light, is_sent, by_views, scene.rays, scene.ray_length_m)

    def has_same_things(self, other: ShadowCause) -> bool:
        """Whether all but the light is the same."""
        return (
            (self.is_sent, self.by_views) == (other.is_sent, other.by_views)
            and self.ray_length_m == other.ray_length_m
            and self.volume is other.volume
            and self.rays is other.rays
            and _are_same(self.objects, other.objects)
        )


class KeptShadows:
    """The causes of the shadows of one session's last frames."""

    def __init__(self) -> None:
        self._last: ShadowCause | None = None
        self._lights: deque[SplitSh] = deque(maxlen=_REMEMBERED)
        """Of the last frames, as far back as all else was the same."""
        self.now = 0
        """Number of the last frame, from 1; 0: none."""

    def since(self, cause: ShadowCause) -> int:
        """The first frame from which on all causes are nearly `cause`; if the last one's is not, this frame."""
        if not self._is_as_last(cause):
            return self.now + 1
        is_far = light_differences(cause.light, self._lights)[::-1] > STEADY
        return self.now + 1 - int(np.argmax([*is_far, True]))

    def begin_frame(self, cause: ShadowCause) -> int:
        """Number of this frame, from 1, whose shadows are kept."""
        if not self._is_as_last(cause):
            self._lights.clear()
        self._last = cause
        self._lights.append(cause.light)
        self.now += 1
        return self.now

    def _is_as_last(self, cause: ShadowCause) -> bool:
        return self._last is not None and cause.has_same_things(self._last)


def light_differences(light: SplitSh, before: Sequence[SplitSh]) -> NDArray[np.float64]:
    """[n] how much each of `before` differs from `light` at the level where their rests are nearest, in the place where
    most.

    A share of the norm of the rest, or of the discs if that is larger: virtual things send light of the discs, which
    counts by how much it adds to the rest. Infinite where one has other places, or is dark and the other is not.
    """
    found = np.full(len(before), np.inf)
    alike = [k for k, one in enumerate(before) if one.rest.shape == light.rest.shape]
    if not alike:
        return found
    rest, discs = np.stack([before[k].rest for k in alike]), np.stack([before[k].discs for k in alike])
    size, other = _norms(light.rest), _norms(rest)
    is_dark = (size == 0.0) | (other == 0.0)
    level = np.maximum(np.einsum("pij,npij->np", light.rest, rest), 0.0) / np.where(is_dark, 1.0, other**2)
    by = level[..., None, None]
    of_rest = _norms(light.rest - by * rest) / np.where(is_dark, 1.0, size)
    of_discs = _norms(light.discs - by * discs) / np.where(is_dark, 1.0, np.maximum(_norms(light.discs), size))
    differ = np.maximum(of_rest, of_discs).max(axis=1)
    are_dark = is_dark.all(axis=1) & ~(size.any() | other.any(axis=1))
    found[alike] = np.where(is_dark.any(axis=1), np.where(are_dark, 0.0, np.inf), differ)
    return found


def _norms(coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
    """[..., places]."""
    return np.asarray(np.sqrt(np.einsum("...ij,...ij->...", coefficients, coefficients)))


def _are_same(objects: Sequence[Placed], others: Sequence[Placed]) -> bool:
    return len(objects) == len(others) and all(
        thing is other and np.array_equal(matrix, place)
        for (thing, matrix), (other, place) in zip(objects, others, strict=True)
    )
