"""What the capacity plan in docker/README.md rests on: bytes and memory measured here, frames/s from docs/benchmarks.

    python -m tests.bench.cluster.capacity [SOURCE]

A client streams SOURCE to a server of its own, JPEG both ways; every message is counted. Prints one JSON object.
"""

from __future__ import annotations

import asyncio
import json
import sys
from collections import defaultdict
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from client.options.source import open_source
from client.sources.frame_source import Source
from client.streaming.client import Answer, StreamClient
from protocol.codec import encode
from protocol.messages import ClientMessage, ServerMessage, Wishes
from tests.bench.service.process import resident_mb, serving

FRAMES = 12
PLAN = Path(__file__).resolve().parents[3] / "docs" / "benchmarks" / "accuracy.json"
PRESETS = ("RM", "REG4", "REG8", "ART4", "ART8")


def main() -> int:
    """Measure and print."""
    spec = sys.argv[1] if len(sys.argv) > 1 else "synthetic:room"
    with TemporaryDirectory() as logs, serving(Path(logs) / "serve.log", "--data", "none") as served:
        result = asyncio.run(measure(served.url, open_source(spec), served.process.pid))
    print(json.dumps({"source": spec} | result | {"frames_per_s": frames_per_s()}, indent=1))
    return 0


async def measure(url: str, source: Source, pid: int) -> dict[str, Any]:
    """Bytes of each kind of message, memory of the server before and with one session."""
    sizes: dict[str, list[int]] = defaultdict(list)

    def count(message: ClientMessage | ServerMessage) -> None:
        sizes[message.__struct_config__.tag].append(len(encode(message)))

    empty_mb = resident_mb(pid)
    client = await StreamClient.connect(url, tap=count)
    await client.hello(source.camera, Wishes(up=source.up))
    sending = asyncio.create_task(_send(client, source))
    answered = 0
    async for answer in client.answers():
        answered += isinstance(answer, Answer)
        if answered == FRAMES:
            break
    await sending
    full_mb = resident_mb(pid)
    await client.close()
    return {
        "picture": f"{source.camera.width}x{source.camera.height}",
        "bytes": {tag: round(median(found)) for tag, found in sorted(sizes.items())},
        "server_mb": round(empty_mb),
        "server_with_a_session_mb": round(full_mb),
    }


async def _send(client: StreamClient, source: Source) -> None:
    for index in range(FRAMES):
        await client.send_frame(source[index])
        await client.wait_until_answered()


def frames_per_s() -> dict[str, float]:
    """Of each preset on the device of docs/benchmarks, static camera, one albedo (the thesis's table 6.1)."""
    rows = {row["name"]: row["value"] for row in json.loads(PLAN.read_text())["rows"]}
    return {name: round(rows[f"fig. 6.5, static camera: {name}: median"], 1) for name in PRESETS}


if __name__ == "__main__":
    sys.exit(main())
