"""When a frame can tell nothing new: the view stands still but for noise, and what is made of it has settled.

Stillness (stillness.py) says how many frames have been alike. What is made of so many is made of their mean: in the
volume, in the light's running mean and so in all that is drawn. What it has changed by since half as many is spread as
what it has still to go: by the law of errors a mean of n differs from that of n / 2 by as much, on average, as it does
from the mean of endlessly many. So what is virtual is put into what the camera saw at first, as it was then and as it
is now, and the two are compared; frames that are compared sample the same directions. The light is compared alike.

Where nothing at all differs from frame to frame, the light's steps say how far it can still go: an estimate moves the
mean by no less than a tenth of what lies between them (AVERAGE of lobe_estimator.py; a memory that forgets a tenth a
frame), so it lies no farther off than ten steps. If the radiance of no direction is off by more than the share e, no
shading is, whatever hides of it, and R'/R of eq. 7.1 by no more than (1 + e) / (1 - e).
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
from server.light.continuation import PlaneArrays
from server.light.light_estimation import FORGETTING
from server.maths.emitters import Emitter
from server.maths.sh import sh_basis, spherical_fibonacci
from server.objects.rasterize import Placed
from server.opencl.engine import Engine
from server.reuse.change_detection import ChangeDetection
from server.reuse.frame_cache import FrameCache
from server.transfer.radiance_transfer import TURNS

ROUND = 2 * TURNS
"""Frames that must be alike: twice the direction sets that samples take turns with."""
NOISY = 2 * ROUND
"""The same where they are alike but for noise: the light's running mean is then of ten frames, not all."""
MOST_FRAMES = 64
"""After which it begins anew, if what is made of them has not settled."""
RATE = 1.0 - FORGETTING
SHARE = 0.5
"""Of the allowance that a light may take which still moves though nothing else does."""
ROUNDING = 0.01
"""Display units: what the order of sums leaves of frames that are the same."""
OUTLIERS = 5e-4
"""Share of the pixels that may have changed by more than one code: half of what may not be seen."""
_DIRECTIONS = 1024

ECHO_FRAMES = 30
"""For which the light's running mean remembers what frames at rest would have told it: then 0.9^30 of it, 4 %."""

# Reasons. The bounds of noise are of all but a thousandth of the pixels.
SAME = "neither the picture nor the geometry has changed, and the light has settled"
NOISE = "nothing but the sensor's noise has changed, and what is drawn has settled"

ECHO = "the light is a mean that frames at rest are not in: it is as far off as it was then"

Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class _State:
    """What had been made of some frames."""

    sh: Floats
    picture: Picture | None


