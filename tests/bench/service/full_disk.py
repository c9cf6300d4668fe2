"""The disk gets full, the server is killed: is everything there that was acknowledged without an error?"""

from __future__ import annotations

import asyncio
import contextlib
import random
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

from client.streaming.client import ClientError, RoomPlace, StreamClient
from protocol.frames import IDENTITY
from protocol.messages import NOT_SAVED
from tests.bench.report.finished import Part
from tests.bench.report.run import Run
from tests.bench.service.faults import OPEN_DOOR, QUICK_TRIALS, SEED, TRIALS
from tests.bench.service.guests import CAMERA, CUBE, WISHES
from tests.bench.service.process import BEGIN, END, Served, Unusual, start, stop

MOST_REQUESTS = 500
"""Within which a full disk has to show; a signal takes a moment to be handled."""


@dataclass
class Found:
    """In all trials."""

    trials: int = 0
    kept: int = 0
    """Changes that were acknowledged without an error."""
    unsaved: int = 0
    """Changes that were acknowledged with one."""
    missing: list[str] = field(default_factory=list)


@dataclass
class Ledger:
    """What one client was told of its objects."""

    client: StreamClient
    found: Found
    is_there: dict[str, bool] = field(default_factory=dict)
    """Of objects whose last change was acknowledged without an error."""

    async def change(self, name: str, *, place: bool) -> bool:
        """Place or remove an object. Returns whether it is saved."""
        self.is_there.pop(name, None)
        asking = self.client.place_object(name, "ply", CUBE, (0.0, 0.3, 1.9)) if place else None
        done = await (asking or self.client.remove_object(name))
        if done.error is None:
            self.is_there[name] = place
            self.found.kept += 1
            return True
        if not done.error.startswith(NOT_SAVED):
            raise RuntimeError(done.error)
        self.found.unsaved += 1
        return False


def full_disk_part(run: Run, out: Path) -> Part:
    """Trials of `disk_full_then_killed`, each with the server that the one before has started."""
    found, chance, trials = Found(), random.Random(f"{SEED} full disk"), run.of(QUICK_TRIALS, TRIALS)
    with TemporaryDirectory() as data:
        served = begin(out / "disk_full_then_killed.log", data)
        try:
            for number in range(trials):
                served = disk_full_then_killed(served, f"room {number}", chance, found)
                run.say(f"disk full, then killed: {number + 1} of {trials}, {len(found.missing)} missing")
        finally:
            stop(served)
    name = "disk full, then killed"
    part = Part(details={"missing": found.missing})
    part.sizes[f"faults, {name}"] = found.trials
    part.add(f"{name}: acknowledged without an error and missing", len(found.missing), "objects", "<= 0")
    part.add(f"{name}: acknowledged without an error", found.kept, "requests")
    part.add(f"{name}: acknowledged with an error", found.unsaved, "requests")
    return part


def begin(log: Path, data: str, *, warms_up: bool = True) -> Served:
    """A server whose disk can get full."""
    return start(log, *OPEN_DOOR, "--data", data, unusual=Unusual(fault="disk", warms_up=warms_up))


def disk_full_then_killed(served: Served, room: str, chance: random.Random, found: Found) -> Served:
    """One trial; returns the server that was started after it."""
    is_there = asyncio.run(_change_until_killed(served, room, chance, found))
    if served.process.stdout is not None:
        served.process.stdout.close()
    served = start(served.log, *served.options, unusual=served.unusual, port=served.port)
    found.missing += asyncio.run(_wrong(served, room, is_there))
    found.trials += 1
    return served


async def _enter(served: Served, room: str) -> StreamClient:
    client = await StreamClient.connect(served.url)
    await client.hello(CAMERA, WISHES, room=RoomPlace(room, room_from_world=IDENTITY), keep_s=0.0)
    return client


async def _change_until_killed(served: Served, room: str, chance: random.Random, found: Found) -> dict[str, bool]:
    """Place and remove while the disk has space, while it has none, and perhaps again; then kill the server."""
    ledger = Ledger(await _enter(served, room), found)
    for number in range(4):
        await ledger.change(f"before {number}", place=True)
    await ledger.change("before 1", place=False)
    served.process.send_signal(BEGIN)
    for number in range(MOST_REQUESTS):
        if not await ledger.change(f"filling {number}", place=True):
            break
    else:
        raise RuntimeError("the disk did not get full")
    for number in range(8):
        await ledger.change(f"full {number}", place=True)
    await ledger.change("before 2", place=False)
    await asyncio.sleep(chance.uniform(0.0, 3.0))  # the room is saved every 2 s: the server tries that too
    if chance.random() < 0.5:
        served.process.send_signal(END)
        await ledger.change("after", place=True)
    served.kill()
    with contextlib.suppress(ClientError):
        await ledger.client.close()
    return ledger.is_there


async def _wrong(served: Served, room: str, is_there: dict[str, bool]) -> list[str]:
    """Objects that are not as they were acknowledged; takes them away."""
    client, wrong = await _enter(served, room), []
    for name, expected in is_there.items():
        done = await client.remove_object(name)
        if (done.error is None) != expected:
            wrong.append(f"{room}: {name}")
    await client.close()
    return wrong
