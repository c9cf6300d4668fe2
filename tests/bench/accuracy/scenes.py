"""The scenes that knobs are swept on: all of known light, most with known composites.

- `stage`: the stage set of one albedo under direct light, which is what the model says: it is sampling that errs.
- `stage-market`: the same in colours, everything estimated, as `probeless run` would with nothing else said.
- `lit-room`: the room's reconstructed geometry under known lights, another one each frame (thesis 5.3.1); light only.
- `room-key`, `room-studio`: path-traced (mitsuba_room), with global illumination; where the data set is at hand.
- `closed-...`: path-traced closed rooms (rooms), with lamps or a window inside, all estimated; the light is judged at
  the places on table and floor; where the data set is at hand.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from client.options.source import open_source
from client.sources.frame_source import Source
from client.sources.volume import default_volume, default_voxel
from client.synthetic.export import write_guests
from client.synthetic.lighting.lights import disc_light
from client.synthetic.source import open_synthetic
from client.tuning.known_light import moving_light, shaded_views
from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Wishes
from server.maths.sh import spherical_fibonacci
from server.opencl.device import Device
from server.shading.composite import srgb_codes
from tests.bench.light.closed_rooms import NEAR, room_wishes
from tests.bench.light.closed_rooms import OBJECTS as CLOSED_OBJECTS
from tests.bench.rendering.composites import changed_pixels
from tests.bench.report.run import data_folder
from tests.bench.truth.mitsuba_room import OBJECTS, RoomSet

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Shot:
    """A frame and what is known of it."""

    frame: RgbdFrame
    light: Floats
    """[16, 3] from beyond the scan; [places, 16, 3] that arrives at the places of `wishes.light_at`, if there are."""
    composite: NDArray[np.uint8] | None = None
    """[h, w, 3] sRGB codes with the objects in it."""
    changed: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((0, 0), np.bool_))
    """[h, w] where it differs from the picture without them."""


@dataclass
class SweptScene:
    """One scene; its frames are made once and kept."""

    name: str
    camera: CameraModel
    wishes: Wishes
    """The usual ones."""
    make: Callable[[int], list[Shot]]
    write_objects: Callable[[Path], list[Path]] = lambda _folder: []
    _made: dict[int, list[Shot]] = field(default_factory=dict)

    def shots(self, frames: int) -> list[Shot]:
        """The first `frames`."""
        if frames not in self._made:
            self._made[frames] = self.make(frames)
        return self._made[frames]


def scene_named(name: str, device: Device, quick: bool) -> SweptScene:
    """Raises KeyError for one that there is not, UnmeasurableError where its data set is not at hand."""
    return SCENES[name](device, "320x240" if quick else "640x480")


def _wishes(source: Source, **others: Any) -> Wishes:
    volume_m = default_volume(source, range(len(source)))
    usual = Wishes(volume_m=volume_m, voxel_m=default_voxel(volume_m), up=source.up, edges="hard")
    return structs.replace(usual, **others)


def _stage(name: str, query: str, size: str, **wishes: Any) -> SweptScene:
    spec = f"synthetic:stage?size={size}&frames={_STAGE_FRAMES}&{query}"
    bare, guests = open_synthetic(spec), open_synthetic(f"{spec}&with=both")

    def make(frames: int) -> list[Shot]:
        shots = []
        for index in range(0, frames * _STAGE_STEP, _STAGE_STEP):
            shown, composite = (srgb_codes(source.truth(index).radiance) for source in (bare, guests))
            light = np.asarray(bare.truth(index).sh, np.float64)
            shots.append(Shot(bare[index], light, composite, changed_pixels(composite, shown)))
        return shots

    return SweptScene(name, bare.camera, _wishes(bare, **wishes), make, lambda folder: write_guests(folder, guests))


_STAGE_FRAMES, _STAGE_STEP = 60, 2


def _lit_room(device: Device, size: str) -> SweptScene:
    source = open_synthetic(f"synthetic:room?size={size}&frames=240&noise=1&texture=0")
    wishes = _wishes(source, albedo="constant", indirect="none", robustness=("openness", "outliers"))
    assert wishes.volume_m is not None
    assert wishes.voxel_m is not None
    volume_m, voxel_m = wishes.volume_m, wishes.voxel_m

    def make(frames: int) -> list[Shot]:
        views = shaded_views(device, source.camera, (source[2 * i] for i in range(frames)), volume_m, voxel_m)
        lit = moving_light(views, lambda index: light_from_above(index // 2, frames))
        return [Shot(item.frame, item.sh) for item in lit]

    return SweptScene("lit-room", source.camera, wishes, make)


def light_from_above(index: int, count: int) -> Floats:
    """[16, 3] a disc light, each of `count` from another side; y is up."""
    x, y, z = spherical_fibonacci(2 * count)[index % (2 * count)]
    toward = np.array([x, max(abs(z), 0.3), y])
    return disc_light(toward / np.linalg.norm(toward)).sh


def _mitsuba(light: str) -> SweptScene:
    item = RoomSet(data_folder("mitsuba_room"), light, "tex", "gi")
    source = open_source(str(item.folder))

    def make(frames: int) -> list[Shot]:
        shots = []
        for index in range(min(frames, len(source))):
            shown, composite = (srgb_codes(picture) for picture in (item.picture(index), item.composite(index)))
            shots.append(Shot(source[index], item.sh, composite, changed_pixels(composite, shown)))
        return shots

    wishes = _wishes(source, albedo="estimated", indirect="observed")
    files = [item.room / "objects" / name for name in OBJECTS]
    return SweptScene(f"room-{light}", source.camera, wishes, make, lambda _folder: files)


def _closed_room(folder: str) -> SweptScene:
    room = data_folder("rooms") / folder
    source = open_source(str(room))
    probes = json.loads((room / "probes.json").read_text())["probes"][:NEAR]
    light = np.array([probe["sh"] for probe in probes])

    def make(frames: int) -> list[Shot]:
        shots = []
        for index in range(0, min(_CLOSED_STEP * frames, len(source)), _CLOSED_STEP):
            frame, name = source[index], f"{index:06d}.png"
            if not (room / "with_objects" / name).exists():
                shots.append(Shot(frame, light))
                continue
            true = cv2.imread(str(room / "with_objects" / name))
            changed = cv2.imread(str(room / "changed" / name), cv2.IMREAD_GRAYSCALE) > 0
            shots.append(Shot(frame, light, np.ascontiguousarray(true[..., ::-1]), changed))
        return shots

    wishes = room_wishes(source, np.array([probe["position"] for probe in probes]))
    files = [room / name for name in CLOSED_OBJECTS]
    return SweptScene(f"closed-{folder}", source.camera, wishes, make, lambda _folder: files)


_CLOSED_STEP = 2  # every fifth frame has a true picture: of twelve shots, three
CLOSED_ROOMS = ("r1_ceiling", "r2_spots", "r3_two", "r4_window")


SCENES: dict[str, Callable[[Device, str], SweptScene]] = {
    "stage": lambda _device, size: _stage("stage", "texture=paper&light=7", size, albedo="constant", indirect="none"),
    "stage-market": lambda _device, size: _stage(
        "stage-market", "texture=market&light=7", size, albedo="estimated", indirect="observed"
    ),
    "lit-room": _lit_room,
    "room-key": lambda _device, _size: _mitsuba("key"),
    "room-studio": lambda _device, _size: _mitsuba("studio"),
    **{f"closed-{name}": lambda _device, _size, name=name: _closed_room(name) for name in CLOSED_ROOMS},  # type: ignore[misc]
}
QUICK_SCENES = ("stage", "lit-room", "closed-r1_ceiling")
ESTIMATED = tuple(name for name in SCENES if name not in ("stage", "lit-room"))
"""In which nothing is told of albedos and indirect light."""