class TemporalReuse:
    """One session's."""

    def __init__(self, engine: Engine, camera: CameraModel, *, poses: Poses = "given", period: int = TURNS) -> None:
        """`period`: frames after which samples of a still view are the same again.

        A pose that is tracked moves by parts of a pixel though the camera does not, and the edges of virtual things
        with it: by more than may be seen. With objects such a view does not rest.
        """
        self._is_tracked = poses != "given"
        self._still = ChangeDetection(engine, camera, poses_are_given=poses != "track")
        self._period = period
        self._lamps: tuple[Emitter, ...] = ()
        self._hiding = b""
        self._places: tuple[tuple[int, bytes], ...] = ()
        self.held = FrameCache(engine)
        self._states: dict[int, _State] = {}
        self._lights: deque[Floats] = deque(maxlen=ROUND)
        self.omission: CullReason | None = None
        """Why the light has not to be found anew, nor transfer and effects once held; None while all has."""
        self._since = 0
        self._echo_frames = 0

    @property
    def turn(self) -> int:
        """Of the last frame, below the period: frames of one turn sample alike."""
        return self._still.count % self._period

    @property
    def is_checkpoint(self) -> bool:
        """Whether the frame that is to be learnt from counts: of it the picture is wanted."""
        return self._still.count % self._period == 0

    @property
    def echo(self) -> CullReason | None:
        """What frames at rest left out of a light that is found, and still shows in this one."""
        return CullReason(ECHO, ALLOWANCE) if self._echo_frames else None

    def forget(self) -> None:
        """Something is new that pictures do not show: an object, a preset, a lost camera."""
        self._still.forget()
        self._begin()

    def place(self, objects: Sequence[Placed]) -> None:
        """Where objects are in this frame. What has moved is drawn anew; while the view settles, pictures of it at two
        places cannot be compared. One that is new or gone has to be told by `forget`."""
        places = tuple((id(thing), matrix.tobytes()) for thing, matrix in objects)
        if places != self._places:
            self._states.clear()
            self.held.finished.clear()
        self._places = places

    def holds(self, frame: RgbdFrame, lamps: tuple[Emitter, ...] = ()) -> bool:
        """Whether the last frame's geometry stands for this one's; with what it shows noticed."""
        if lamps is not self._lamps:
            self._lamps = lamps
            self.forget()
        if not self._still.look(frame, learn=self.omission is None):
            self._begin()
        if self.omission is None:
            return False
        return not self._renews()

    def _renews(self) -> bool:
        """Whether the surface is taken from the volume again, which has seen twice as many frames as when it was."""
        count = self._still.count
        if self._still.is_exact or count != 2 * self._since or count > MOST_FRAMES:
            return False
        self._since = count
        self.held.forget()
        return True

    def learn(self, sh: Floats, planes: PlaneArrays, picture: Picture | None) -> None:
        """What has been made of a frame before the view rests: the light [bands^2, 3], what is taken to hide it, and at
        a checkpoint the picture, always of what the camera saw at the first; None where nothing is virtual."""
        self._lights.append(sh.copy())
        self._echo_frames = max(self._echo_frames - 1, 0)
        count, hiding = self._still.count, b"".join(array.tobytes() for array in planes)
        if hiding != self._hiding:
            self._states.clear()
        self._hiding = hiding
        if not self.is_checkpoint:
            return
        now = self._states[count] = _State(sh.copy(), picture)
        half = self._states.get(count // 2) if count % 2 == 0 else None
        if count >= (ROUND if self._still.is_exact else NOISY) and len(self._lights) == ROUND and half is not None:
            self.omission, self._since = self._found(half, now), count
        if self.omission is None and count >= MOST_FRAMES:
            self.forget()

    def _begin(self) -> None:
        if self.omission is not None and (np.array(self._lights) != self._lights[-1]).any():
            self._echo_frames = ECHO_FRAMES
        self._states.clear()
        self._lights.clear()
        self.held.forget()
        self.omission = None

    def _found(self, half: _State, now: _State) -> CullReason | None:
        """What may be left out from now on."""
        if (half.picture is None) != (now.picture is None) or (self._is_tracked and now.picture is not None):
            return None
        light = self._light_bound(half.sh, now.sh)
        if light is None:
            return None
        reason = SAME if self._still.is_exact else NOISE
        if now.picture is None or half.picture is None:
            return CullReason(reason, 0.0)
        change = np.abs(now.picture.astype(np.int16) - half.picture).max(axis=-1)
        if (change > 1).mean() > (0.0 if self._still.is_exact else OUTLIERS):
            return None
        is_same = self._still.is_exact and not change.any()
        return CullReason(reason, light + ROUNDING if is_same else ALLOWANCE)

    def _light_bound(self, half: Floats, now: Floats) -> float | None:
        """Display units that white surface may still change by; None where that is too much."""
        if self._still.is_exact:
            share = self._unsettled()
            bound = codes_of_share((1 + share) / (1 - share) - 1) if share < 1 else math.inf
            return bound if bound <= SHARE * ALLOWANCE else None
        mean = np.maximum(now[0] / math.sqrt(4 * math.pi), 1e-12)
        bound = codes_of_share(float((most_shading(now - half) / mean).max())) if now.any() or half.any() else 0.0
        return bound if bound <= ALLOWANCE else None

    def _unsettled(self) -> float:
        """Greatest share by which the light from any direction may still change."""
        lights = np.array(self._lights)
        if (lights == lights[-1]).all():
            return 0.0
        radiances = sh_basis(spherical_fibonacci(_DIRECTIONS), math.isqrt(lights.shape[1])) @ lights
        steps = np.abs(np.diff(radiances, axis=0)).max(axis=0) / RATE
        return float((steps / np.maximum(radiances[-1], 1e-12)).max())
