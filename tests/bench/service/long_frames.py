"""One client's frame that takes minutes, and how long another client waits because of it.

The long frame has 1920x1200 pixels with 1024 rays each, of ART8 with nothing left out; the other client sends 320x240
pixels with the default settings, one frame after the other. At the end the first one leaves within its frame.
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import replace
from pathlib import Path
from statistics import median

import cv2
from msgspec import structs

from client.options.source import open_source
from client.sources.frame_source import Source
from client.streaming.client import Answer, StreamClient
from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Wishes
from tests.bench.report.finished import Part
from tests.bench.report.run import Run
from tests.bench.service.process import Served, serving

LONG, SHORT = (1920, 1200), (320, 240)
LONG_WISHES = Wishes(preset="art8", rays=1024, stride=1, plan="everything", lossless=True)
"""Lossless: the server does not sample it more cheaply than was asked."""
FREE_PATIENCE_S = 60.0


def long_frames_part(run: Run, out: Path) -> Part:
    """Alone, beside the long frame, and after its client has left."""
    frames = run.of(30, 200)
    with serving(out / "long_frames.log", "--token", "none", "--data", "none") as served:
        alone, beside, freed_s = asyncio.run(measured(served, open_source("synthetic:room?frames=8"), frames))
    part = Part(sizes={"frames beside a long one": frames})
    part.add("a frame of 320x240, alone on the server: median", 1e3 * median(alone), "ms")
    part.add("the same beside a frame of minutes: median", 1e3 * median(beside), "ms")
    part.add("wait for the device beside a frame of minutes: longest", max(beside) - median(alone), "s", "<= 0.5")
    part.add("a frame is given up after its client has left within", freed_s, "s", "<= 1")
    return part


async def measured(served: Served, source: Source, frames: int) -> tuple[list[float], list[float], float]:
    """Seconds of each frame alone and beside the long one, and until that one is given up."""
    short = await opened(served, source, SHORT, Wishes())
    await answered(short, source, 5)  # its kernels are compiled
    alone = await answered(short, source, frames)
    long = await opened(served, source, LONG, LONG_WISHES)
    await long.send_frame(resized(source[0], LONG))
    beside = await answered(short, source, frames)
    await long.close()
    left_s = time.perf_counter()
    while served.health()["sessions"] > 1:
        if time.perf_counter() > left_s + FREE_PATIENCE_S:
            raise RuntimeError("the server goes on with a frame whose client has left")
        await asyncio.sleep(0.02)
    freed_s = time.perf_counter() - left_s
    await short.close()
    return alone, beside, freed_s


async def opened(served: Served, source: Source, size: tuple[int, int], wishes: Wishes) -> StreamClient:
    """A client whose camera has pictures of this size."""
    client = await StreamClient.connect(served.url)
    await client.hello(resized_camera(source.camera, size), wishes)
    return client


async def answered(client: StreamClient, source: Source, count: int) -> list[float]:
    """Seconds from each frame to its answer. The pictures are made before: that is not the server's work."""
    times, answers = [], aiter(client.answers())
    frames = [resized(source[index], SHORT) for index in range(min(count, len(source)))]
    for index in range(count):
        began_s = time.perf_counter()
        await client.send_frame(frames[index % len(frames)])
        answer = await anext(answers)
        if not isinstance(answer, Answer):
            raise RuntimeError(f"a frame was not answered: {answer}")
        times.append(time.perf_counter() - began_s)
    return times


def resized_camera(camera: CameraModel, size: tuple[int, int]) -> CameraModel:
    """The same view with other pixels."""
    x, y = size[0] / camera.width, size[1] / camera.height
    places = {"fx": camera.fx * x, "fy": camera.fy * y}
    places |= {"cx": (camera.cx + 0.5) * x - 0.5, "cy": (camera.cy + 0.5) * y - 0.5}
    return structs.replace(camera, width=size[0], height=size[1], **places)


def resized(frame: RgbdFrame, size: tuple[int, int]) -> RgbdFrame:
    """The same view with other pixels."""
    color = cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA)
    return replace(frame, color=color, depth=cv2.resize(frame.depth, size, interpolation=cv2.INTER_NEAREST))
