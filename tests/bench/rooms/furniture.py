"""A furnished room by chance: shapes, paints and lamps, the same for the same seed.

World axes as in the ground-truth sets: x right, y down, z forward; the floor is y = 0, the room lies about x = z = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Kind = Literal["cube", "rectangle", "sphere"]

TEXELS = 256
"""Along a side of a texture."""
LARGER_M = np.array([2.0, 0.0, 2.0])
"""By how much a large room is larger: its walls are a metre farther from what stands in its middle."""
TABLE_M = 0.74
"""Height of the table's top."""
WARM, COOL, WHITE = np.array([1.0, 0.72, 0.42]), np.array([0.75, 0.9, 1.15]), np.array([1.0, 0.93, 0.82])
"""Colours of bulbs, of windows and of panels."""
PANE = WHITE / 2
"""Albedo of what sends light."""


@dataclass(frozen=True)
class Shape:
    """A shape of -1 to 1 along its axes: a cube, a sphere, or the square z = 0 that faces +z."""

    kind: Kind
    world_from_shape: Floats
    """[4, 4]."""
    albedo: Floats
    """[3], or a texture [h, w, 3]."""
    repeats: tuple[float, float] = (1.0, 1.0)
    """Of the texture, along both sides."""
    radiance: Floats | None = None
    """[3] that it sends; None: it is no lamp."""


@dataclass
class Room:
    """A room with what stands in it. Metres."""

    size: Floats
    """[3] width, height and depth."""
    side: float
    """The table is off to the left for 1, to the right for -1."""
    shapes: list[Shape] = field(default_factory=list)

    @property
    def places(self) -> list[tuple[str, Floats]]:
        """Where light is asked for, [3] each: on the table and the floor first."""
        near = [
            ("table", -0.48, -0.84, 0.43),
            ("floor", 0.72, -0.21, 0.5),
            ("floor, in front of the table", -0.2, -0.1, -0.35),
        ]
        middle = ("mid-air, over the middle of the room", 0.1, -1.2, 0.2)
        corner = ("mid-air, far side", self.size[0] / 2 - 0.7, -1.2, self.size[2] / 2 - 0.8)
        return [(what, np.array([self.side * x, y, z])) for what, x, y, z in (*near, middle, corner)]


def camera_pose(room: Room, share: float, *, turns: bool = False) -> Floats:
    """[4, 4] world_from_camera at a share of the way, from 0 to 1: from the table over to the other side.

    turns: it turns once around instead, and looks up to the ceiling now and then.
    """
    y = -1.4 + 0.04 * np.sin(7 * share)
    if turns:
        place = [(-0.15 + 0.25 * np.sin(np.pi * share)) * room.side, y, -1.0 + 0.4 * share]
        yaw, pitch = room.side * np.radians(-17 + 360 * share), np.radians(14 - 22 * np.sin(6 * np.pi * share))
    else:
        eased = share * share * (3 - 2 * share)
        place = [(-0.15 + 0.55 * eased) * room.side, y, -1.0 + 0.45 * eased]
        yaw, pitch = room.side * np.radians(-17 + 57 * eased), np.radians(29 + 1.5 * np.sin(5 * share))
    forward = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, place], axis=1)
    return pose


def furnished_room(seed: int, light: str, *, is_large: bool = False) -> Room:
    """A room with one of the LIGHTS. Raises KeyError for another."""
    random = np.random.default_rng(seed)
    size = np.array([random.uniform(3.4, 5.2), random.uniform(2.4, 2.8), random.uniform(3.6, 5.2)])
    if is_large:
        size += LARGER_M
    room = Room(size, float(random.choice([-1.0, 1.0])))
    builder = _Builder(room, random)
    builder.walls()
    builder.table()
    builder.furniture()
    LIGHTS[light](builder)
    return room


