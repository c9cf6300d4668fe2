"""Hypothesis strategies for sessions whose numbers are legal but odd, or as float64 and float32 can be at their worst.

A session is what a client sends: a `hello`, then frames and requests as maps for MessagePack (not typed messages, since
many must be refused). Most numbers lie at the limits that `protocol` sets, on both sides; some are any float there is.
Pictures are small, so that a server on a processor answers many.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from protocol.frames import (
    DEPTH_SCALE_M,
    GREATEST_ANGLE_DEG,
    GREATEST_BASELINE_M,
    GREATEST_DISTORTION,
    GREATEST_PLACE_M,
    GREATEST_SHIFT_M,
    LEAST_FIELD_OF_VIEW_DEG,
)
from protocol.messages import GREATEST_LIGHT, GREATEST_TIMESTAMP_S, GREATEST_TURN_DEG, LEAST_VOLUME_M

FLOAT32 = np.finfo(np.float32)
EXTREMES = (
    0.0,
    -0.0,
    float(FLOAT32.smallest_subnormal),
    float(FLOAT32.tiny) / 2,
    float(FLOAT32.tiny),
    1e-37,
    1e-30,
    float(FLOAT32.eps),
    1.0,
    2.0**24 + 1,
    1e19,
    1e30,
    float(FLOAT32.max),
    2 * float(FLOAT32.max),
    5e-324,
    1.7976931348623157e308,
    math.inf,
    math.nan,
)
"""Of float32 and float64: denormals, the least and greatest normals, the first integer that float32 lacks."""
POSE = "world_from_camera"
SIDES_PX = (8, 9, 13, 16, 17, 31, 33, 48)
WILD_SHARE = 12
"""One number in so many is any float."""


@dataclass(frozen=True)
class OddSession:
    """What one client sends, in order."""

    hello: dict[str, Any]
    messages: tuple[dict[str, Any], ...]


def extremes() -> st.SearchStrategy[float]:
    """Any float64: the extremes and whatever Hypothesis thinks of."""
    signed = st.sampled_from(EXTREMES + tuple(-number for number in EXTREMES))
    return signed | st.floats() | st.floats(width=32)


def near(least: float, most: float) -> st.SearchStrategy[float]:
    """Numbers from `least` to `most`, often these, sometimes just outside, seldom any."""
    ends = [least, most, np.nextafter(least, -np.inf).item(), np.nextafter(most, np.inf).item(), (least + most) / 2]
    inside = st.floats(least, most)
    if least > 0:
        inside = st.floats(math.log(least), math.log(most)).map(lambda power: min(max(math.exp(power), least), most))
    inner = st.sampled_from(ends[:2] + ends[4:]) | inside
    outer = st.integers(0, WILD_SHARE).flatmap(lambda roll: extremes() if roll == 0 else st.sampled_from(ends))
    return st.integers(0, WILD_SHARE).flatmap(lambda roll: outer if roll == 0 else inner)


def whole(least: int, most: int) -> st.SearchStrategy[Any]:
    """Integers from `least` to `most`, seldom beyond or no integers."""
    beyond = st.sampled_from((least - 1, most + 1, 2**53, 2**63, -(2**63), 0, -1)) | extremes()
    inner = st.sampled_from((least, most)) | st.integers(least, most)
    return st.integers(0, 2 * WILD_SHARE).flatmap(lambda roll: beyond if roll == 0 else inner)


def triples(of: st.SearchStrategy[float]) -> st.SearchStrategy[list[float]]:
    """Three of them."""
    return st.lists(of, min_size=3, max_size=3)


PLACES = triples(near(-GREATEST_PLACE_M, GREATEST_PLACE_M) | near(-3.0, 3.0))
DIRECTIONS = triples(near(-1.0, 1.0) | near(-1e6, 1e6) | near(1e-6, 1e-5))


@st.composite
def rigid(draw: st.DrawFn, most_m: float) -> list[float]:
    """Row-major 4x4: a rotation about any axis, as exact as float64 or as loose as is allowed, and a shift."""
    axis = np.array(draw(triples(st.floats(-1, 1))))
    axis = axis / np.linalg.norm(axis) if np.linalg.norm(axis) > 1e-9 else np.array([0.0, 0.0, 1.0])
    angle = draw(st.sampled_from((0.0, math.pi, math.pi / 2, 1e-8)) | st.floats(-math.pi, math.pi))
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    matrix[:3, :3] *= draw(st.sampled_from((*(1.0,) * 20, *(1 + 3e-4, 1 - 3e-4) * 5, -1.0, 2.0)))
    matrix[:3, 3] = draw(triples(near(-most_m, most_m))) if draw(st.booleans()) else draw(triples(near(-0.5, 0.5)))
    rows: list[float] = matrix.ravel().tolist()
    if draw(st.integers(0, WILD_SHARE)) == 0:
        rows[draw(st.integers(0, 15))] = draw(extremes())
    return rows


@st.composite
def lenses(draw: st.DrawFn, width: int, height: int) -> dict[str, Any]:
    """Intrinsics and distortion at the limits of what a pinhole camera can be."""
    lens: dict[str, Any] = {"width": width, "height": height}
    for axis, size in (("x", width), ("y", height)):
        center = draw(st.sampled_from(((size - 1) / 2, 0.0, size - 1.0)) | near(-0.5 * size, 1.5 * size))
        farthest = max(abs(center), abs(size - 1 - center)) if math.isfinite(center) else size
        least = min(max(farthest / math.tan(math.radians(GREATEST_ANGLE_DEG)), 1e-6), 1e300)
        most = size / (2 * math.tan(math.radians(LEAST_FIELD_OF_VIEW_DEG / 2)))
        usual = st.floats(0.6 * size, 2.0 * size)
        lens |= {f"f{axis}": draw(usual | near(min(least, most), most)), f"c{axis}": center}
    if draw(st.integers(0, 3)) == 0:
        weak, strong = near(-0.3, 0.3), near(-GREATEST_DISTORTION, GREATEST_DISTORTION)
        lens["distortion"] = draw(st.lists(draw(st.sampled_from((weak, strong))), min_size=5, max_size=5))
    return lens


@st.composite
def cameras(draw: st.DrawFn) -> dict[str, Any]:
    """A camera, perhaps with a lens of its own for depth."""
    camera = draw(lenses(draw(st.sampled_from(SIDES_PX)), draw(st.sampled_from(SIDES_PX))))
    camera["depth_scale_m"] = draw(st.sampled_from((0.001, 0.001, *DEPTH_SCALE_M)) | near(*DEPTH_SCALE_M))
    if draw(st.integers(0, 5)) == 0:
        lens = draw(lenses(draw(st.sampled_from(SIDES_PX)), draw(st.sampled_from(SIDES_PX))))
        camera["depth"] = lens | {"color_from_depth": draw(rigid(GREATEST_BASELINE_M))}
    return camera


@st.composite
def volumes(draw: st.DrawFn) -> dict[str, Any]:
    """`volume_m` and `voxel_m`: fixed, and from the least to the greatest that can be asked for."""
    center = np.array(draw(PLACES)) if draw(st.integers(0, 5)) == 0 else np.array([0.0, 0.0, 1.5])
    most_m = draw(st.sampled_from((3.0, 3.0, 3.0, 3.0, 30.0, 30.0, GREATEST_PLACE_M)))
    half = np.array(draw(triples(st.floats(0.5, 3.0) | near(LEAST_VOLUME_M / 2, most_m))))
    wishes: dict[str, Any] = {"volume_m": [*(center - half).tolist(), *(center + half).tolist()]}
    voxel = st.sampled_from((None, 0.05, 0.1)) | near(1e-4, 1.0)
    return wishes | {"voxel_m": draw(voxel)}


OPTIONS: dict[str, st.SearchStrategy[Any]] = {
    "rays": whole(4, 96),
    "stride": whole(1, 16),
    "interleave": st.sampled_from((1, 2, 4, 8, 3)),
    "auxiliary_views": whole(16, 64),
    "visibility_state": st.booleans(),
    "smooth_depth": st.booleans(),
    "ray_length_m": near(0.0, 1000.0),
    "albedo": st.sampled_from(("constant", "estimated")),
    "indirect": st.sampled_from(("none", "observed")),
    "as_thesis": st.booleans(),
    "poses": st.sampled_from(("given", "track", "refine")),
    "up": DIRECTIONS,
    "light": st.sampled_from((1, 4, 9)).flatmap(
        lambda count: st.lists(triples(near(-GREATEST_LIGHT, GREATEST_LIGHT)), min_size=count, max_size=count)
    ),
    "light_axes": st.sampled_from(("world", "webxr")),
    "light_at": st.lists(PLACES, max_size=3),
    "lamps": st.sampled_from(("auto", "on", "off")),
    "exposure": st.sampled_from(("auto", "constant")),
    "edges": st.sampled_from(("smooth", "hard")),
    "tone_mapping": st.sampled_from(("auto", "light", "average")),
    "denoise": st.sampled_from(("none", "bilateral", "tv_l1")),
    "denoise_iterations": whole(1, 30),
    "plan": st.sampled_from(("needed", "everything")),
    "cache": st.sampled_from(("on", "off")),
    "answer": st.sampled_from(("picture", "layer", "light")),
    "max_light_error_deg": near(1e-3, 180.0),
    "budget_ms": near(1e-3, 60000.0),
}
"""Fields of `wishes`, of which a session has a few. Counts that only cost time stay small."""
PRESETS = ("rm", "reg4", "reg8", "art1", "art4", "art8", "gr15", "gr15fast", "gr15fast", "gr15fast", "auto")


@st.composite
def wishes(draw: st.DrawFn) -> dict[str, Any]:
    """Options of a session."""
    chosen = draw(st.lists(st.sampled_from(sorted(OPTIONS)), max_size=4, unique=True))
    found = {name: draw(OPTIONS[name]) for name in chosen} | {"preset": draw(st.sampled_from(PRESETS))}
    if {"max_light_error_deg", "budget_ms"} & set(chosen):
        found["preset"] = "auto"
    return found | (draw(volumes()) if draw(st.integers(0, 3)) else {})


def depth_picture(kind: str, width: int, height: int, scale_m: float) -> NDArray[np.uint16]:
    """uint16 [height, width] of one kind: surfaces, steps from the least to the greatest value, noise, nothing."""
    v, u = np.mgrid[:height, :width]
    meters = {"wall": 2.0 + 0 * u, "slope": 0.3 + 0.1 * u, "corner": 1.0 + 0.05 * np.abs(u - v), "close": 1e-3 + 0 * u}
    if kind in meters:
        return np.clip(np.nan_to_num(meters[kind] / scale_m), 0, 65534).astype(np.uint16)
    levels = {"none": 0 * u, "least": 1 + 0 * u, "last": 65534 + 0 * u, "beyond": 65535 + 0 * u}
    steps = {"chess": 65534 * ((u + v) % 2), "stripes": np.where(u % 3, 1, 65535), "one": np.where(u + v, 0, 1500)}
    noise = (u * 7919 + v * 104729 + u * v * 31) % 65536
    return (levels | steps | {"noise": noise})[kind].astype(np.uint16)


DEPTH_KINDS = (
    "wall",
    "slope",
    "corner",
    "close",
    "none",
    "least",
    "last",
    "beyond",
    "chess",
    "stripes",
    "one",
    "noise",
)


@st.composite
def frames(draw: st.DrawFn, camera: dict[str, Any], index: int) -> dict[str, Any]:
    """A frame of that camera."""
    width, height = camera["width"], camera["height"]
    lens = camera.get("depth", camera)
    shade = draw(st.sampled_from((0, 1, 127, 254, 255, None)))
    color = bytes((17 * k) % 256 for k in range(3 * width * height)) if shade is None else None
    depth = depth_picture(draw(st.sampled_from(DEPTH_KINDS)), lens["width"], lens["height"], _scale_m(camera))
    usual = st.sampled_from((index / 10, float(index)))
    frame: dict[str, Any] = {
        "type": "frame",
        "frame": draw(whole(0, 2**53)) if draw(st.integers(0, 2 * WILD_SHARE)) == 0 else index,
        "timestamp_s": draw(usual | usual | near(-GREATEST_TIMESTAMP_S, GREATEST_TIMESTAMP_S)),
        POSE: draw(rigid(GREATEST_PLACE_M)),
        "color": {
            "width": width,
            "height": height,
            "codec": "raw",
            "data": color or bytes([shade or 0]) * (3 * width * height),
        },
        "depth": {"width": lens["width"], "height": lens["height"], "codec": "raw", "data": depth.tobytes()},
    }
    if draw(st.integers(0, 5)) == 0:
        frame["exposure"] = draw(near(1e-6, 1e6))
    if draw(st.integers(0, 2 * WILD_SHARE)) == 0:
        frame["depth"]["rounded_per_m"] = draw(near(1e-6, 1.0))
    return frame


def _scale_m(camera: dict[str, Any]) -> float:
    scale = camera["depth_scale_m"]
    return scale if math.isfinite(scale) and scale > 1e-6 else 1e-3


TRIANGLE = b"""solid t
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 0.1 0 0
vertex 0 0.1 0.05
endloop
endfacet
endsolid t
"""
SPOTS = st.one_of(
    st.fixed_dictionaries({"on": st.just("pixel"), "pixel": st.lists(near(-1e5, 1e5), min_size=2, max_size=2)}),
    st.fixed_dictionaries({"on": st.just("ray"), "origin_m": PLACES, "direction": DIRECTIONS}),
    st.fixed_dictionaries({"on": st.sampled_from(("floor", "table", "auto"))}),
)
_SIZE = {"scale": near(1e-6, 1000.0), "yaw_deg": near(-GREATEST_TURN_DEG, GREATEST_TURN_DEG)}
_PLACED = {"object": st.sampled_from(("a", "b")), **_SIZE}
REQUESTS = st.one_of(
    st.fixed_dictionaries(
        {"type": st.just("place_object"), "format": st.just("stl"), "data": st.just(TRIANGLE), **_PLACED},
        optional={"position_m": PLACES, "height_m": near(1e-4, 1000.0)},
    ),
    st.fixed_dictionaries(
        {"type": st.just("place_object"), "format": st.just("stl"), "data": st.just(TRIANGLE), "spot": SPOTS, **_PLACED}
    ),
    st.fixed_dictionaries({"type": st.just("move_object"), "position_m": PLACES, **_PLACED}),
    st.fixed_dictionaries({"type": st.just("remove_object"), "object": st.sampled_from(("a", "b"))}),
    st.fixed_dictionaries({"type": st.just("quality"), "preset": st.sampled_from(PRESETS[:-1])}),
    st.fixed_dictionaries({"type": st.just("quality"), "preset": st.just("auto"), "budget_ms": near(1e-3, 60000.0)}),
    st.fixed_dictionaries(
        {"type": st.just("request_panorama"), "format": st.sampled_from(("hdr", "exr"))},
        optional={"position_m": PLACES},
    ),
)
"""Without their numbers."""


@st.composite
def sessions(draw: st.DrawFn, count: int, rounds: int = 1) -> OddSession:
    """A session of `count` frames, and a request after some of them.

    In further `rounds` come the same poses with the depths of other frames.
    """
    camera = draw(cameras())
    hello: dict[str, Any] = {"type": "hello", "client": "odd", "camera": camera, "wishes": draw(wishes())}
    if draw(st.integers(0, 4 * WILD_SHARE)) == 0:
        hello |= {"room": "odd", "room_from_world": draw(rigid(GREATEST_SHIFT_M))}
    messages: list[dict[str, Any]] = []
    for index in range(count):
        messages.append(draw(frames(camera, index)))
        if draw(st.integers(0, 7)) == 0:
            messages.append(draw(REQUESTS) | {"request": len(messages)})
    drawn = [message for message in messages if message["type"] == "frame"]
    for index in range(count, rounds * count):
        pose, pictures = drawn[index % count], drawn[(3 * index + index // count) % count]
        messages.append(pictures | {"frame": index, "timestamp_s": index / 10} | {POSE: pose[POSE]})
    return OddSession(hello, tuple(messages))
