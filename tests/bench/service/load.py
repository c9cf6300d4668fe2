"""Load: 8 clients that stream and 24 that watch on one server, all the while placing, moving and removing objects.

Overhead is the service's time for a frame that is neither the pipeline's nor waiting: from when a session's thread
takes the frame from its mailbox until the socket has taken the last byte of the answer (decoding, encoding, handing
over between threads), less the wait for its turn on the device, its turn, and the wait for the socket. Of the processor
it is what that thread took (`probeless_overhead_cpu_seconds`) and, in mean, what event loop and picture readers took
for a frame, watchers and all. On the clock (`probeless_overhead_seconds`) it holds the wait for a processor too, where
kernels of other sessions' frames have them all.
"""

from __future__ import annotations

import asyncio
import os
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import trimesh

from client.options.source import open_source
from client.sources.frame_source import Source
from client.sources.volume import default_volume
from client.streaming.client import Answer, ClientError, StreamClient
from protocol.frames import RgbdFrame
from protocol.messages import Acknowledged, Composite, Dropped, Preset, Wishes
from tests.bench.report.finished import Part
from tests.bench.report.run import Run
from tests.bench.service.process import Served, Unusual, descendants, held_mb, serving
from tests.scenes.plain_light import PLAIN_LIGHT

STREAMING, WATCHING = 8, 24
SCENE = "synthetic:room?frames=20&size=160x120"
SETTING: Preset = "gr15fast"
VOXEL_M = 0.04
BETWEEN_REQUESTS_S = 0.4
SETTLED = 100
"""Frames of a session until its memory is what it stays: the walk is gone twice and lamps have been looked for."""
EVERY_S = 1.0
GOAL_MS = 5.0
CUBE = trimesh.creation.box((0.15, 0.15, 0.15)).export(file_type="ply")


@dataclass
class Load:
    """What a while of it gave."""

    seconds: float = 0.0
    frames: dict[str, int] = field(default_factory=dict)
    """Answered while it was measured, by session."""
    watched: list[int] = field(default_factory=list)
    """Composites of each watcher."""
    requests: int = 0
    wrong: list[str] = field(default_factory=list)
    """What is not as it was asked, one line each."""
    dropped: Counter[str] = field(default_factory=Counter)
    memory_mb: list[float] = field(default_factory=list)
    presets: Counter[str] = field(default_factory=Counter)
    beside_s: float = 0.0
    """Of the processor, that the event loop's thread and the readers of pictures took while it was measured."""
    before: dict[tuple[str, ...], float] = field(default_factory=dict)
    after: dict[tuple[str, ...], float] = field(default_factory=dict)


def load_part(run: Run, out: Path) -> Part:
    """8 streaming and 24 watching sessions."""
    part = Part()
    seconds = run.of(60, 600)
    options = ("--data", "none", "--sessions-per-address", str(STREAMING))
    with serving(out / "load.log", *options) as served:
        load = asyncio.run(loaded(served, seconds, run.say))
    shares = sorted(load.frames.values())
    name = f"load, {STREAMING} streaming and {WATCHING} watching"
    part.add(f"{name}: frames/s in all", sum(shares) / load.seconds, "frames/s")
    part.add(f"{name}: most frames of a session over fewest", 100 * (shares[-1] / max(shares[0], 1) - 1), "%", "<= 20")
    beside_ms = 1e3 * load.beside_s / max(sum(shares), 1)
    _, cpu_ms = overhead(load.before, load.after, "overhead_cpu_seconds")
    part.add(f"{name}: overhead, 99th percentile, of the processor", cpu_ms + beside_ms, "ms", f"<= {GOAL_MS:g}")
    under, wall_ms = overhead(load.before, load.after, "overhead_seconds")
    part.add(f"{name}: overhead, 99th percentile, on the clock", wall_ms, "ms", f"<= {GOAL_MS:g}")
    part.add(f"{name}: frames with an overhead below {GOAL_MS:g} ms on the clock", 100 * under, "%")
    part.add(f"{name}: event loop and picture readers, of the processor, a frame", beside_ms, "ms")
    for metric in ("decode", "encode", "turn", "queue_age"):
        part.add(f"{name}: mean {metric}_ms", 1e3 * mean_of(load.before, load.after, f"{metric}_seconds"), "ms")
    part.add(f"{name}: growth of memory, first half to second", growth(load.memory_mb), "%", "<= 1")
    part.add(f"{name}: most memory over least", 100 * (max(load.memory_mb) / min(load.memory_mb) - 1), "%")
    part.add(f"{name}: memory of the server and its parsers at the end", load.memory_mb[-1], "MB")
    part.add(f"{name}: requests lost, done twice or not as asked", len(load.wrong), "requests", "<= 0")
    part.add(f"{name}: fewest pictures of a watcher", min(load.watched), "pictures", ">= 1")
    part.add(f"{name}: frames dropped", sum(load.dropped.values()), "frames", "<= 0")
    part.sizes |= {"load, s": seconds, "load, requests": load.requests}
    part.details = {"frames": load.frames, "wrong": load.wrong[:20], "memory_mb": load.memory_mb}
    part.details |= {"presets": dict(load.presets), "dropped": dict(load.dropped)}
    return part


