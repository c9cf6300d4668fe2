"""Bits a second that frames take on the way up, by coding, and what leaving bits out costs in light and picture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import islice

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from client.adaptive import LADDER
from client.coding import Coding, frame_message, picture_bytes
from client.laptop.source import Source, open_source
from protocol.frames import CameraModel, RgbdFrame
from protocol.images import decode_color, decode_depth
from server.evaluation.environment import direction_error_deg
from server.evaluation.report import Row
from server.opencl.device import Device
from server.pipeline import Pipeline
from server.scene.mesh import load_mesh
from server.scene.placement import Placement
from server.scene.vase import vase_glb
from tests.bench.light_runs import wishes_for
from tests.bench.service_speed import looked_at
from tests.data import ROOT

FPS = 15
KITCHEN = ROOT.parent / "shared" / "data" / "rgbd_7scenes_redkitchen"
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


def mbit_per_s(frames: list[RgbdFrame], camera: CameraModel, coding: Coding) -> float:
    """At 15 frames a second."""
    sizes = [picture_bytes(frame_message(frame, camera, coding=coding)) for frame in frames]
    return float(np.mean(sizes)) * 8e-6 * FPS


def bandwidth_rows(count: int, say: Callable[[str], None]) -> list[Row]:
    """Of the kitchen and of OAK-like depth."""
    kitchen, room = open_source(str(KITCHEN)), open_source("synthetic:room?frames=40")
    frames = _spread(kitchen, count)
    say(f"bandwidth of {len(frames)} frames of each source")
    coded = {"full quality": Coding(), "exact depth": EXACT, "depth within a step": ROUNDED, "within two": COARSER}
    goals = {"exact depth": "<= 12", "depth within a step": "<= 4", "within two": "<= 4"}
    rows = [
        Row(f"kitchen, {name}", mbit_per_s(frames, kitchen.camera, coding), "Mbit/s", goals.get(name, ""))
        for name, coding in coded.items()
    ]
    oak = [replace(f, depth=oak_like(f.depth, room.camera, f.index)) for f in _spread(room, min(count, 10))]
    rounded = replace(LADDER[5], depth_noise_per_m=oak_noise_per_m(room.camera))
    for name, coding in {"full quality": Coding(), "exact depth": EXACT, "depth below its noise": rounded}.items():
        rows.append(Row(f"OAK-like room, {name}", mbit_per_s(oak, room.camera, coding), "Mbit/s", ""))
    return rows


def cost_rows(device: Device, count: int, say: Callable[[str], None]) -> list[Row]:
    """Light and picture with what is left out, against the frames themselves."""
    source = open_source(str(KITCHEN))
    frames = list(islice((source[i] for i in range(len(source))), count))
    truth = _run(device, source, frames)
    virtual = [(np.abs(p.astype(int) - f.color) > 2).any(-1) for (p, _), f in zip(truth, frames, strict=True)]
    rows = []
    codings = {
        "exact depth, reduced colour": EXACT,
        "full colour, depth within a step": Coding(depth_noise_per_m=KINECT_NOISE_PER_M),
        "full colour, within two": Coding(depth_noise_per_m=2 * KINECT_NOISE_PER_M),
        "reduced colour, depth within a step": ROUNDED,
    }
    for name, coding in codings.items():
        say(f"cost of {name}, {count} frames")
        found = _run(device, source, [_over_the_wire(frame, source.camera, coding) for frame in frames])
        pairs = list(zip(found, truth, strict=True))
        turns = [direction_error_deg(light, true_light) for (_, light), (_, true_light) in pairs]
        errors = [np.abs(picture.astype(int) - true) for (picture, _), (true, _) in pairs]
        on_virtual = np.concatenate([error[mask].ravel() for error, mask in zip(errors, virtual, strict=True)])
        rows += [
            Row(f"cost of {name}: direction of the light, last frame", turns[-1], "degrees", ""),
            Row(f"cost of {name}: direction, mean", float(np.mean(turns)), "degrees", ""),
            Row(f"cost of {name}: picture, mean", float(np.mean(errors)), "of 255", ""),
            Row(f"cost of {name}: virtual pixels, mean", float(on_virtual.mean()), "of 255", ""),
        ]
    return rows


def _spread(source: Source, count: int) -> list[RgbdFrame]:
    return [source[int(i)] for i in np.linspace(0, len(source) - 1, count).round()]


def _over_the_wire(frame: RgbdFrame, camera: CameraModel, coding: Coding) -> RgbdFrame:
    message = frame_message(frame, camera, coding=coding)
    assert message.color is not None
    assert message.depth is not None
    return replace(frame, color=decode_color(message.color, camera), depth=decode_depth(message.depth, camera))


def _run(
    device: Device, source: Source, frames: list[RgbdFrame]
) -> list[tuple[NDArray[np.uint8], NDArray[np.float64]]]:
    """Picture and light of each frame, with a vase where the first one looks."""
    wishes = msgspec.structs.replace(wishes_for(source, range(len(source))), preset="reg4")
    pipeline = Pipeline(device, source.camera, wishes)
    x, y, z = looked_at(source[0], source.camera.depth_scale_m).tolist()
    pipeline.place_object("vase", load_mesh(vase_glb(), "glb"), Placement(position_m=(x, y, z), scale=1.0, yaw_deg=0.0))
    try:
        results = [pipeline.process(frame) for frame in frames]
    finally:
        pipeline.close()
    return [(result.color, np.array(result.light.sh)) for result in results]
