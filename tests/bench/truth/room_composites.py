"""Truth of the path-traced room's composites (`mitsuba_room`): pictures with and without its two virtual objects.

Pictures of one set are in units of its 16-bit value over 65535; `units` turns them into radiance, which sets of one
light share: what global illumination adds to a set's direct light is the difference of two sets.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.shading.composite import srgb_codes
from tests.bench.rendering.pasting import ObjectNormals, pasted
from tests.bench.truth.composite_truth import CompositeTruth
from tests.bench.truth.mitsuba_room import OBJECTS, RoomSet

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


class RoomTruth:
    """What all sets share, of the first frames of the path: where the objects are, and their albedo and normals."""

    def __init__(self, room: Path, camera: CameraModel, poses: list[Floats]) -> None:
        """Raises ImportError where Open3D is not installed."""
        truth = np.load(room / "truth" / "geometry.npz")
        count = len(poses)
        self.room = room
        self.objects: list[Bools] = list(truth["virtual_mask"][:count])
        """[h, w] each: pixels that show an object."""
        self.object_albedo: list[Floats] = list(truth["virtual_albedo"][:count].astype(np.float64))
        """[h, w, 3] each."""
        self._albedo: dict[str, Floats] = {
            "tex": truth["albedo_textured"][:count].astype(np.float64),
            "white": np.full((*truth["depth_m"][:count].shape, 3), float(truth["white_albedo"])),
        }
        normals = ObjectNormals([room / "objects" / name for name in OBJECTS])
        self.object_normals = [normals.seen(camera, pose) for pose in poses]

    def albedo(self, surface: str) -> Floats:
        """[frames, h, w, 3] of the real room."""
        return self._albedo[surface]


@dataclass(frozen=True)
class SetTruth(CompositeTruth):
    """One set's pictures; frame by frame as `room`'s."""

    item: RoomSet
    room: RoomTruth
    units: float
    """Radiance of 1."""
    light: Floats
    """[16, 3] the true light in units of the pictures."""

    @property
    def frames(self) -> range:
        """Those that are compared."""
        return range(len(self.objects))


def set_truth(item: RoomSet, room: RoomTruth) -> SetTruth:
    """Read one set."""
    frames = range(len(room.objects))
    units = float(json.loads((item.folder / "meta.json").read_text())["radiance_at_65535"])
    light, pictures = item.sh / units, [item.picture(i) for i in frames]
    shown = (srgb_codes(picture) for picture in pictures)
    parts = zip(shown, room.objects, room.object_normals, room.object_albedo, strict=True)
    return SetTruth(
        pictures=pictures,
        composites=[item.composite(i) for i in frames],
        objects=room.objects,
        pasted=[pasted(*part, light) for part in parts],
        item=item,
        room=room,
        units=units,
        light=light,
    )
