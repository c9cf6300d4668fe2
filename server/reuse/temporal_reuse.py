"""Temporal reuse: which results of earlier frames are used again while the view is still, apart from noise.

Change detection (change_detection.py) says how many frames have been alike. Volume, light and everything drawn from
them are means over these frames. By the law of errors the mean of n frames differs from the mean of n / 2 about as much
as from the mean of endlessly many. So a view has settled once its picture after n frames equals the one after n / 2.
Both are composed over the camera picture with which the view began, and use the same directions. The light is compared
in the same way.

Where frames are equal byte for byte, the steps of the light bound its remaining change: each estimate moves the mean by
at least a tenth of their difference (AVERAGE of lobe_estimator.py; a memory that forgets a tenth a frame), so the light
is at most ten steps from its limit. If the radiance of every direction has a relative error of at most e, so has
shading, and R'/R of eq. 7.1 one of at most (1 + e) / (1 - e).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Poses
from server.culling.reason import ALLOWANCE, CullReason
from server.culling.rules import codes_of_share
from server.culling.scene_facts import most_shading
from server.light.light_estimation import FORGETTING
from server.maths.emitters import Emitter
from server.maths.sh import sh_basis, spherical_fibonacci
from server.objects.rasterize import Placed
from server.opencl.engine import Engine
from server.reuse.change_detection import ChangeDetection
from server.reuse.frame_cache import FIRST_VERSION, Version
from server.transfer.radiance_transfer import TURNS

ROUND = 2 * TURNS
"""Equal frames before reuse begins: twice the number of direction sets that samples cycle through."""
NOISY = 2 * ROUND
"""The same for frames that are equal apart from noise: the light's running mean is then over ten frames, not all."""
MOST_FRAMES = 64
"""Frames after which a view that has not settled starts again."""
RATE = 1.0 - FORGETTING
SHARE = 0.5
"""Share of the allowance for a light that has not settled, while nothing else changes."""
ROUNDING = 0.01
"""Display units: rounding of sums in another order, for equal frames."""
OUTLIERS = 5e-4
"""Share of the pixels that may have changed by more than one code: half of what is allowed in all."""
_DIRECTIONS = 1024

ECHO_FRAMES = 30
"""Frames after which the running mean of the light has caught up with frames that were reused, but for 0.9^30 = 4 %."""

# Reasons. Bounds under noise hold for all but a thousandth of the pixels.
SAME = "neither the picture nor the geometry has changed, and the light has settled"
NOISE = "nothing but the sensor's noise has changed, and what is drawn has settled"

ECHO = "the light is a mean without the frames that were reused: it is as far off as it was then"

Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class SceneVersion:
    """Inputs of a view that the pictures do not show. A change of any of them begins a new view."""

    others: int = 0
    """Counts the frames of other clients, and objects that came or went."""
    losses: int = 0
    """Counts the frames in which the camera was lost."""
    sampling: int = 0
    """Counts the changes of the sampling."""
    lamps: tuple[Emitter, ...] = ()
    """Lights inside the room; another tuple is a change."""

    def is_same(self, other: SceneVersion) -> bool:
        """Whether nothing has changed."""
        counts, others = (self.others, self.losses, self.sampling), (other.others, other.losses, other.sampling)
        return counts == others and self.lamps is other.lamps


@dataclass(frozen=True)
class ReuseDecision:
    """Which results of earlier frames one frame uses again. Decided once, after the frame's input was measured."""

    reason: CullReason | None = None
    """Why cached light, transfer and effects are used; None: everything is computed again."""
    keeps_geometry: bool = False
    """Whether pose and surfaces of the last frame are used again."""
    version: Version = FIRST_VERSION
    """Version of the values that this frame caches or finds."""
    is_checkpoint: bool = False
    """Whether this frame's picture is compared to see whether the view has settled."""
    renews_transfer: bool = False
    """Whether all transfer is found anew, so that what is kept of a scene that moved before changes no more."""
    echo: CullReason | None = None
    """Frames that the light has not used yet, while their effect can still be seen."""

    @property
    def samples_version(self) -> Version:
        """Version of transfer, which does not depend on the virtual objects."""
        return Version(self.version.view, 0, self.version.slot)

    @property
    def view_version(self) -> Version:
        """Version of the camera picture with which the view began."""
        return Version(self.version.view)


NO_REUSE = ReuseDecision()
"""The decision where everything is computed."""


@dataclass(frozen=True)
class _State:
    """Results after some frames."""

    sh: Floats
    picture: Picture | None


