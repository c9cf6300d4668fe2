"""The gallery: geometry, light, virtual objects and expected effects of each scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from client.gallery.objects import GalleryObject, Rgb
from client.synthetic.solids.polyhedra import Solid, box
from client.synthetic.solids.round import Sphere
from client.synthetic.solids.shell import Opening, Shell
from protocol.messages import Poses
from server.maths.directional_fit import directional_sh

Floats = NDArray[np.float64]
Effects = frozenset[str]

COEFFICIENTS = 16
FRAMES = 6
STILL_FRAMES = 46
"""Frames of scenes with a still camera: less than two seconds."""
CHANGE_FRAME = 36
"""Frame of a change in front of a still camera."""
SETTLED, HELD = 8, 4
"""Frames until a still view without noise is at rest, and then until all direction sets are held."""
GRAY: Rgb = (0.5, 0.5, 0.5)


@dataclass(frozen=True)
class Part:
    """A real solid of one colour."""

    solid: Solid
    albedo: Rgb
    step_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Movement from frame to frame; only for spheres."""
    start_frame: int = 0
    """Frame after which it moves."""

    def steps(self, index: int) -> int:
        """Number of steps until a frame."""
        return max(index - self.start_frame, 0) if any(self.step_m) else 0

    def at(self, index: int) -> Solid:
        """The solid at its position in a frame."""
        if not self.steps(index):
            return self.solid
        assert isinstance(self.solid, Sphere)
        return Sphere(self.solid.center + self.steps(index) * np.array(self.step_m), self.solid.radius)


@dataclass(frozen=True)
class GalleryScene:
    """A scene and its expected plan."""

    description: str
    parts: tuple[Part, ...]
    sh: Floats
    """[16, 3] radiance."""
    expected_effects: Callable[[int], Effects]
    """Effects that a frame needs, by its index."""
    objects: tuple[GalleryObject, ...] = ()
    eye: tuple[float, float, float] = (0.0, 0.9, 1.5)
    target: tuple[float, float, float] = (0.0, 0.1, 0.0)
    camera_step_m: float = 0.01
    """Movement of the camera to the right, from frame to frame."""
    frames: int = FRAMES
    noise_codes: float = 0.0
    """Standard deviation of the picture's noise in codes."""
    depth_noise: float = 0.0
    """Depth noise relative to a structured-light sensor (Nguyen et al. 2012)."""
    is_light_given: bool = True
    later_light: tuple[int, Floats] | None = None
    """(frame, SH [16, 3]): the light from this frame on."""
    resting_frames: range = range(0)
    """Frames in which the spine has nothing new to compute."""
    held_frames: range = range(0)
    """Resting frames in which effects have nothing new to draw either."""
    largest_changed_share: float = 1.0
    """Upper bound of the share of real pixels that virtual objects change visibly, without sharp shadows."""
    noise_dependent_effects: Effects = frozenset()
    """Effects that frames may or may not need, depending on noise."""
    settling_frames: range = range(0)
    """Frames that may or may not rest, depending on noise."""
    poses: Poses = "given"
    tone_mapping: Literal["auto", "light", "average"] = "auto"


def sky(brightness: float) -> Floats:
    """[16, 3] uniform sky."""
    sh = np.zeros((COEFFICIENTS, 3))
    sh[0] = brightness * np.sqrt(4 * np.pi)
    return sh


def sun(x: float, y: float, z: float, brightness: float, color: Rgb = (1.0, 0.95, 0.85)) -> Floats:
    """[16, 3] a small distant light; brightness: shading of a white surface that faces it."""
    direction = np.array([x, y, z]) / np.linalg.norm([x, y, z])
    return np.outer(directional_sh(direction, 0.12, 4), brightness * np.array(color))


_FLOOR = (Part(box((0, -0.05, 0), (3.0, 0.1, 3.0)), (0.8, 0.8, 0.8)),)
_DARK_FLOOR = (Part(box((0, -0.05, 0), (3.0, 0.1, 3.0)), (0.08, 0.08, 0.08)),)
_HALL = (Part(box((0, -0.05, 0), (6.0, 0.1, 6.0)), (0.8, 0.8, 0.8)),)
_FROM_AFAR: dict[str, Any] = {"eye": (0.0, 1.6, 2.6), "target": (0.0, 0.0, 0.2)}
_WALL = Part(box((0, 0.6, -0.65), (3.0, 1.4, 0.1)), GRAY)
_ROOM = Part(Shell(np.array([-1.5, 0, -1.5]), np.array([1.5, 2.2, 2.0]), (Opening(3, (-1.0, -1.0), (1.0, 1.0)),)), GRAY)
_SOFT = sky(0.7)
_SUN = sky(0.25) + sun(0.9, 0.7, 0.3, 0.7)
_BALL = GalleryObject(0.24, (0.0, 0.0, 0.0))
_BOX = GalleryObject(0.2, (0.0, 0.0, 0.0), is_box=True)
_HAND = Part(Sphere(np.array([0.9, 0.3, 0.1]), 0.12), (0.68, 0.44, 0.34), (-0.12, 0.0, 0.0))
SETTLED_NOISY = 36
_NOISE: dict[str, Any] = {
    "camera_step_m": 0.0,
    "frames": STILL_FRAMES,
    "noise_codes": 2.5,
    "depth_noise": 1.0,
    "settling_frames": range(SETTLED, SETTLED_NOISY),
    "noise_dependent_effects": frozenset({"bounce_real"}),
}

