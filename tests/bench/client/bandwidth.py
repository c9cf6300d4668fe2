"""Bits a second that frames take on the way up, by coding, and what leaving bits out costs in light and picture."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from statistics import median

import cv2
import numpy as np
from numpy.typing import NDArray

from client.options.source import open_source
from client.sources.frame_source import Source
from client.streaming.adaptive import LADDER
from client.streaming.coding import Coding, frame_message, picture_bytes
from protocol.frames import CameraModel, RgbdFrame
from protocol.images import decode_color, decode_depth
from server.maths.light_direction import direction_error_deg
from server.opencl.device import Device
from server.pipeline import FrameResult
from tests.bench.light.environment import irradiance_error
from tests.bench.report.finished import Part
from tests.bench.report.run import Run, data_source
from tests.bench.speed.suite import KITCHEN, kitchen_stage

FPS = 15
QUICK_FRAMES, FRAMES = {"bandwidth": 10, "cost": 26}, {"bandwidth": 40, "cost": 60}
SETTLED = 20
"""Frames after which light is compared: after fewer, little of the room was seen, and whatever changes in them turns
the light at the object by tens of degrees."""
KINECT_NOISE_PER_M = 0.00285
"""One step of its disparity, an eighth of a pixel at 585 px and 7.5 cm: what one and the same point flickers by."""
OAK_BASELINE_M = 0.075
OAK_DISPARITY_NOISE_PX, OAK_DISPARITY_STEP_PX = 0.1, 1 / 32
EXACT = LADDER[4]
"""The best rung at which the kitchen's colour and exact depth keep within 12 Mbit/s."""
ROUNDED = replace(LADDER[5], depth_noise_per_m=KINECT_NOISE_PER_M)
COARSER = replace(LADDER[5], depth_noise_per_m=2 * KINECT_NOISE_PER_M)


def oak_like(depth: NDArray[np.uint16], camera: CameraModel, seed: int) -> NDArray[np.uint16]:
    """[h, w] exact depth as stereo sees it: noise and steps of disparity, smoothed over 5 x 5 like its median."""
    disparity = camera.fx * OAK_BASELINE_M / np.maximum(depth * camera.depth_scale_m, 1e-3)
    disparity += np.random.default_rng(seed).normal(0, OAK_DISPARITY_NOISE_PX, disparity.shape)
    steps = np.clip(np.rint(disparity / OAK_DISPARITY_STEP_PX), 1, 65535).astype(np.uint16)
    disparity = np.maximum(cv2.medianBlur(steps, 5), 1) * OAK_DISPARITY_STEP_PX
    seen = camera.fx * OAK_BASELINE_M / disparity / camera.depth_scale_m
    return np.where(depth > 0, np.minimum(np.rint(seen), 65535), 0).astype(np.uint16)


def oak_noise_per_m(camera: CameraModel) -> float:
    """Standard deviation at 1 m of what `oak_like` adds before its median, metres."""
    return OAK_DISPARITY_NOISE_PX / (camera.fx * OAK_BASELINE_M)


Seen = tuple[NDArray[np.uint8], NDArray[np.float64]]
"""Picture of one frame, and the light at the virtual object."""


def mbit_per_s(frames: list[RgbdFrame], camera: CameraModel, coding: Coding) -> float:
    """At 15 frames a second."""
    sizes = [picture_bytes(frame_message(frame, camera, coding=coding)) for frame in frames]
    return float(np.mean(sizes)) * 8e-6 * FPS


def depth_mbit_per_s(frames: list[RgbdFrame], camera: CameraModel, coding: Coding) -> float:
    """Of that, what depth takes."""
    found = [frame_message(frame, camera, coding=coding).depth for frame in frames]
    return float(np.mean([len(depth.data) for depth in found if depth is not None])) * 8e-6 * FPS


def kitchen() -> Source:
    """7-Scenes' kitchen. Raises UnmeasurableError where it is not."""
    return data_source(KITCHEN)