class TemporalReuse:
    """Temporal reuse of one session. Call `decide` for each frame, then `observe` with its results."""

    def __init__(self, engine: Engine, camera: CameraModel, *, poses: Poses = "given") -> None:
        """A tracked pose moves by parts of a pixel even if the camera does not, and visibly moves the edges of virtual
        objects. With objects such a view never settles.
        """
        self._is_tracked = poses != "given"
        self._changes = ChangeDetection(engine, camera, poses_are_given=poses != "track")
        self._scene = SceneVersion()
        self._places: tuple[tuple[int, bytes], ...] = ()
        self._view = self._objects = 0
        self._states: dict[int, _State] = {}
        self._lights: deque[Floats] = deque(maxlen=ROUND)
        self._reason: CullReason | None = None
        self._settled_after = 0
        self._echo_frames = 0

    def decide(
        self, frame: RgbdFrame, scene: SceneVersion, objects: Sequence[Placed] = (), *, period: int = TURNS
    ) -> ReuseDecision:
        """The decision for one frame. period: frames after which samples of a still view are the same again."""
        if not scene.is_same(self._scene):
            self._scene = scene
            self._changes.forget()
            self._begin_view()
        if not self._changes.look(frame, learn=self._reason is None):
            self._begin_view()
        keeps_geometry = self._reason is not None and not self._renews()
        self._note_places(objects)
        count = self._changes.count
        return ReuseDecision(
            reason=self._reason,
            keeps_geometry=keeps_geometry,
            version=Version(self._view, self._objects, count % period),
            is_checkpoint=self._reason is None and count % period == 0,
            renews_transfer=self._reason is None and count == TURNS and not self._is_tracked,
            echo=CullReason(ECHO, ALLOWANCE) if self._echo_frames else None,
        )

    def observe(self, decision: ReuseDecision, sh: Floats, picture: Picture | None) -> None:
        """Learn from a fully computed frame whether the view has settled.

        sh: the light [places, bands^2, 3]. picture: at a checkpoint, the virtual objects over the camera picture with
        which the view began; None without objects.
        """
        if decision.reason is not None:
            return
        if self._lights and self._lights[-1].shape != sh.shape:  # seen from other places
            self._states.clear()
            self._lights.clear()
        self._lights.append(sh.copy())
        self._echo_frames = max(self._echo_frames - 1, 0)
        count = self._changes.count
        if not decision.is_checkpoint:
            return
        now = self._states[count] = _State(sh.copy(), picture)
        half = self._states.get(count // 2) if count % 2 == 0 else None
        least = ROUND if self._changes.is_exact else NOISY
        if count >= least and len(self._lights) == ROUND and half is not None:
            self._reason, self._settled_after = self._found(half, now), count
        if self._reason is None and count >= MOST_FRAMES:
            self._changes.forget()
            self._begin_view()

    def _begin_view(self) -> None:
        if self._reason is not None and (np.array(self._lights) != self._lights[-1]).any():
            self._echo_frames = ECHO_FRAMES
        self._states.clear()
        self._lights.clear()
        self._view += 1
        self._reason = None

    def _renews(self) -> bool:
        """Whether to raycast the surface again: the volume has twice as many frames as the last time."""
        count = self._changes.count
        if self._changes.is_exact or count != 2 * self._settled_after or count > MOST_FRAMES:
            return False
        self._settled_after = count
        self._view += 1
        return True

    def _note_places(self, objects: Sequence[Placed]) -> None:
        """Start to compare again: pictures of an object at two places cannot be compared."""
        places = tuple((id(thing), matrix.tobytes()) for thing, matrix in objects)
        if places != self._places:
            self._states.clear()
            self._objects += 1
        self._places = places

    def _found(self, half: _State, now: _State) -> CullReason | None:
        """Decide what is used again from now on."""
        if (half.picture is None) != (now.picture is None) or (self._is_tracked and now.picture is not None):
            return None
        light = self._light_bound(half.sh, now.sh)
        if light is None:
            return None
        reason = SAME if self._changes.is_exact else NOISE
        if now.picture is None or half.picture is None:
            return CullReason(reason, 0.0)
        change = np.abs(now.picture.astype(np.int16) - half.picture).max(axis=-1)
        if (change > 1).mean() > (0.0 if self._changes.is_exact else OUTLIERS):
            return None
        is_same = self._changes.is_exact and not change.any()
        return CullReason(reason, light + ROUNDING if is_same else ALLOWANCE)

    def _light_bound(self, half: Floats, now: Floats) -> float | None:
        """Bound on the remaining change of white surface in display units; None if it is too large."""
        if self._changes.is_exact:
            share = self._unsettled()
            bound = codes_of_share((1 + share) / (1 - share) - 1) if share < 1 else math.inf
            return bound if bound <= SHARE * ALLOWANCE else None
        mean = np.maximum(now[:, 0] / math.sqrt(4 * math.pi), 1e-12)
        changed = np.array([most_shading(change) for change in now - half])
        bound = codes_of_share(float((changed / mean).max())) if now.any() or half.any() else 0.0
        return bound if bound <= ALLOWANCE else None

    def _unsettled(self) -> float:
        """Bound on the remaining relative change of the light from any direction."""
        lights = np.array(self._lights)
        if (lights == lights[-1]).all():
            return 0.0
        radiances = sh_basis(spherical_fibonacci(_DIRECTIONS), math.isqrt(lights.shape[-2])) @ lights
        steps = np.abs(np.diff(radiances, axis=0)).max(axis=0) / RATE
        return float((steps / np.maximum(radiances[-1], 1e-12)).max())
