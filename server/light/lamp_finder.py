"""The lamps of one room (B4): schedules sampling and searching, and discards outdated lamps.

A search is spread over frames. The room's light must be constant while samples are gathered; a change is detected when
a new view contradicts the result.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Literal

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.frames import CameraModel
from protocol.messages import LeftOut
from server.light.light_estimation import ASSUMED_ALBEDO
from server.light.near_light import Emitters, outside_light, search_lamps
from server.light.near_samples import PooledSamples, see_some
from server.maths.emitters import Emitter
from server.maths.near_light import LEAST_MISFIT, Found, Steps, misfit
from server.maths.sh import LUMINANCE
from server.opencl.engine import Engine
from server.volume.raycast import Surface
from server.volume.volume import Volume

VIEWS, VIEW_SAMPLES = 6, 200
"""Number of views in a search, and of samples in each view. The time of a search grows with both."""
FRAMES_A_VIEW = 8
FIRST_VIEWS = 3
"""Number of views after which the first search begins."""
MOST_WAITING_FRAMES = 192
"""Longest time between two searches. It doubles while searches find the same lamps; views then are further apart."""
STEPS_A_FRAME = 6
"""Steps of a search in one frame. A frame in which a new view is taken has none, so that no frame is slow."""
CHANGED = 0.25
"""The light has changed if the misfit of a new view exceeds this, and three times the misfit that the search left."""


class LampFinder:
    """Lamps of one room."""

    def __init__(self, engine: Engine, wanted: Literal["auto", "on", "off"]) -> None:
        """`wanted`: `auto` looks for lamps where the light from outside does not explain what is seen."""
        self._engine = engine
        self._wanted = wanted
        if wanted != "off":
            Emitters.compiled(engine)  # now, not in the middle of a later frame
        self._random = np.random.default_rng(1)
        self.forget()

    def forget(self) -> None:
        """Begin anew: the light has changed."""
        self.lamps: tuple[Emitter, ...] = ()
        self._views: deque[PooledSamples] = deque(maxlen=VIEWS)
        self._found: Found | None = None
        self._search: Steps[Found] | None = None
        self._next_takes = 0
        self._wait_frames = FIRST_VIEWS * FRAMES_A_VIEW
        self._frames = 0

    @property
    def found(self) -> Found | None:
        """Result of the last complete search; None before the first one, and after the light has changed."""
        return self._found

    def resume(self, found: Found | None) -> None:
        """Begin with what was `found` in this room before."""
        self.forget()
        self._found, self.lamps = found, found.emitters if found else ()

    def work(self, camera: CameraModel, radiance: cl_array.Array, surface: Surface, volume: Volume) -> None:
        """Do one frame's part of a search. `lamps` are then those of the last complete search, in volume space.

        radiance: [h, w] float4 as in Measurement, with the lamps' light.
        """
        if self._wanted == "off":
            return
        left = STEPS_A_FRAME
        if self._frames % max(FRAMES_A_VIEW, self._wait_frames // VIEWS) == 0:
            self._see(camera, radiance, surface, volume)
            left = 0
        self._frames += 1
        if self._search is None and self._frames >= self._wait_frames:
            samples = _together(self._views)
            least = LEAST_MISFIT if self._wanted == "auto" else 0.0
            if len(samples):
                self._search = search_lamps(self._engine, volume, samples, least_misfit=least)
                self._next_takes = 0
        while self._search is not None and self._next_takes <= left:
            left -= self._next_takes
            self._step(self._search)

    def lamps_at(self, origin_world: NDArray[np.float64]) -> tuple[Emitter, ...]:
        """The lamps in the world; the volume's origin lies at `origin_world` [3], metres."""
        return tuple(replace(lamp, position=lamp.position + origin_world) for lamp in self.lamps)

    def left_out(self) -> tuple[LeftOut, ...]:
        """Effects of the lamps that are not rendered yet."""
        reason = "virtual objects are not yet lit by lamps in the room"
        return (LeftOut(effect="lamplight", reason=reason, error_bound=None),) if self.lamps else ()

    def _step(self, search: Steps[Found]) -> None:
        try:
            self._next_takes = next(search)
        except StopIteration as end:
            self._take(end.value)

    def _take(self, found: Found) -> None:
        """Take the result of a search. If it differs from the last one, the next search begins soon."""
        same = self._found is not None and len(found.emitters) == len(self.lamps)
        self._wait_frames = min(2 * self._wait_frames, MOST_WAITING_FRAMES) if same else VIEWS * FRAMES_A_VIEW
        self._found, self.lamps = found, found.emitters
        self._search, self._frames = None, 0

    def _see(self, camera: CameraModel, radiance: cl_array.Array, surface: Surface, volume: Volume) -> None:
        view = see_some(self._engine, camera, radiance, surface, volume, VIEW_SAMPLES, self._random)
        if len(view) and self._contradicts(view, volume):
            self.forget()
        self._views.append(view)

    def _contradicts(self, view: PooledSamples, volume: Volume) -> bool:
        if self._found is None:
            return False
        emitters = Emitters(self._engine, volume, view, "near_view")
        places = np.array([lamp.position for lamp in self.lamps]).reshape(-1, 3)
        shares = emitters.shares(places).astype(np.float64) if len(places) else np.zeros((0, len(view)))
        predicted = self._found.predicted(outside_light(volume, view, emitters), shares)
        return misfit(view.colors @ LUMINANCE / ASSUMED_ALBEDO, predicted) > max(CHANGED, 3 * self._found.misfit)


def _together(views: deque[PooledSamples]) -> PooledSamples:
    first, *others = views
    return sum(others, first)