class _Builder:
    """Adds shapes to a room."""

    def __init__(self, room: Room, random: np.random.Generator) -> None:
        self.room, self.random = room, random
        self.x, self.height, self.z = room.size * [0.5, 1.0, 0.5]

    def color(self, low: float = 0.1, high: float = 0.8, saturation: float | None = None) -> Floats:
        """[3] an albedo whose greatest channel is between `low` and `high`."""
        tint = self.random.uniform(0, 1, 3)
        value = self.random.uniform(low, high)
        share = self.random.uniform(0, 0.9) if saturation is None else saturation
        return np.clip(value * (1 - share + share * tint / tint.max()), 0.03, 0.9)

    def box(self, low: list[float], high: list[float], albedo: Floats, turn_deg: float = 0.0) -> None:
        """Upright, turned about its middle."""
        lower, upper = np.array(low), np.array(high)
        matrix = np.eye(4)
        cosine, sine = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
        turn = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
        matrix[:3, :3], matrix[:3, 3] = turn * ((upper - lower) / 2), (lower + upper) / 2
        self.room.shapes.append(Shape("cube", matrix, albedo))

    def ball(self, center: list[float], radius: float, albedo: Floats, radiance: Floats | None = None) -> None:
        """A sphere."""
        matrix = np.diag([radius, radius, radius, 1.0])
        matrix[:3, 3] = center
        self.room.shapes.append(Shape("sphere", matrix, albedo, radiance=radiance))

    def square(
        self,
        center: list[float],
        first: list[float],
        second: list[float],
        albedo: Floats,
        repeats: tuple[float, float] = (1.0, 1.0),
        radiance: Floats | None = None,
    ) -> None:
        """With half sides `first` and `second`; it faces along their cross product."""
        matrix = np.eye(4)
        facing = np.cross(first, second)
        matrix[:3] = np.stack([first, second, facing / np.linalg.norm(facing), center], axis=1)
        self.room.shapes.append(Shape("rectangle", matrix, albedo, repeats, radiance))

    def walls(self) -> None:
        """Floor, ceiling, and four walls, two of them papered."""
        x, z, half = self.x, self.z, self.height / 2
        floors = (self._planks, self._tiles, self._carpet)
        floor = floors[self.random.integers(3)](self.color(0.2, 0.5, 0.4))
        self.square([0, 0, 0], [x, 0, 0], [0, 0, z], floor, (x / 0.75, z / 0.75))
        self.square([0, -self.height, 0], [0, 0, z], [x, 0, 0], self.color(0.7, 0.85, 0.05))
        paint, other = (
            self.color(0.35, 0.8, self.random.uniform(0, 0.35)),
            self.color(0.3, 0.7, self.random.uniform(0.1, 0.6)),
        )
        paper = self._stripes if self.random.random() < 0.5 else self._dots
        self.square([0, -half, z], [0, half, 0], [x, 0, 0], paper(other), (3.0, 3.0))
        self.square([0, -half, -z], [x, 0, 0], [0, half, 0], paint)
        self.square([-x, -half, 0], [0, half, 0], [0, 0, z], paint)
        self.square([x, -half, 0], [0, 0, z], [0, half, 0], paper(paint), (3.0, 3.0))

    def table(self) -> None:
        """A table with things on it, out of the way of the first place."""
        x, z, top, leg = -0.35 * self.room.side, 0.45, self._planks(self.color(0.4, 0.65, 0.45)), self.color(0.2, 0.6)
        self.box([x - 0.6, -TABLE_M, z - 0.35], [x + 0.6, 0.04 - TABLE_M, z + 0.35], top)
        for across in (-0.55, 0.55):
            for along in (-0.3, 0.3):
                low, high = (
                    [x + across - 0.03, 0.04 - TABLE_M, z + along - 0.03],
                    [x + across + 0.03, 0.0, z + along + 0.03],
                )
                self.box(low, high, leg)
        for _ in range(self.random.integers(1, 4)):
            at, half = x + self.room.side * self.random.uniform(0.1, 0.5), self.random.uniform(0.03, 0.08)
            depth = z + self.random.uniform(0.05, 0.25)
            if self.random.random() < 0.5:
                tall = self.random.uniform(0.06, 0.25)
                low, high = [at - half, -TABLE_M - tall, depth - half], [at + half, -TABLE_M, depth + half]
                self.box(low, high, self.color(), self.random.uniform(0, 90))
            else:
                self.ball([at, -TABLE_M - half, depth], half, self.color())

    def furniture(self) -> None:
        """Two large things at the far wall, one beside, a rug and a picture now and then."""
        kinds: list[Callable[[float], None]] = [self._shelf, self._sofa, self._cabinet, self._boxes]
        chosen = self.random.permutation(len(kinds))[:2]
        kinds[chosen[0]](-0.55 * self.x)
        kinds[chosen[1]](0.5 * self.x)
        edges = sorted([self.room.side * (self.x - 0.5), self.room.side * self.x])
        self.box([edges[0], -self.random.uniform(0.4, 0.9), -0.2], [edges[1], 0, 1.2], self.color())
        if self.random.random() < 0.5:
            self.box([-0.9, -0.008, -0.6], [0.9, 0, 0.9], self.color(0.15, 0.6))
        if self.random.random() < 0.6:
            picture = self._carpet(self.color(0.2, 0.7, 0.9))
            self.square([0, -1.5, self.z - 0.02], [0, 0.3, 0], [0.4, 0, 0], picture)

    def _shelf(self, x: float) -> None:
        half, tall, paint = self.random.uniform(0.35, 0.55), self.random.uniform(1.2, 2.0), self.color(0.15, 0.6)
        near, far = self.z - 0.37, self.z - 0.02
        for side in (x - half, x + half - 0.03):
            self.box([side, -tall, near], [side + 0.03, 0, far], paint)
        for level in np.linspace(0.05, tall, 4):
            self.box([x - half, -level, near], [x + half, 0.03 - level, far], paint)
            at = x - half + 0.06
            while at < x + half - 0.12 and level < tall and self.random.random() < 0.85:
                wide = self.random.uniform(0.02, 0.05)
                low = [at, -level - self.random.uniform(0.15, 0.26), self.z - 0.28]
                self.box(low, [at + wide, -level, self.z - 0.1], self.color())
                at += wide + self.random.uniform(0, 0.05)

    def _sofa(self, x: float) -> None:
        cloth, z = self.color(0.15, 0.6, 0.8), self.z
        self.box([x - 0.75, -0.42, z - 0.95], [x + 0.75, 0, z - 0.1], cloth)
        self.box([x - 0.75, -0.85, z - 0.3], [x + 0.75, -0.4, z - 0.05], cloth)
        for side in (x - 0.75, x + 0.6):
            self.box([side, -0.6, z - 0.95], [side + 0.15, 0, z - 0.1], cloth)

    def _cabinet(self, x: float) -> None:
        half, tall, z = self.random.uniform(0.4, 0.7), self.random.uniform(0.5, 1.0), self.z
        self.box([x - half, -tall, z - 0.5], [x + half, 0, z - 0.01], self.color())
        for left in (x - half + 0.03, x + 0.015):
            self.box([left, 0.05 - tall, z - 0.52], [left + half - 0.045, -0.05, z - 0.5], self.color())
        self.box([x - 0.2, -tall - 0.35, z - 0.35], [x + 0.2, -tall, z - 0.2], self.color(0.05, 0.4))

    def _boxes(self, x: float) -> None:
        for _ in range(4):
            half = self.random.uniform(0.12, 0.25)
            at, depth = x + self.random.uniform(-0.4, 0.4), self.z - 0.45 - self.random.uniform(0, 0.4)
            low, high = [at - half, -2 * half, depth - half], [at + half, 0, depth + half]
            self.box(low, high, self.color(), self.random.uniform(0, 90))

    def panel(self, x: float, z: float, width: float, depth: float, radiance: Floats) -> None:
        """On the ceiling, with half sides."""
        self.square([x, 0.01 - self.height, z], [0, 0, depth], [width, 0, 0], PANE, radiance=radiance)

    def window(self, wall: Literal["behind", "beside", "ahead"], at: float, half: float, radiance: Floats) -> None:
        """On a wall; at: along it. Beside: on the side that the camera does not turn to."""
        y = -1.5
        if wall == "behind":
            self.square([at, y, 0.01 - self.z], [half, 0, 0], [0, 0.55, 0], PANE, radiance=radiance)
        elif wall == "ahead":
            self.square([at, y, self.z - 0.01], [0, 0.45, 0], [half, 0, 0], PANE, radiance=radiance)
        elif self.room.side > 0:
            self.square([0.01 - self.x, y, at], [0, 0.55, 0], [0, 0, half], PANE, radiance=radiance)
        else:
            self.square([self.x - 0.01, y, at], [0, 0, half], [0, 0.55, 0], PANE, radiance=radiance)

    def _planks(self, base: Floats) -> Floats:
        image = np.zeros((TEXELS, TEXELS, 3))
        for row in range(0, TEXELS, 32):
            grain = 1 + 0.06 * self.random.normal(size=(32, TEXELS, 1))
            is_left = (np.arange(TEXELS) + self.random.integers(TEXELS)) % TEXELS < TEXELS // 2
            shades = np.where(is_left, *self.random.uniform(0.7, 1.2, 2))[None, :, None]
            image[row : row + 32] = base * shades * grain
            image[row] *= 0.5
        return np.clip(image, 0.02, 0.9)

    def _tiles(self, base: Floats) -> Floats:
        is_dark = (np.add.outer(np.arange(TEXELS) // 64, np.arange(TEXELS) // 64) % 2)[..., None]
        stains = 1 + 0.05 * self.random.normal(size=(TEXELS, TEXELS, 1))
        return np.clip(np.where(is_dark, 0.6 * base, 1.3 * base) * stains, 0.02, 0.9)

    def _carpet(self, base: Floats) -> Floats:
        tufts = cv2.GaussianBlur(self.random.normal(size=(TEXELS, TEXELS)), (0, 0), 2)
        return np.clip(base * (1 + 0.2 * (tufts / tufts.std())[..., None]), 0.02, 0.9)

    def _stripes(self, base: Floats) -> Floats:
        is_other = (np.arange(TEXELS) // 16 % 2 == 1)[None, :, None]
        return np.where(is_other, self._shade(base), base) * np.ones((TEXELS, 1, 1))

    def _dots(self, base: Floats) -> Floats:
        row, column = np.mgrid[:TEXELS, :TEXELS] % 32 - 16
        return np.where((row**2 + column**2 < 49)[..., None], self._shade(base), base)

    def _shade(self, base: Floats) -> Floats:
        return np.clip(base * self.random.uniform(0.7, 1.15), 0.03, 0.88)


def _ceiling(build: _Builder) -> None:
    build.panel(build.random.uniform(-0.5, 0.5), build.random.uniform(-0.5, 0.3), 0.3, 0.6, 10 * WHITE)


def _spots(build: _Builder) -> None:
    for _ in range(5):
        x, z = (build.random.uniform(0.4 - half, half - 0.4) for half in (build.x, build.z))
        build.panel(x, z, 0.06, 0.06, 120 * WHITE)


def _lamp_behind_and_window(build: _Builder) -> None:
    build.ball([build.room.side * (build.x - 0.4), -1.5, 0.5 - build.z], 0.13, PANE, 55 * WARM)
    build.window("beside", -0.6, 0.5, 6 * COOL)


def _floor_lamp_and_window_ahead(build: _Builder) -> None:
    x, z = build.room.side * (build.x - 0.45), build.z - 1.7
    build.box([x - 0.015, -1.2, z - 0.015], [x + 0.015, 0.0, z + 0.015], build.color(0.1, 0.3))
    build.ball([x, -1.2, z], 0.14, PANE, 40 * WARM)
    build.window("ahead", -0.3 * build.room.side, 0.4, 6 * COOL)


def _two_windows(build: _Builder) -> None:
    build.window("beside", -0.2, 0.5, 7 * COOL)
    build.window("behind", 0.5, 0.5, 7 * COOL)


LIGHTS: dict[str, Callable[[_Builder], None]] = {
    "ceiling": _ceiling,
    "spots": _spots,
    "window-behind": lambda build: build.window("behind", build.random.uniform(-0.6, 0.6), 0.6, 8 * COOL),
    "window-beside": lambda build: build.window("beside", build.random.uniform(-1, 0.2), 0.6, 8 * COOL),
    "window-ahead": lambda build: build.window("ahead", -0.3 * build.room.side, 0.4, 8 * COOL),
    "windows": _two_windows,
    "lamp": lambda build: build.ball([-build.room.side * (build.x - 0.5), -1.55, 0.9], 0.12, PANE, 60 * WARM),
    "lamp-over-table": lambda build: build.ball([-0.35 * build.room.side + 0.1, -1.95, 0.45], 0.11, PANE, 60 * WARM),
    "lamp-and-window": _lamp_behind_and_window,
    "lamp-and-window-ahead": _floor_lamp_and_window_ahead,
}
"""What lights a room, by name."""
