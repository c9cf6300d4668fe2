"""Whole sessions: pictures of nothing, of half of everything, and the same session again."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
from msgspec.structs import replace

from client.options.source import open_source
from client.sources.volume import Volume, default_volume, default_voxel
from client.synthetic.source import SyntheticSource
from protocol.frames import RgbdFrame
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.pipeline import FrameResult
from server.scene.placement import Placement
from tests.hard_cases.catalogue import Family, Found, Trial, share_beyond
from tests.scenes.analytic import look_at
from tests.scenes.bad_depth import BAD_DEPTH, CAMERA, PYRAMID, SIZE, WISHES, assert_sound, frame_of, good_depth
from tests.scenes.lights import unit
from tests.scenes.meshes import soup_of
from tests.scenes.plain_light import PLAIN_LIGHT

SESSIONS = Family("sessions")
_TABLE = "synthetic:table?light=1&frames=12&size=160x120"
"""Exact pictures of a table under a light of 16 coefficients."""
_VIEWS = tuple(look_at((x, -0.2, 0.0), (0.1, 0.3, 1.2)) for x in (0.0, 0.1, 0.2))


def _frames(code: int | None = None) -> list[RgbdFrame]:
    """Three frames of a room, all of whose pixels have that code."""
    frames = [frame_of(good_depth(view), view, index) for index, view in enumerate(_VIEWS)]
    if code is None:
        return frames
    color = np.full((*SIZE, 3), code, np.uint8)
    return [RgbdFrame(f.index, f.timestamp_s, color, f.depth, f.world_from_camera) for f in frames]


def _session(trial: Trial, frames: list[RgbdFrame], preset: str = "reg4") -> FrameResult:
    """The last frame's result, with one object in the room."""
    pipeline = ClientSession(trial.device, CAMERA, replace(WISHES, preset=preset))
    try:
        pipeline.place_object("pyramid", soup_of(PYRAMID), Placement(position_m=(-0.2, 0.7, 1.1)))
        for frame in frames:
            result = pipeline.process(frame)
            assert_sound(result)
    finally:
        pipeline.close()
    return result


@cache
def _table() -> tuple[SyntheticSource, list[RgbdFrame], Volume]:
    """The source, its frames and the volume around what they show: for every case and both its runs."""
    source = open_source(_TABLE)
    assert isinstance(source, SyntheticSource)
    return source, list(source), default_volume(source, range(len(source)))


def _table_light(trial: Trial, preset: str, saturated: slice | None = None) -> Found:
    """Dominant direction after 12 frames, some columns of each picture saturated."""
    source, frames, bounds = _table()
    wishes = Wishes(volume_m=bounds, voxel_m=default_voxel(bounds), preset=preset, **PLAIN_LIGHT)
    pipeline = ClientSession(trial.device, source.camera, wishes)
    try:
        for frame in frames:
            color = frame.color.copy()
            if saturated is not None:
                color[:, saturated] = 255
            light = pipeline.process(dataclasses.replace(frame, color=color)).light
    finally:
        pipeline.close()
    assert np.isfinite(light.sh).all()
    return Found(unit(light.dominant_direction), source.light(len(source) - 1).direction)


for _name, _code in {"all black": 0, "all white": 255}.items():

    @SESSIONS.case(_name, 0, "radiance", "no pixel is usable, so nothing is found: exactly zero.", known=False)
    def one_code(trial: Trial, code: int = _code) -> Found:
        light = _session(trial, _frames(code)).light
        return Found(light.sh, 0, known=light.valid)


@SESSIONS.case("no depth at all", 0, "radiance", "there is no surface to find light from: exactly zero.", known=False)
def no_depth(trial: Trial) -> Found:
    frames = [frame_of(BAD_DEPTH["empty"], view, index) for index, view in enumerate(_VIEWS)]
    light = _session(trial, frames).light
    return Found(light.sh, 0, known=light.valid)


_MODEL = "what of a table 12 frames do not show leaves the direction open to 10 degrees, the light page's worst scene."
for _name, _columns in {"the left half saturated": slice(0, 80), "the right half saturated": slice(80, 160)}.items():

    @SESSIONS.case(
        _name, np.deg2rad(15), "rad", _MODEL + " Half of it, half as much again.", apart=0.02, checkable=False
    )
    def half_saturated(trial: Trial, columns: slice = _columns) -> Found:
        return _table_light(trial, "reg4", columns)


for _preset in ("reg4", "art4", "gr15fast"):

    @SESSIONS.case(f"{_preset}: the light", np.deg2rad(10), "rad", _MODEL, apart=0.02, checkable=False)
    def direction(trial: Trial, preset: str = _preset) -> Found:
        return _table_light(trial, preset)

    @SESSIONS.case(
        f"{_preset}: the picture again",
        0,
        "share of codes",
        "replay on one device is exact to the bit; between builds a code may round to its neighbours, or an edge move.",
        distance=share_beyond(2.5),
        apart=5e-3,
        checkable=False,
    )
    def picture(trial: Trial, preset: str = _preset) -> Found:
        first, again = (_session(trial, _frames(), preset).color.astype(np.float64) for _ in range(2))
        return Found(first, np.where(first == again, first, first + 1000))
