"""A session recorded on the wire and sent again: the same bytes, down to the last bit of every picture and light (B8).

What the client sent is replayed message by message, objects that come, move and go between the frames among them; each
waits for its answer. Servers are started anew, as one would come to a recording.
"""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from websockets.asyncio.client import ClientConnection

from client.options.source import open_source
from client.sources.volume import default_volume
from client.streaming.client import Access, StreamClient
from client.streaming.opening import open_client_socket
from protocol.codec import decode_server, encode
from protocol.messages import (
    Acknowledged,
    Bye,
    ClientMessage,
    Composite,
    Dropped,
    Error,
    Frame,
    Hello,
    Light,
    ServerMessage,
    Welcome,
    Wishes,
)
from protocol.recording import read_messages, write_message
from server.scene.vase import vase_glb
from tests.bench.report.finished import Part
from tests.bench.report.run import Run
from tests.bench.service.process import serving

RUNS = 5
FRAMES, QUICK_FRAMES = 40, 12
SCENE = "synthetic:room?frames=40&size=160x120&noise=1"


def replay_part(run: Run, out: Path) -> Part:
    """Record once, replay five times."""
    recording, frames = out / "session.probeless", run.of(QUICK_FRAMES, FRAMES)
    options = ("--token", "none", "--data", "none")
    with serving(out / "replay.log", *options) as served:
        asyncio.run(record(served.url, recording, frames))
    first = digests(read_messages(recording, run.say))
    same = 0
    for number in range(RUNS):
        with serving(out / "replay.log", *options) as served:
            again = digests(iter(asyncio.run(replay(served.url, recording))))
        same += again == first
        run.say(f"replay {number + 1} of {RUNS}: {'the same' if again == first else 'not the same'}")
    part = Part(details={"first frames": dict(list(first.items())[:5])})
    part.add(f"replays whose composites and lights have the recording's SHA-256, of {RUNS}", same, "", f">= {RUNS}")
    part.add("frames of the recording", len(first), "frames", f">= {frames}")
    part.sizes |= {"replays": RUNS, "frames of a replay": frames}
    return part


async def record(url: str, path: Path, count: int) -> None:
    """A lossless session as `stream --record` writes it, with an object that is placed, moved and removed."""
    source = open_source(SCENE)
    with ExitStack() as stack:
        file = stack.enter_context(path.open("wb"))
        client = await StreamClient.connect(url, lambda message: write_message(file, message))
        bounds = default_volume(source, range(len(source)))
        wishes = Wishes(volume_m=bounds, voxel_m=0.03, up=source.up, lossless=True, indirect="none")
        await client.hello(source.camera, wishes)
        reading = asyncio.create_task(_read(client))
        for index in range(count):
            if index == 2:
                await client.place_object("vase", "glb", vase_glb(), (0.0, 0.3, 1.5))
            if index == count // 2:
                await client.move_object("vase", (0.2, 0.3, 1.4), yaw_deg=30.0)
            if index == count - 2:
                await client.remove_object("vase")
            await client.send_frame(source[index])
            await client.wait_until_answered()
        reading.cancel()
        await client.close()


async def _read(client: StreamClient) -> None:
    async for _ in client.answers():
        pass


async def replay(url: str, path: Path) -> list[ServerMessage]:
    """Send what the client sent, and take what comes back. Raises RuntimeError for a refusal."""
    socket = await open_client_socket(url, Access())
    heard: list[ServerMessage] = []
    for message in read_messages(path, print):
        if not isinstance(message, ClientMessage):
            continue
        await socket.send(encode(message))
        if isinstance(message, Bye):
            break
        await _hear(socket, _answer_to(message), heard)
    await socket.close()
    return heard


def _answer_to(message: ClientMessage) -> tuple[type, ...]:
    match message:
        case Hello():
            return (Welcome,)
        case Frame():
            return (Composite, Dropped)
    return (Acknowledged,)


async def _hear(socket: ClientConnection, kinds: tuple[type, ...], heard: list[ServerMessage]) -> None:
    """Take messages up to the first of these kinds."""
    async with asyncio.timeout(60.0):
        while True:
            heard.append(decode_server(bytes(await socket.recv())))  # type: ignore[arg-type]
            if isinstance(heard[-1], kinds):
                return
            if isinstance(heard[-1], Error) and heard[-1].fatal:
                raise RuntimeError(heard[-1].reason)


def digests(messages: Iterator[Any]) -> dict[int, str]:
    """SHA-256 of each frame's light, as it is on the wire, picture and pose."""
    lights: dict[int, bytes] = {}
    found: dict[int, str] = {}
    for message in messages:
        match message:
            case Light():
                lights[message.frame] = encode(message)
            case Composite():
                pose = repr((message.world_from_camera, message.tracking, message.notes)).encode()
                data = lights[message.frame] + message.color.data + pose
                found[message.frame] = hashlib.sha256(data).hexdigest()
    return found
