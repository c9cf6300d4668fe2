"""When a frame can tell the light nothing new: neither picture, depth nor view has changed, and the light has settled.

What estimates repeat, repeats their mean. An estimate moves the mean by no less than a tenth of what lies between them
(AVERAGE of lobe_estimator.py; a memory that forgets a tenth a frame), so it lies no farther off than ten steps of the
mean; and a mean of estimates stays among them. If the radiance of no direction is thus off by more than the share e,
no shading is, whatever hides of it, and R'/R of eq. 7.1 by no more than (1 + e) / (1 - e); so it is with what a gain
makes of virtual surface, which is a ratio of two shadings.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from protocol.frames import RgbdFrame
from server.geometry import GeometryFrame
from server.maths.emitters import Emitter
from server.maths.sh import sh_basis, spherical_fibonacci
from server.omissions import codes_of_share
from server.plan import ALLOWANCE, Omission
from server.stages.continuation import PlaneArrays
from server.stages.light_estimation import FORGETTING
from server.stages.radiance_transfer import TURNS

ROUND = 2 * TURNS
"""Frames that must have repeated: twice the direction sets that samples take turns with."""
RATE = 1.0 - FORGETTING
SHARE = 0.5
"""Of the allowance."""
_DIRECTIONS = 1024

Floats = NDArray[np.float64]


class Rest:
    """One session's."""

    def __init__(self) -> None:
        self._last: tuple[RgbdFrame, Floats] | None = None
        self._lamps: tuple[Emitter, ...] = ()
        self._lights: deque[tuple[Floats, bytes]] = deque(maxlen=ROUND + 1)

    def found(self, frame: RgbdFrame, geometry: GeometryFrame, lamps: tuple[Emitter, ...] = ()) -> Omission | None:
        """Why the light need not be estimated from this frame, less its `lamps`; None where it must be."""
        last, self._last = self._last, (frame, geometry.world_from_camera)
        as_lit, self._lamps = lamps is self._lamps, lamps
        if last is None or not as_lit or not _is_same(*last, frame, geometry.world_from_camera):
            self._lights.clear()
            return None
        share = self._unsettled()
        bound = codes_of_share((1 + share) / (1 - share) - 1) if share < 1 else math.inf
        if bound > SHARE * ALLOWANCE:
            return None
        return Omission("neither the picture nor the geometry has changed, and the light has settled", bound)

    def learn(self, sh: Floats, planes: PlaneArrays) -> None:
        """What a frame has been estimated to: the light [bands^2, 3], and what is taken to hide it."""
        self._lights.append((sh.copy(), b"".join(array.tobytes() for array in planes)))

    def _unsettled(self) -> float:
        """Greatest share by which the light from any direction may still change."""
        if len(self._lights) <= ROUND or len({planes for _, planes in self._lights}) > 1:
            return math.inf
        lights = np.array([sh for sh, _ in self._lights])
        if (lights == lights[-1]).all():
            return 0.0
        radiances = sh_basis(spherical_fibonacci(_DIRECTIONS), math.isqrt(lights.shape[1])) @ lights
        steps = np.abs(np.diff(radiances, axis=0)).max(axis=0) / RATE
        return float((steps / np.maximum(radiances[-1], 1e-12)).max())


def _is_same(before: RgbdFrame, pose_before: Floats, now: RgbdFrame, pose: Floats) -> bool:
    """Byte for byte: what noise hides of a change, no bound is known of."""
    return (
        np.array_equal(before.color, now.color)
        and np.array_equal(before.depth, now.depth)
        and np.array_equal(pose_before, pose)
        and before.exposure == now.exposure
    )
