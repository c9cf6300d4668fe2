"""Clients that come, ask and leave without end: rooms, objects, messages, bombs, and some that never read answers.

Health is asked for all the while; at the end the server must have the memory, files, threads and disk that it had after
a first small round of the same.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import struct
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import httpx
import msgpack
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from protocol.conformance.scene import CAMERA, frame, hello, place
from protocol.limits import SUBPROTOCOL
from tests.bench.report.finished import Part
from tests.bench.report.run import Run
from tests.bench.service.process import Served, held_mb, serving

PATIENCE_S = 120.0
HEALTH_PERIOD_S = 0.2
SETTLED_S = 5.0
"""Between two looks at a server that is left alone."""
LOOKS = 24
NEVER_READ = 4
"""Sessions that send frames and read nothing, of which an address may have eight."""
OBJECTS_PER_S = 200
"""At most: a connection may send 500 messages a second, and each object takes two."""
FLOODS, A_FLOOD = 10, 5000
"""Connections, each of which sends so many messages at once; it is closed after 2000."""


def floods_part(run: Run, out: Path) -> Part:
    """All of it, one after the other."""
    rooms, objects, bombs = run.of(100, 5000), run.of(200, 10_000), run.of(20, 200)
    with TemporaryDirectory() as data, serving(out / "floods.log", "--token", "none", "--data", data) as served:
        _round(served, 10, 20, 2)
        before = Held.of(served, Path(data))
        with _health_asked(served) as answers_s:
            _round(served, rooms, objects, bombs)
        after = _settled(served, Path(data), before)
        errors = sum(event.get("level") == "error" for event in served.events())
    part = Part(sizes={"rooms opened": rooms, "objects placed": objects, "bombs": bombs})
    part.add("floods: health, longest", max(answers_s), "s", "<= 1")
    part.add("floods: errors in the server's log", errors, "errors", "<= 0")
    for name, growth in after.growth_from(before).items():
        part.add(f"floods: growth of {name}", growth, "%", "<= 10")
    part.details = {
        "before": vars(before),
        "after": vars(after),
        "health, median s": sorted(answers_s)[len(answers_s) // 2],
    }
    return part


class Held:
    """What a server holds."""

    def __init__(self, memory_mb: float, files: int, threads: int, disk_kb: float) -> None:
        self.memory_mb, self.files, self.threads, self.disk_kb = memory_mb, files, threads, disk_kb

    @classmethod
    def of(cls, served: Served, data: Path) -> Held:
        """Now; memory with that of its parsers."""
        pid = served.process.pid
        memory_mb = held_mb(pid)
        disk = sum(path.stat().st_size for path in data.rglob("*") if path.is_file())
        return cls(memory_mb, len(os.listdir(f"/proc/{pid}/fd")), len(os.listdir(f"/proc/{pid}/task")), disk / 1e3)

    def growth_from(self, before: Held) -> dict[str, float]:
        """In percent; of small counts, one more or less does not count."""
        slack = {"files": 2, "threads": 2, "disk_kb": 4.0}
        return {
            name: 100 * max(0.0, getattr(self, name) - slack.get(name, 0) - held) / max(held, 1.0)
            for name, held in vars(before).items()
        }


def _round(served: Served, rooms: int, objects: int, bombs: int) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(NEVER_READ):
            stack.enter_context(_never_reads(served))
        for number in range(rooms):
            with _open(served) as client:
                client.send(msgpack.packb(hello(room=f"room {number}")))
                client.recv(timeout=PATIENCE_S)
                client.send(msgpack.packb({"type": "bye"}))
        _place_objects(served, objects)
        for _ in range(FLOODS):
            _flood(served)
        for number in range(bombs):
            _bomb(served, number)


def _open(served: Served, tcp: socket.socket | None = None) -> ClientConnection:
    return connect(
        served.bare_url.replace("http", "ws", 1) + "/v1/stream",
        sock=tcp,
        subprotocols=[Subprotocol(SUBPROTOCOL)],
        compression=None,
        max_size=None,
        open_timeout=PATIENCE_S,
        ping_interval=None,
        proxy=None,
    )


@contextlib.contextmanager
def _never_reads(served: Served) -> Iterator[None]:
    """A session whose answers fill all buffers. Left by breaking the connection."""
    tcp = socket.socket()
    tcp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    tcp.connect(("127.0.0.1", served.port))
    raw = _handshaken(tcp, served.port)
    raw.settimeout(0.0)
    with contextlib.suppress(BlockingIOError):  # the server reads no more of it
        raw.send(_masked(msgpack.packb(hello())))
        for number in range(200):
            raw.send(_masked(msgpack.packb(frame(number))))
    try:
        yield
    finally:
        tcp.close()


def _handshaken(tcp: socket.socket, port: int) -> socket.socket:
    request = (
        f"GET /v1/stream HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: {SUBPROTOCOL}\r\n"
        "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n"
    )
    tcp.settimeout(PATIENCE_S)
    tcp.sendall(request.encode())
    answer = b""
    while not answer.endswith(b"\r\n\r\n"):
        answer += tcp.recv(1)
    return tcp


def _masked(data: bytes) -> bytes:
    """A WebSocket frame whose mask is zero."""
    return b"\x82\xff" + len(data).to_bytes(8, "big") + b"\0\0\0\0" + data


def _place_objects(served: Served, count: int) -> None:
    with _open(served) as client:
        client.send(msgpack.packb(hello()))
        client.recv(timeout=PATIENCE_S)
        for number in range(count):
            time.sleep(1 / OBJECTS_PER_S)
            client.send(msgpack.packb(place(2 * number, f"object {number}")))
            client.send(
                msgpack.packb({"type": "remove_object", "request": 2 * number + 1, "object": f"object {number}"})
            )
            for _ in range(2):
                done = msgpack.unpackb(client.recv(timeout=PATIENCE_S))
                if done.get("error") is not None:
                    raise RuntimeError(done["error"])


def _flood(served: Served) -> None:
    with _open(served) as client, contextlib.suppress(ConnectionClosed):
        client.send(msgpack.packb(hello()))
        for number in range(A_FLOOD):
            client.send(msgpack.packb({"type": "remove_object", "request": number, "object": "nothing"}))


def _bomb(served: Served, number: int) -> None:
    """Something small that grows when it is read."""
    zeros = _zeros()
    size = {"width": CAMERA["width"], "height": CAMERA["height"]}
    bombs: tuple[Callable[[], dict[str, object]], ...] = (
        lambda: frame(0, depth={**size, "codec": "zdelta", "data": zeros[2:-4]}),
        lambda: frame(0, color={**size, "codec": "png", "data": _png_bomb()}),
        lambda: place(0) | {"format": "glb", "data": _glb_bomb()},
    )
    with _open(served) as client, contextlib.suppress(ConnectionClosed):
        client.send(msgpack.packb(hello()))
        client.send(msgpack.packb(bombs[number % len(bombs)]()))
        for _ in range(2):  # the welcome, and what is said of the bomb
            client.recv(timeout=PATIENCE_S)


@cache
def _zeros() -> bytes:
    """64 MiB, compressed."""
    return zlib.compress(bytes(64 << 20), 9)


def _png_bomb() -> bytes:
    """A PNG of 30000 x 30000 black pixels that says it is one of the camera's size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")

    sides = CAMERA["width"].to_bytes(4, "big") + CAMERA["height"].to_bytes(4, "big")  # type: ignore[attr-defined]
    rows = _zeros()
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", sides + b"\x08\x02\0\0\0") + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def _glb_bomb() -> bytes:
    """A GLB that says it has four thousand million vertices."""
    document: dict[str, object] = {
        "asset": {"version": "2.0"},
        "accessors": [{"componentType": 5126, "count": 2**32 - 1, "type": "VEC3"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunk = struct.pack("<II", len(text), 0x4E4F534A) + text
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunk)) + chunk


@contextlib.contextmanager
def _health_asked(served: Served) -> Iterator[list[float]]:
    """Ask for health in a thread; the seconds that each answer took."""
    answers_s: list[float] = []
    ends = threading.Event()

    def ask() -> None:
        with httpx.Client(trust_env=False, timeout=PATIENCE_S) as client:
            while not ends.wait(HEALTH_PERIOD_S):
                began_s = time.perf_counter()
                client.get(f"{served.bare_url}/healthz").raise_for_status()
                answers_s.append(time.perf_counter() - began_s)

    asking = threading.Thread(target=ask)
    asking.start()
    try:
        yield answers_s
    finally:
        ends.set()
        asking.join()


def _settled(served: Served, data: Path, before: Held) -> Held:
    """What it holds once that is no more than before, or after a while."""
    for _ in range(LOOKS):
        held = Held.of(served, data)
        if all(growth <= 0 for growth in held.growth_from(before).values()):
            break
        time.sleep(SETTLED_S)
    return held
