"""Truth of the path-traced room (`mitsuba_room`): its lights, and its pictures with the virtual objects in them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from protocol.messages import Wishes

Floats = NDArray[np.float64]

LIGHTS, SURFACES, TRANSPORTS = ("key", "two", "studio"), ("white", "tex"), ("direct", "gi")
OBJECTS = ("v_blob.ply", "v_ring.ply")


@dataclass(frozen=True)
class RoomSet:
    """One of the twelve sets: the same camera path, geometry and objects under one light."""

    room: Path
    """Folder of all sets."""
    light: str
    surface: str
    transport: str

    @property
    def name(self) -> str:
        """As its folder is called."""
        return f"{self.light}_{self.surface}_{self.transport}"

    @property
    def folder(self) -> Path:
        """A SOURCE for `probeless run`."""
        return self.room / self.name

    @cached_property
    def sh(self) -> Floats:
        """[16, 3] radiance; of `studio` the projection."""
        return np.array(json.loads((self.folder / "light.json").read_text())["sh"], np.float64)

    @property
    def has_composites(self) -> bool:
        """Whether there are pictures with the virtual objects."""
        return (self.folder / "with_objects").is_dir()

    def composite(self, index: int) -> Floats:
        """[h, w, 3] linear picture with the virtual objects, in units of the 16-bit value over 65535."""
        return read_linear(self.folder / "with_objects" / f"{index:06d}.png")

    def picture(self, index: int) -> Floats:
        """[h, w, 3] the same without them."""
        return read_linear(self.folder / "color" / f"{index:06d}.png")


def room_sets(room: Path) -> list[RoomSet]:
    """All twelve."""
    return [RoomSet(room, *names) for names in product(LIGHTS, SURFACES, TRANSPORTS)]


def read_linear(path: Path) -> Floats:
    """[h, w, 3] RGB of a 16-bit picture, 1 at 65535. Raises FileNotFoundError."""
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise FileNotFoundError(path)
    return np.asarray(picture[..., ::-1] / 65535.0, np.float64)


def model_for(item: RoomSet, wishes: Wishes) -> Wishes:
    """`wishes` with what a set calls for: albedos estimated, observed indirect light where there is any, else none."""
    indirect = "observed" if item.transport == "gi" else "none"
    return msgspec.structs.replace(wishes, albedo="estimated", indirect=indirect)
