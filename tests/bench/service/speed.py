"""The whole way of one client, from its frame over the socket to the composite that comes back.

640x480, 256^3 voxels over 2 m, REG4, one object, JPEG up and down: frames a second, memory over 1 000 frames, and the
time from `serve` to the first composite with a warm kernel cache. The server is a process of its own, as in the field;
the client runs here, on the same cores.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np
from numpy.typing import NDArray

from client.options.source import open_source
from client.sources.frame_source import Source
from client.streaming.client import Answer, StreamClient
from protocol.frames import RgbdFrame
from protocol.messages import Wishes
from server.scene.vase import vase_glb
from tests.bench.report.finished import Part
from tests.bench.report.run import Run
from tests.bench.service.process import resident_mb, serving
from tests.scenes.plain_light import PLAIN_LIGHT

SOURCES = ("synthetic:room?frames=40", "synthetic:table?frames=40")
"""A room that fills the picture, and a table whose surroundings have no depth."""
SIDE_M = 2.0
VOXEL_M = SIDE_M / 256
WINDOW = 20
"""Frames over which one rate is measured; the figure is the median of the windows."""
SETTLING = 0.2
"""Share of the frames after which memory must not grow any more."""


def speed_part(run: Run, out: Path) -> Part:
    """One client that sends as fast as its window allows."""
    frames = run.of(80, 1000)
    options = ("--token", "none", "--data", "none")
    with serving(out / "speed.log", *options):  # fills the kernel cache
        pass
    part = Part(sizes={"frames": frames})
    for spec in SOURCES:
        name = spec.partition("?")[0]
        source = open_source(spec)
        shown = [source[i] for i in range(len(source))]
        started = time.perf_counter()
        with serving(out / "speed.log", *options) as served:
            times, memory = asyncio.run(stream(served.url, source, shown, frames, served.process.pid, run.say))
        rates = [WINDOW / (b - a) for a, b in zip(times[::WINDOW], times[WINDOW::WINDOW], strict=False)]
        settled = memory[int(len(memory) * SETTLING) :]
        growth = 100 * (max(settled[-3:]) / settled[0] - 1)
        part.add(f"{name}: end to end through the socket", median(rates), "frames/s", ">= 4")
        part.add(f"{name}: slowest window of {WINDOW} frames", min(rates), "frames/s")
        part.add(f"{name}: first composite after serve, warm cache", times[0] - started, "s", "<= 10")
        part.add(f"{name}: server memory at the end", memory[-1], "MB")
        part.add(f"{name}: growth of memory over the last {len(settled) * WINDOW} frames", growth, "%", "<= 1")
    return part


async def stream(
    url: str, source: Source, shown: list[RgbdFrame], count: int, pid: int, say: Callable[[str], None]
) -> tuple[list[float], list[float]]:
    """Send frames to and fro as fast as the window allows: times of the answers, memory in MB."""
    client = await StreamClient.connect(url)
    center = np.mean([looked_at(frame, source.camera.depth_scale_m) for frame in shown], axis=0)
    low, high = center - SIDE_M / 2, center + SIDE_M / 2
    wishes = Wishes(volume_m=(*low.tolist(), *high.tolist()), voxel_m=VOXEL_M, up=source.up, **PLAIN_LIGHT)
    await client.hello(source.camera, wishes)
    await client.place_object("vase", "glb", vase_glb(), position_m=tuple(center.tolist()))
    sending = asyncio.create_task(_send(client, shown, count))
    times: list[float] = []
    memory: list[float] = []
    async for answer in client.answers():
        if not isinstance(answer, Answer):
            raise RuntimeError(f"frame was not answered: {answer}")
        times.append(time.perf_counter())
        if len(times) % WINDOW == 1:
            memory.append(resident_mb(pid))
            say(f"{len(times)} of {count} frames, {memory[-1]:.0f} MB")
        if len(times) == count:
            break
    await sending
    await client.close()
    return times, memory


def looked_at(frame: RgbdFrame, depth_scale_m: float) -> NDArray[np.float64]:
    """World point on the camera's axis at the median depth."""
    depth_m = float(np.median(frame.depth[frame.depth > 0])) * depth_scale_m
    assert frame.world_from_camera is not None
    return frame.world_from_camera[:3, 3] + depth_m * frame.world_from_camera[:3, 2]


async def _send(client: StreamClient, shown: list[RgbdFrame], count: int) -> None:
    """The frames forwards and backwards, so that the camera never jumps; never more unanswered than the window."""
    path = [*shown, *shown[-2:0:-1]]
    for index in range(count):
        frame = path[index % len(path)]
        await client.wait_for_room()
        await client.send_frame(RgbdFrame(index, index / 30, frame.color, frame.depth, frame.world_from_camera))
