"""What a `synthetic:NAME[?key=value&...]` says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any
from urllib.parse import parse_qsl

from client.laptop.errors import SourceError
from client.laptop.synthetic import scenes
from client.laptop.synthetic.halves import halves
from client.laptop.synthetic.lamps import PLACES_M
from client.laptop.synthetic.lights import RING_SIZE
from protocol.limits import MAX_IMAGE_PIXELS

LARGEST_FRAMES = 100_000
LARGEST_LAMPS = 2

SCENES: dict[str, Callable[[], scenes.Scene]] = {
    "room": scenes.room,
    "table": scenes.table,
    "hand": scenes.table,
    "light": scenes.table,
    "lamp": scenes.lamp_room,
    "halves": halves,
}


@dataclass(frozen=True)
class Options:
    """What stands after the name."""

    name: str
    frames: int = 60
    size: tuple[int, int] = (640, 480)
    light: int = 1
    texture: bool = False
    noise: bool = False
    lamps: int = 0
    place: int = 0
    """Of the first lamp, see lamps.py."""


def parse_spec(spec: str) -> Options:
    """Raises SourceError naming what is wrong."""
    name, _, query = spec.removeprefix("synthetic:").partition("?")
    if name not in SCENES:
        raise SourceError(f"{spec}: there is no such scene; use synthetic:{', synthetic:'.join(SCENES)}")
    options = Options(name, texture=name in ("room", "halves"), lamps=int(name == "lamp"))
    for key, value in parse_qsl(query, keep_blank_values=True):
        if key not in _KEYS:
            raise SourceError(f"{spec}: there is no key {key!r}; use {', '.join(_KEYS)}")
        try:
            options = replace(options, **{key: _KEYS[key](value)})
        except ValueError as error:
            raise SourceError(f"{spec}: {key}={value}: expected {error}") from None
    if options.lamps and name != "lamp":
        raise SourceError(f"{spec}: only synthetic:lamp has lamps")
    return options


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


_KEYS: dict[str, Callable[[str], Any]] = {
    "frames": _count(1, LARGEST_FRAMES),
    "size": _size,
    "light": _count(0, RING_SIZE - 1),
    "texture": _flag,
    "noise": _flag,
    "lamps": _count(0, LARGEST_LAMPS),
    "place": _count(0, len(PLACES_M) - 1),
}
