"""Clients that mean harm: many sockets that say nothing, and models that take long to read.

Both go on while another client asks for health, or places a small model.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import resource
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import httpx
import numpy as np

from client.options.source import open_source
from protocol.messages import Wishes
from tests.bench.report.finished import Part, UnmeasurableError
from tests.bench.report.run import Run
from tests.bench.service.guests import CUBE
from tests.bench.service.long_frames import SHORT, opened
from tests.bench.service.process import Served, serving

FILES, SOCKETS = 1024, 1100
"""Open files that the server may have, and sockets that say nothing."""
PICTURES, SIDE_PX = 16, 4096
"""Of one model, all different: as many pixels as are read, some seconds of decoding."""


def silent_sockets_part(run: Run, out: Path) -> Part:
    """Longest answer of /healthz while more sockets are open than the server may have files."""
    asked = run.of(50, 200)
    with contextlib.ExitStack() as stack:
        with _files(FILES):
            served = stack.enter_context(serving(out / "silent_sockets.log", "--token", "none", "--data", "none"))
        stack.enter_context(_files(2 * SOCKETS))
        for _ in range(SOCKETS):
            stack.enter_context(socket.create_connection(("127.0.0.1", served.port), timeout=20.0))
        longest_s = max(_health_s(served) for _ in range(asked))
    part = Part(sizes={"health asked beside silent sockets": asked})
    part.add(f"health beside {SOCKETS} silent sockets at {FILES} files: longest", longest_s, "s", "<= 1")
    return part


def large_models_part(run: Run, out: Path) -> Part:
    """How long a third session waits for a cube while two place large models."""
    placed = run.of(5, 20)
    with serving(out / "large_models.log", "--token", "none", "--data", "none") as served:
        times = asyncio.run(_third_session(served, placed))
    part = Part(sizes={"cubes beside large models": placed})
    part.add("a cube is placed beside two sessions' large models within: longest", max(times), "s", "<= 1")
    return part


async def _third_session(served: Served, count: int) -> list[float]:
    source = open_source("synthetic:room?frames=2")
    hogs = [await opened(served, source, SHORT, Wishes()) for _ in range(2)]
    third = await opened(served, source, SHORT, Wishes())
    await third.place_object("cube", "ply", CUBE, (0.0, 0.0, 1.0))
    large, times = large_model(), []

    async def place(number: int) -> None:
        while True:  # refused ones are sent again
            await hogs[number].place_object(f"large {number}", "glb", large, (0.0, 0.0, 1.0))

    tasks = [asyncio.create_task(place(number)) for number in range(2)]
    for _ in range(count):
        await asyncio.sleep(1.0)
        began_s = time.perf_counter()
        await third.place_object("cube", "ply", CUBE, (0.0, 0.0, 1.0))
        times.append(time.perf_counter() - began_s)
    for task in tasks:
        task.cancel()
    for client in (*hogs, third):
        await client.close()
    return times


def large_model() -> bytes:
    """A GLB whose materials have PICTURES different pictures of SIDE_PX."""
    body, views = b"", []
    for number in range(PICTURES):
        done, picture = cv2.imencode(".png", np.full((SIDE_PX, SIDE_PX, 3), number, np.uint8))
        assert done
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": picture.size})
        body += picture.tobytes() + b"\0" * (-picture.size % 4)
    corners = np.float32([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]).tobytes()
    views.append({"buffer": 0, "byteOffset": len(body), "byteLength": len(corners)})
    body += corners
    texture = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": k}}} for k in range(PICTURES)]
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(body)}],
        "bufferViews": views,
        "accessors": [{"bufferView": PICTURES, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "images": [{"bufferView": k, "mimeType": "image/png"} for k in range(PICTURES)],
        "textures": [{"source": k} for k in range(PICTURES)],
        "materials": texture,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "material": k} for k in range(PICTURES)]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(body), 0x004E4942) + body
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def _health_s(served: Served) -> float:
    began_s = time.perf_counter()
    httpx.get(f"{served.bare_url}/healthz", trust_env=False, timeout=20.0).raise_for_status()
    return time.perf_counter() - began_s


@contextlib.contextmanager
def _files(most: int) -> Iterator[None]:
    """Limit of this process, and of those it starts meanwhile, on open files."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < most:
        raise UnmeasurableError(f"this machine allows {hard} open files, {most} are needed")
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