_DRAWN = {"rasterize", "composite"}
_SHADED = _DRAWN | {"prepare_rays", "add_objects", "shade_virtual"}
_SENT = {"first_shadow", "light_objects"}
_STANDS = _SHADED | _SENT | {"shadow_real", "mark_changes"}
_MAPPED = {"shadow_map", "light_samples", "direct_real"}


def _always(*effects: set[str]) -> Callable[[int], Effects]:
    expected = frozenset(set().union(*effects))
    return lambda _index: expected


GALLERY: dict[str, GalleryScene] = {
    "nothing": GalleryScene("nothing virtual", _FLOOR, _SOFT, _always({"composite"})),
    "elsewhere": GalleryScene(
        "a ball behind the camera, on the floor below",
        _FLOOR,
        _SUN,
        _always({"composite"}),
        (GalleryObject(0.2, (0.0, -1.2, 2.5)),),
    ),
    "shadow-falls-in": GalleryScene(
        "a ball beside the picture, whose sharp shadow falls into the picture",
        _FLOOR,
        _SUN,
        _always({"composite", "prepare_rays", "shadow_real", "mark_changes", "bounce_real"}, _SENT, _MAPPED),
        (GalleryObject(0.3, (1.15, 0.35, 0.2)),),
    ),
    "floating": GalleryScene(
        "a marble in the air, far from the wall behind",
        (Part(box((0, 0.6, -2.65), (6.0, 5.0, 0.1)), GRAY),),
        _SOFT,
        _always(_SHADED, {"light_objects"}),
        (GalleryObject(0.03, (0.0, 0.9, 0.9)),),
        target=(0.0, 0.9, 0.0),
    ),
    "closed-room": GalleryScene(
        "a matt ball in a room that is open above only", (_ROOM,), sky(1.6), _always(_STANDS, {"bounce_real"}), (_BALL,)
    ),
    "glossy": GalleryScene(
        "a polished metal ball on a floor",
        _FLOOR,
        _SOFT,
        _always(_STANDS, {"reflect", "bounce_real"}),
        (GalleryObject(0.24, (0.0, 0.0, 0.0), roughness=0.15, metalness=1.0),),
    ),
    "soft-sky": GalleryScene(
        "a matt box on a floor under an even sky",
        _FLOOR,
        _SOFT,
        _always(_STANDS, {"bounce_real"}),
        (GalleryObject(0.2, (0.0, 0.0, 0.0), is_box=True),),
    ),
    "dark-floor": GalleryScene(
        "a matt ball on a floor that reflects almost nothing, seen from above",
        _DARK_FLOOR,
        _SOFT,
        _always(_STANDS),
        (_BALL,),
        eye=(0.0, 1.5, 0.6),
        target=(0.0, 0.0, 0.1),
    ),
    "sharp-sun": GalleryScene(
        "a matt ball on a floor in the sun",
        _FLOOR,
        _SUN,
        _always(_STANDS, _MAPPED, {"direct_virtual", "bounce_real"}),
        (_BALL,),
    ),
    "far-away": GalleryScene(
        "a small matt box on the floor of a hall, seen from afar",
        _HALL,
        _SOFT,
        _always(_STANDS, {"bounce_real"}),
        (replace(_BOX, size_m=0.1),),
        **_FROM_AFAR,
        largest_changed_share=0.2,
    ),
    "long-shadow": GalleryScene(
        "a small matt ball in the air of a hall, whose shadow falls far away in a low sun",
        _HALL,
        sky(0.25) + sun(0.93, 0.35, 0.1, 0.7),
        _always(_STANDS, _MAPPED, {"direct_virtual", "bounce_real"}),
        (GalleryObject(0.16, (0.5, 0.2, 0.0)),),
        **_FROM_AFAR,
        largest_changed_share=0.35,
    ),
    "two-suns": GalleryScene(
        "a matt ball on a floor in two lights",
        _FLOOR,
        sky(0.2) + sun(0.9, 0.7, 0.3, 0.45) + sun(-0.8, 0.8, 0.2, 0.4, (0.7, 0.85, 1.0)),
        _always(_STANDS, _MAPPED, {"direct_virtual", "bounce_real"}),
        (_BALL,),
    ),
    "black-room": GalleryScene(
        "a ball in a room without any light", (_ROOM,), sky(0.0), _always(_DRAWN), (_BALL,), is_light_given=False
    ),
    "red-wall": GalleryScene(
        "a white ball beside a saturated wall",
        (*_FLOOR, Part(box((-0.25, 0.5, 0), (0.1, 1.2, 1.4)), (0.7, 0.04, 0.03))),
        _SOFT,
        _always(_STANDS, {"bounce_real"}),
        (GalleryObject(0.24, (0.0, 0.0, 0.0), color=(0.95, 0.95, 0.95)),),
    ),
    "soot": GalleryScene(
        "a ball as black as soot, off the floor",
        _FLOOR,
        _SOFT,
        _always(_STANDS - _SENT, {"bounce_real"}),
        (GalleryObject(0.24, (0.0, 0.0, 0.0), color=(0.0, 0.0, 0.0)),),
    ),
    "comes-in": GalleryScene(
        "a ball that floats into the picture along the far wall's side",
        (Part(box((0, 0.6, -2.65), (6.0, 5.0, 0.1)), GRAY),),
        _SOFT,
        lambda index: frozenset({"composite"} if index < 3 else _SHADED | {"light_objects"}),
        (GalleryObject(0.03, (-0.62, 0.9, 0.9), (0.1, 0.0, 0.0)),),
        target=(0.0, 0.9, 0.0),
        camera_step_m=0.0,
    ),
    "still": GalleryScene(
        "a matt ball on a floor in the sun, before a camera that stands still",
        _FLOOR,
        _SUN,
        _always(_STANDS, _MAPPED, {"direct_virtual", "bounce_real"}),
        (_BALL,),
        camera_step_m=0.0,
        frames=STILL_FRAMES,
        resting_frames=range(SETTLED, STILL_FRAMES),
        held_frames=range(SETTLED + HELD, STILL_FRAMES),
    ),
    "still-and-empty": GalleryScene(
        "no virtual object, a still camera",
        _FLOOR,
        _SUN,
        _always({"composite"}),
        camera_step_m=0.0,
        frames=STILL_FRAMES,
        resting_frames=range(SETTLED, STILL_FRAMES),
    ),
    "still-noisy": GalleryScene(
        "a matt box on a floor, before a camera that stands still and has a sensor's noise",
        _FLOOR,
        _SOFT,
        _always(_STANDS, {"bounce_real"}),
        (_BOX,),
        **_NOISE,
        resting_frames=range(SETTLED_NOISY, STILL_FRAMES),
        held_frames=range(SETTLED_NOISY, STILL_FRAMES),
    ),
    "still-tracked": GalleryScene(
        "no virtual object, a still camera with noise and without given poses",
        _FLOOR,
        _SOFT,
        _always({"composite"}),
        **_NOISE,
        resting_frames=range(SETTLED_NOISY, STILL_FRAMES),
        poses="track",
    ),
    "moved-while-still": GalleryScene(
        "the same box, which is moved after a while",
        _FLOOR,
        _SOFT,
        _always(_STANDS, {"bounce_real"}),
        (replace(_BOX, step_m=(0.01, 0.0, 0.005), start_frame=CHANGE_FRAME),),
        **_NOISE,
        resting_frames=range(SETTLED_NOISY, STILL_FRAMES),
        held_frames=range(SETTLED_NOISY, CHANGE_FRAME + 1),
    ),
    "lamp-switches-while-still": GalleryScene(
        "the same box in an estimated light, one part of which is switched off",
        _FLOOR,
        _SUN,
        _always(_STANDS, {"bounce_real"}),
        (_BOX,),
        **_NOISE,
        is_light_given=False,
        later_light=(CHANGE_FRAME, sky(0.25) + sun(0.9, 0.7, 0.3, 0.63)),
        resting_frames=range(SETTLED_NOISY, CHANGE_FRAME),
        held_frames=range(SETTLED_NOISY, CHANGE_FRAME),
    ),
    "hand-enters-while-still": GalleryScene(
        "the same box, above which a real ball moves in after a while",
        (*_FLOOR, replace(_HAND, start_frame=CHANGE_FRAME - 1)),
        _SOFT,
        _always(_STANDS, {"bounce_real"}),
        (_BOX,),
        **_NOISE,
        resting_frames=range(SETTLED_NOISY, CHANGE_FRAME),
        held_frames=range(SETTLED_NOISY, CHANGE_FRAME),
    ),
    "hand": GalleryScene(
        "a real ball moves in above a virtual one, with brightness matched to the picture",
        (*_FLOOR, _HAND),
        _SOFT,
        _always(_STANDS, {"match_average", "bounce_real"}),
        (_BALL,),
        camera_step_m=0.0,
        tone_mapping="average",
    ),
}