def psnr_db(picture: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float:
    """Of all channels."""
    squared = np.mean((picture.astype(np.float64) - truth) ** 2)
    return float(10 * np.log10(255**2 / max(squared, 1e-9)))


def bandwidth_part(run: Run, _out: Path) -> Part:
    """Of the kitchen and of OAK-like depth."""
    source, room = kitchen(), open_source("synthetic:room?frames=40")
    count = run.of(QUICK_FRAMES["bandwidth"], FRAMES["bandwidth"])
    part = Part(sizes={"frames of bandwidth": count})
    frames = _spread(source, count)
    coded = {"full quality": Coding(), "exact depth": EXACT, "depth within a step": ROUNDED, "within two": COARSER}
    goals = {"exact depth": "<= 12", "depth within a step": "<= 4", "within two": "<= 4"}
    for name, coding in coded.items():
        part.add(f"kitchen, {name}", mbit_per_s(frames, source.camera, coding), "Mbit/s", goals.get(name, ""))
    part.add("kitchen, exact depth: depth alone", depth_mbit_per_s(frames, source.camera, EXACT), "Mbit/s")
    oak = [replace(f, depth=oak_like(f.depth, room.camera, f.index)) for f in _spread(room, min(count, 10))]
    rounded = replace(LADDER[5], depth_noise_per_m=oak_noise_per_m(room.camera))
    for name, coding in {"full quality": Coding(), "exact depth": EXACT, "depth below its noise": rounded}.items():
        part.add(f"OAK-like room, {name}", mbit_per_s(oak, room.camera, coding), "Mbit/s")
    return part


def cost_part(run: Run, _out: Path) -> Part:
    """Light and picture with what is left out, against the frames themselves."""
    source, count = kitchen(), run.of(QUICK_FRAMES["cost"], FRAMES["cost"])
    part = Part(sizes={"frames of cost": count})
    frames = list(islice((source[i] for i in range(len(source))), count))
    truth = run_pipeline(run.device, frames)
    virtual = [(np.abs(p.astype(int) - f.color) > 2).any(-1) for (p, _), f in zip(truth, frames, strict=True)]
    codings = {
        "exact depth, reduced colour": EXACT,
        "full colour, depth within a step": Coding(depth_noise_per_m=KINECT_NOISE_PER_M),
        "full colour, within two": Coding(depth_noise_per_m=2 * KINECT_NOISE_PER_M),
        "reduced colour, depth within a step": ROUNDED,
    }
    for name, coding in codings.items():
        run.say(f"cost of {name}, {count} frames")
        found = run_pipeline(run.device, (_over_the_wire(frame, source.camera, coding) for frame in frames))
        add_light(part, f"cost of {name}", found, truth)
        errors = [np.abs(p.astype(int) - true) for (p, _), (true, _) in zip(found, truth, strict=True)]
        on_virtual = np.concatenate([error[mask].ravel() for error, mask in zip(errors, virtual, strict=True)])
        part.add(f"cost of {name}: picture, mean", float(np.mean(errors)), "of 255")
        part.add(f"cost of {name}: virtual pixels, mean", float(on_virtual.mean()), "of 255")
    return part


def _spread(source: Source, count: int) -> list[RgbdFrame]:
    return [source[int(i)] for i in np.linspace(0, len(source) - 1, count).round()]


def _over_the_wire(frame: RgbdFrame, camera: CameraModel, coding: Coding) -> RgbdFrame:
    message = frame_message(frame, camera, coding=coding)
    assert message.color is not None
    assert message.depth is not None
    return replace(frame, color=decode_color(message.color, camera), depth=decode_depth(message.depth, camera))


def run_pipeline(device: Device, frames: Iterable[RgbdFrame]) -> list[Seen]:
    """Picture of each frame of the kitchen with the defaults, and the light at the virtual object on its table."""
    stage = kitchen_stage()
    session = stage.session(device, range(len(stage.source)))
    try:
        return [_seen(session.process(frame)) for frame in frames]
    finally:
        session.close()


def _seen(result: FrameResult) -> Seen:
    at_object = next(light for light in result.light.at if light.of == "object")
    return result.color, np.array(at_object.sh)


def add_light(part: Part, name: str, found: list[Seen], truth: list[Seen]) -> None:
    """By how much the light is off, median of the frames from SETTLED on."""
    pairs = [(light, true) for (_, light), (_, true) in zip(found[SETTLED:], truth[SETTLED:], strict=True)]
    part.add(f"{name}: direction of the light", median(direction_error_deg(*pair) for pair in pairs), "degrees")
    part.add(f"{name}: irradiance", 100 * median(irradiance_error(*pair) for pair in pairs), "%")
