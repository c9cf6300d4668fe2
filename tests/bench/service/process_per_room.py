"""What a process of its own for each room costs, beside one server for all: the figures of docs/operating.md.

    python -m tests.bench.service.process_per_room [ROUNDS]

The same sessions stream to one server, and each to a server of its own, by turns. Prints one JSON object.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from client.options.source import open_source
from client.sources.frame_source import Source
from client.streaming.client import StreamClient
from protocol.messages import Wishes
from tests.bench.service.long_frames import SHORT, answered, opened
from tests.bench.service.process import Served, serving

ROOMS = 3
FRAMES = 20
"""Of each session."""
WARM_FRAMES = 3


def main() -> int:
    """Measure and print."""
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    source = open_source("synthetic:room?frames=8")
    found: dict[str, list[dict[str, float]]] = {"one server for all": [], "a process for each room": []}
    for _ in range(rounds):
        for processes, name in ((1, "one server for all"), (ROOMS, "a process for each room")):
            found[name].append(measured(processes, source))
    print(json.dumps({name: summed(runs) for name, runs in found.items()}, indent=1))
    return 0


def summed(runs: list[dict[str, float]]) -> dict[str, Any]:
    """Medians over the runs."""
    return {name: round(median(run[name] for run in runs), 3) for name in runs[0]} | {"runs": len(runs)}


def measured(processes: int, source: Source) -> dict[str, float]:
    """ROOMS sessions at once, spread over so many servers."""
    with TemporaryDirectory() as folder, ExitStack() as stack:
        began_s = time.perf_counter()
        options = ("--token", "none", "--data", "none")
        first = stack.enter_context(serving(Path(folder) / "0.log", *options))
        start_s = time.perf_counter() - began_s
        more = [stack.enter_context(serving(Path(folder) / f"{n}.log", *options)) for n in range(1, processes)]
        servers = [first, *more]
        empty_mb = sum(map(proportional_mb, servers))
        times = asyncio.run(streamed([servers[n % processes] for n in range(ROOMS)], source))
        total_mb = sum(map(proportional_mb, servers))
    return times | {"server ready after, s": start_s, "memory before, MB": empty_mb, "memory with rooms, MB": total_mb}


async def streamed(servers: list[Served], source: Source) -> dict[str, float]:
    """Sessions that send one frame after the other, all at once."""
    clients = [await opened(served, source, SHORT, Wishes()) for served in servers]
    for client in clients:
        await answered(client, source, WARM_FRAMES)
    began_s = time.perf_counter()
    times = await asyncio.gather(*(timed(client, source) for client in clients))
    total_s = time.perf_counter() - began_s
    for client in clients:
        await client.close()
    ends = [sum(each) for each in times]
    return {
        "frames/s in all": ROOMS * FRAMES / total_s,
        "slowest session over fastest": max(ends) / min(ends),
        "longest frame, s": max(map(max, times)),
    }


async def timed(client: StreamClient, source: Source) -> list[float]:
    """Seconds of each frame."""
    return await answered(client, source, FRAMES)


def proportional_mb(served: Served) -> float:
    """Memory of a server, in MB; what it shares with other processes counts by its part (PSS)."""
    for line in Path(f"/proc/{served.process.pid}/smaps_rollup").read_text().splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) / 1e3
    raise ProcessLookupError(served.process.pid)


if __name__ == "__main__":
    sys.exit(main())
