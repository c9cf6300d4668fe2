"""Parsing of `synthetic:NAME[?key=value&...]`."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any
from urllib.parse import parse_qsl

from client.errors import SourceError
from client.synthetic.camera_exposure import EXPOSURE_CURVES
from client.synthetic.lighting.lamps import PLACES_M
from client.synthetic.lighting.lights import RING_SIZE
from client.synthetic.scenes import scene as scenes
from client.synthetic.scenes.appearance import APPEARANCES
from client.synthetic.scenes.desk import desk
from client.synthetic.scenes.guests import GUESTS
from client.synthetic.scenes.halves import halves
from client.synthetic.scenes.stage import stage
from protocol.limits import MAX_IMAGE_PIXELS

LARGEST_FRAMES = 100_000
LARGEST_LAMPS = 2

SCENES: dict[str, Callable[[], scenes.Scene]] = {
    "room": scenes.room,
    "table": scenes.table,
    "hand": scenes.table,
    "light": scenes.table,
    "lamp": scenes.lamp_room,
    "desk": desk,
    "halves": halves,
    "stage": stage,
}


@dataclass(frozen=True)
class Options:
    """Options of a synthetic scene."""

    name: str
    frames: int = 60
    size: tuple[int, int] = (640, 480)
    light: int = 1
    texture: bool = False
    noise: bool = False
    lamps: int = 0
    place: int = 0
    """Position of the first lamp, see lighting/lamps.py."""
    exposure: str = "constant"
    """Curve over the frames, see camera_exposure.py."""
    exposure_given: bool = True
    """Whether frames report their exposure."""
    appearance: str = "paper"
    """Appearance of the stage set, see scenes/appearance.py."""
    guest: str = "none"
    """Objects inserted into the stage set, see scenes/guests.py."""
    is_still: bool = False
    """Whether the camera of the stage set stands still."""


def parse_spec(spec: str) -> Options:
    """Raises SourceError for an unknown scene or key, or an invalid value."""
    name, _, query = spec.removeprefix("synthetic:").partition("?")
    if name not in SCENES:
        raise SourceError(f"{spec}: there is no such scene; use synthetic:{', synthetic:'.join(SCENES)}")
    options = Options(name, texture=name in ("room", "desk", "halves", "stage"), lamps=int(name == "lamp"))
    keys = _KEYS | (_STAGE_KEYS if name == "stage" else {})
    for key, value in parse_qsl(query, keep_blank_values=True):
        if key not in keys:
            raise SourceError(f"{spec}: there is no key {key!r}; use {', '.join(keys)}")
        field = _STAGE_FIELDS.get(key, key) if name == "stage" else key
        try:
            options = replace(options, **{field: keys[key](value)})
        except ValueError as error:
            raise SourceError(f"{spec}: {key}={value}: expected {error}") from None
    if options.lamps and name != "lamp":
        raise SourceError(f"{spec}: only synthetic:lamp has lamps")
    return options


def scene_of(options: Options) -> scenes.Scene:
    """The scene of these options."""
    return stage(options.appearance, options.is_still) if options.name == "stage" else SCENES[options.name]()


def _count(low: int, high: int) -> Callable[[str], int]:
    def parse(text: str) -> int:
        if not text.isdecimal() or not low <= int(text) <= high:
            raise ValueError(f"a number from {low} to {high}")
        return int(text)

    return parse


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    sides = _count(16, 1920)
    try:
        size = sides(width), sides(height)
    except ValueError:
        raise ValueError("WIDTHxHEIGHT, each from 16 to 1920") from None
    if size[0] * size[1] > MAX_IMAGE_PIXELS:
        raise ValueError(f"{MAX_IMAGE_PIXELS} pixels at the most")
    return size


def _flag(text: str) -> bool:
    return bool(_count(0, 1)(text))


def _one_of(names: Iterable[str]) -> Callable[[str], str]:
    def parse(text: str) -> str:
        if text not in names:
            raise ValueError(f"one of {', '.join(names)}")
        return text

    return parse


_KEYS: dict[str, Callable[[str], Any]] = {
    "frames": _count(1, LARGEST_FRAMES),
    "size": _size,
    "light": _count(0, RING_SIZE - 1),
    "texture": _flag,
    "noise": _flag,
    "lamps": _count(0, LARGEST_LAMPS),
    "place": _count(0, len(PLACES_M) - 1),
    "exposure": _one_of(EXPOSURE_CURVES),
    "exposure_given": _flag,
}
_STAGE_KEYS: dict[str, Callable[[str], Any]] = {
    "texture": _one_of(APPEARANCES),
    "with": _one_of(GUESTS),
    "still": _flag,
}
_STAGE_FIELDS = {"texture": "appearance", "with": "guest", "still": "is_still"}
