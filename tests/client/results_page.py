"""Runs of a few small frames, and the data in their page."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from client.results.description import RunDescription
from client.results.frame_output import Captured, FrameOutput
from client.results.output_folder import OutputWriter
from protocol.frames import CameraModel
from protocol.messages import ArrivingLight, LeftOut, Light, OperatingPoint, Plan, Timings
from tests.client.lights import light_of

CAMERA = CameraModel(width=64, height=48, fx=50.0, fy=50.0, cx=31.5, cy=23.5)
DESCRIPTION = RunDescription("a table", CAMERA, 30.0, 12, ("duck <b>.glb",))
OBJECT = slice(20, 32), slice(36, 48)
"""Rows and columns of what is virtual."""
NOTE = "</script><script>alert(1)</script>"


def output_of(frame: int) -> FrameOutput:
    """A wall at 1 m with a red square in front of it, seen by a camera that moves to the right."""
    color = np.random.default_rng(frame // 100).integers(60, 200, (48, 64, 3), np.uint8)
    composite = color.copy()
    composite[OBJECT] = (220, 30, 20)
    pose = np.eye(4)
    pose[0, 3] = 0.01 * frame
    left_out = LeftOut(effect="shadow_map", reason=f"the light is soft, {frame % 2}", error_bound=0.25)
    return FrameOutput(
        frame=frame,
        timestamp_s=100 + frame / 10,
        color=composite,
        light=light_at_object(frame),
        world_from_camera=pose,
        tracking="given",
        timings=Timings(input=1.5, rendering=4.25 + frame, total=12.0 + frame, host=2.0),
        plan=Plan(
            run=("rasterize", "composite"),
            left_out=(left_out,),
            point=OperatingPoint(settings="--rays 81", reason="asked for"),
        ),
        notes=(NOTE,) if frame == 1 else (),
        captured=Captured(color, np.full((48, 64), 1000, np.uint16)),
    )


def light_at_object(frame: int) -> Light:
    """A light, and the light that arrives at the object."""
    light = light_of(frame)
    arriving = ArrivingLight(
        of="object",
        index=0,
        position=(0.1, 0.0, 1.0),
        sh=light.sh,
        sh_std=light.sh_std,
        sh_webxr=light.sh_webxr,
        dominant_direction=(0.0, -1.0, 0.0),
        dominant_intensity=1.0,
        spread_deg=12.5,
        valid=True,
        seen=0.5,
    )
    return light_of(frame, timestamp_s=100 + frame / 10, valid=True, up=(0.0, -1.0, 0.0), at=(arriving,))


def write_run(folder: Path, count: int = 12, **options: Any) -> Path:
    """A run of `count` frames; `options` of OutputWriter."""
    with OutputWriter(folder, replace(DESCRIPTION, total=count), **options) as writer:
        writer.note_device("a fake device")
        for frame in range(count):
            writer.write(output_of(frame))
    return folder


def write_until(folder: Path, error: BaseException, **options: Any) -> None:
    """A run of twelve frames that ends with an error after three."""
    with OutputWriter(folder, DESCRIPTION, **options) as writer:
        for frame in range(3):
            writer.write(output_of(frame))
        raise error


def data_of(folder: Path) -> dict[str, Any]:
    """The data in the page of a run."""
    page = (folder / "index.html").read_text("utf-8")
    (text,) = re.findall(r'<script id="data" type="application/json">(.*?)</script>', page, re.DOTALL)
    return json.loads(text)