def side_by_side_part(run: Run, out: Path) -> Part:
    """Frames that the device works on one after the other, or two at a time."""
    part = Part()
    rates: dict[int, list[float]] = {1: [], 2: []}
    rounds, seconds = run.of(1, 3), run.of(12, 60)
    for number in range(rounds):
        for concurrent_frames in rates if number % 2 == 0 else reversed(rates):
            options = ("--data", "none", "--sessions-per-address", str(STREAMING))
            with serving(
                out / f"at_once_{concurrent_frames}.log", *options, unusual=Unusual(concurrent_frames=concurrent_frames)
            ) as served:
                load = asyncio.run(loaded(served, seconds, run.say, watching=0, asking=False, settled=5))
            rates[concurrent_frames].append(sum(load.frames.values()) / load.seconds)
    for concurrent_frames, found in rates.items():
        part.add(
            f"{STREAMING} sessions, {concurrent_frames} frame{'s' * (concurrent_frames > 1)} on the device at once",
            sum(found) / len(found),
            "frames/s",
        )
    part.add("two frames at once over one at a time", sum(rates[2]) / sum(rates[1]), "times")
    part.sizes["frames at once, s"] = rounds * seconds
    return part


async def loaded(
    served: Served, seconds: float, say: Any, *, watching: int = WATCHING, asking: bool = True, settled: int = SETTLED
) -> Load:
    """Stream for `seconds` once all are there and have sent so many frames."""
    source = open_source(SCENE)
    shown = [source[i] for i in range(len(source))]
    load = Load()
    streamers = [_Streamer(k, served.url, source, shown, load) for k in range(STREAMING)]
    await asyncio.gather(*(streamer.begin() for streamer in streamers))
    watchers = [asyncio.create_task(_watch(served.url, s.session)) for s in streamers for _ in range(watching // 8)]
    tasks = [asyncio.create_task(s.stream()) for s in streamers]
    tasks += [asyncio.create_task(s.ask()) for s in streamers if asking]
    while not all(streamer.answered >= settled for streamer in streamers):
        await _unless_ended(tasks, 0.2)
    load.beside_s = -_beside_s(served.process.pid)
    start = {streamer.session: streamer.answered for streamer in streamers}
    began, load.before = time.perf_counter(), await asyncio.to_thread(served.metrics)
    while (passed := time.perf_counter() - began) < seconds:
        load.memory_mb.append(await asyncio.to_thread(held_mb, served.process.pid))
        if len(load.memory_mb) % 20 == 1:
            say(f"load: {passed:.0f} of {seconds:.0f} s, {load.memory_mb[-1]:.0f} MB")
        await _unless_ended(tasks, EVERY_S)
    load.frames = {s.session: s.answered - start[s.session] for s in streamers}
    load.beside_s += _beside_s(served.process.pid)
    load.seconds, load.after = time.perf_counter() - began, await asyncio.to_thread(served.metrics)
    for streamer in streamers:
        streamer.is_over = True
    await asyncio.gather(*tasks)
    await asyncio.gather(*(streamer.end(checked=asking) for streamer in streamers))
    load.watched = list(await asyncio.gather(*watchers))
    return load


async def _unless_ended(tasks: list[asyncio.Task[None]], seconds: float) -> None:
    """Wait; raises what a client ended with before its time."""
    ended, _ = await asyncio.wait(tasks, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
    for task in ended:
        task.result()
        raise RuntimeError("a client has ended before its time")


class _Streamer:
    """One client: frames as fast as its window allows, and requests beside them."""

    def __init__(self, number: int, url: str, source: Source, shown: list[RgbdFrame], load: Load) -> None:
        self._number, self._url, self._source, self._shown, self._load = number, url, source, shown, load
        self.session = ""
        self.answered = 0
        self.is_over = False
        self._acknowledged: Counter[int] = Counter()
        self._objects: dict[str, bool] = {}
        """Names that were used, and whether it is there."""

    async def begin(self) -> None:
        self._client = await StreamClient.connect(self._url, self._tap)
        wishes = Wishes(
            volume_m=default_volume(self._source, range(len(self._source))),
            voxel_m=VOXEL_M,
            preset=SETTING,
            up=self._source.up,
            **PLAIN_LIGHT,
        )
        self.session = (await self._client.hello(self._source.camera, wishes)).session

    def _tap(self, message: Any) -> None:
        match message:
            case Acknowledged():
                self._acknowledged[message.request] += 1
            case Composite():
                self.answered += 1
                point = message.plan.point
                self._load.presets[point.settings if point else "?"] += 1
            case Dropped():
                self._load.dropped[message.reason] += 1

    async def stream(self) -> None:
        reading = asyncio.create_task(self._read())
        path = [*self._shown, *self._shown[-2:0:-1]]
        index = 0
        while not self.is_over:
            await self._client.wait_for_room()
            frame = path[(index + 3 * self._number) % len(path)]
            await self._client.send_frame(
                RgbdFrame(index, index / 30, frame.color, frame.depth, frame.world_from_camera)
            )
            index += 1
        await self._client.wait_until_answered()
        reading.cancel()

    async def _read(self) -> None:
        async for _ in self._client.answers():
            pass

    async def ask(self) -> None:
        """Objects come, go elsewhere and go away."""
        number = 0
        while not self.is_over:
            kept, gone = f"kept-{number % 4}", f"passing-{number % 3}"
            at = (0.1 * (number % 9) - 0.4, 0.3, 1.5)
            await self._done(self._client.place_object(kept, "ply", CUBE, at), kept, True)
            await self._done(self._client.place_object(gone, "ply", CUBE, at), gone, True)
            await self._done(self._client.move_object(kept, (at[0], 0.2, 1.6)), kept, True)
            await self._done(self._client.remove_object(gone), gone, False)
            number += 1

    async def _done(self, asking: Any, name: str, is_there: bool) -> None:
        self._load.requests += 1
        done = await asking
        if done.error is not None:
            self._load.wrong.append(f"{self.session} {name}: {done.error}")
        self._objects[name] = is_there
        await asyncio.sleep(BETWEEN_REQUESTS_S)

    async def end(self, *, checked: bool) -> None:
        """Compare the scene with what was asked; leave."""
        reading = asyncio.create_task(self._read())
        if checked:
            twice = [request for request, count in self._acknowledged.items() if count != 1]
            self._load.wrong += [
                f"{self.session}: request {r} was acknowledged {self._acknowledged[r]} times" for r in twice
            ]
            for name, is_there in self._objects.items():
                done = await self._client.remove_object(name)
                if (done.error is None) != is_there:
                    self._load.wrong.append(f"{self.session}: {name} is {'not ' * is_there}there at the end")
        await self._client.close()
        reading.cancel()


async def _watch(url: str, session: str) -> int:
    """Pictures until the session ends."""
    client = await StreamClient.connect(url)
    await client.watch(session)
    seen = 0
    try:
        async for answer in client.answers():
            seen += isinstance(answer, Answer)
    except ClientError:
        pass
    return seen


def _beside_s(pid: int) -> float:
    """Time of the processor so far: the event loop runs in the process's first thread."""
    tasks = [Path(f"/proc/{pid}/task/{pid}/stat")]
    tasks += [Path(f"/proc/{child}/stat") for child in descendants(pid, "read_picture")]
    ticks = sum(sum(map(int, task.read_text().rpartition(")")[2].split()[11:13])) for task in tasks)
    return ticks / os.sysconf("SC_CLK_TCK")


def growth(memory_mb: list[float]) -> float:
    """Percent, from the median of the first half to that of the second: it goes up and down with the objects."""
    half = len(memory_mb) // 2
    return 100 * (median(memory_mb[half:]) / median(memory_mb[:half]) - 1)


Samples = Mapping[tuple[str, ...], float]


def overhead(before: Samples, after: Samples, metric: str) -> tuple[float, float]:
    """Share of the frames below `GOAL_MS`, and the 99th percentile in ms, linear in a bucket. `metric`: in seconds."""
    name = f"probeless_{metric}_bucket"
    counts = sorted((1e3 * float(key[1]), n - before.get(key, 0.0)) for key, n in after.items() if key[0] == name)
    total = counts[-1][1]
    if not total:
        return 0.0, float("nan")
    lower, below = 0.0, 0.0
    for upper, count in counts:
        if count >= 0.99 * total:
            inside = (0.99 * total - below) / max(count - below, 1e-9)
            p99 = lower + inside * (min(upper, 10 * lower + 10) - lower)
            break
        lower, below = upper, count
    return dict(counts)[GOAL_MS] / total, p99


def mean_of(before: Samples, after: Samples, metric: str) -> float:
    """Of what was observed between the two."""
    total, count = (
        after[f"probeless_{metric}_{kind}",] - before[f"probeless_{metric}_{kind}",] for kind in ("sum", "count")
    )
    return total / count if count else float("nan")
