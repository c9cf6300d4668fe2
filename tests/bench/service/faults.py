"""Faults at random moments, which a seed repeats: what becomes of every session, of its room, and of the others.

A session ends in a state that it reports if, within `LIMIT_S` of the fault's end, frames are answered again, or its
client has been told one line. All else is counted as a hang.
"""

from __future__ import annotations

import asyncio
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import trimesh

from client.streaming.client import ClientError
from tests.bench.report.finished import ROOT, Part
from tests.bench.report.run import Run
from tests.bench.service.guests import Guest
from tests.bench.service.process import BEGIN, END, Served, Unusual, descendants, serving, start, stop
from tests.service.proxy import Proxy

TRIALS, QUICK_TRIALS = 20, 3
LIMIT_S = 20.0
SEED = 8
STALL_S = 3.0
SLOW_BYTES_PER_S = 125_000.0
DELAY_S = 0.150
LARGE = trimesh.creation.icosphere(6, 0.1).export(file_type="ply")
"""Takes its reader long enough to be met at work."""
OPEN_DOOR = ("--token", "none")


@dataclass
class Tally:
    """Of one kind of fault."""

    trials: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    """`went on`, or the line that a client was told, or `hung`."""
    recovered_s: list[float] = field(default_factory=list)
    lost_objects: list[str] = field(default_factory=list)
    disturbed: list[str] = field(default_factory=list)
    """What befell those whom it should not touch."""
    lost_fusion_s: list[float] = field(default_factory=list)

    async def note(self, guest: Guest, limit_s: float = LIMIT_S) -> None:
        """How a guest fared, from now on."""
        began = time.perf_counter()
        if await guest.goes_on(limit_s):
            self.outcomes["went on"] += 1
            self.recovered_s.append(time.perf_counter() - began)
        elif guest.ended:
            self.outcomes[f"told: {guest.ended}"] += 1
        else:
            self.outcomes["hung"] += 1

    async def check(self, other: Guest, what: str) -> None:
        """That a guest who should be fine is."""
        if not await other.goes_on(LIMIT_S):
            self.disturbed.append(f"{what}: {other.ended or 'hung'}")


Fault = Callable[[Served, Guest, Guest, Proxy, random.Random, Tally], Awaitable[None]]


def fault_part(name: str, run: Run, out: Path) -> Part:
    """One of `FAULTS`."""
    kind, trials = FAULTS[name], run.of(QUICK_TRIALS, TRIALS)
    unusual = Unusual(fault=kind.injected) if kind.injected else None
    with (
        TemporaryDirectory() as data,
        serving(
            out / f"{name.replace(' ', '_').replace('/', '_')}.log", *OPEN_DOOR, "--data", data, unusual=unusual
        ) as served,
    ):
        tally = asyncio.run(_trials(served, kind.work, trials, name, run))
    return part_of(name, tally)


def part_of(name: str, tally: Tally) -> Part:
    """Its rows."""
    part = Part(
        details={"outcomes": dict(tally.outcomes), "disturbed": tally.disturbed, "lost objects": tally.lost_objects}
    )
    part.sizes[f"faults, {name}"] = tally.trials
    silent = sum(count for outcome, count in tally.outcomes.items() if outcome in ("hung", "told: "))
    part.add(f"{name}: sessions that hung or ended without a word", silent, "sessions", "<= 0")
    part.add(f"{name}: others that were disturbed", len(tally.disturbed), "sessions", "<= 0")
    part.add(f"{name}: objects lost or come back", len(tally.lost_objects), "objects", "<= 0")
    part.add(f"{name}: sessions that went on", tally.outcomes["went on"], "sessions")
    if tally.recovered_s:
        part.add(f"{name}: longest until frames were answered again", max(tally.recovered_s), "s")
    if tally.lost_fusion_s:
        part.add(f"{name}: fusion lost, most", max(tally.lost_fusion_s), "s", "<= 5")
    return part


async def _trials(served: Served, fault: Fault, trials: int, name: str, run: Run) -> Tally:
    tally, chance = Tally(), random.Random(f"{SEED} {name}")
    for number in range(trials):
        proxy = Proxy(served.bare_url)
        room = f"room {name} {number}"
        victim = await Guest(proxy.url, room, "victim").begin()
        other = await Guest(served.url, room, "other").begin()
        try:
            await asyncio.gather(victim.goes_on(LIMIT_S), other.goes_on(LIMIT_S))
            await victim.place("stays")
            await other.place("of the other")
            await asyncio.sleep(chance.uniform(0.0, 1.0))
            await fault(served, victim, other, proxy, chance, tally)
            if other.ended is None:
                asked = victim.objects | other.objects
                tally.lost_objects += await other.lost_objects(asked)
        finally:
            await asyncio.gather(victim.leave(), other.leave())
            proxy.close()
        tally.trials += 1
        run.say(f"{name}: {number + 1} of {trials}, {dict(tally.outcomes)}")
    return tally


async def _reader_killed(
    served: Served, victim: Guest, other: Guest, _proxy: Proxy, chance: random.Random, tally: Tally
) -> None:
    placing = asyncio.create_task(victim.place("large", LARGE))
    await asyncio.sleep(chance.uniform(0.0, 0.3))
    for child in descendants(served.process.pid, "read_mesh"):
        os.kill(child, signal.SIGKILL)
    await asyncio.wait_for(placing, LIMIT_S)
    await victim.place("after it")
    if not victim.objects.get("after it"):
        tally.disturbed.append(f"the next mesh was refused: {victim.problems[-1:]}")
    for problem in victim.problems:
        tally.outcomes[f"told: {problem}"] += 1
    await tally.note(victim)
    await tally.check(other, "the other")


async def _cut(
    _served: Served, victim: Guest, other: Guest, proxy: Proxy, _chance: random.Random, tally: Tally
) -> None:
    asking = asyncio.create_task(victim.place("on the way"))
    proxy.cut()
    await tally.note(victim)
    await asyncio.wait_for(asking, LIMIT_S)
    await tally.check(other, "the other")


async def _stalled(
    _served: Served, victim: Guest, other: Guest, proxy: Proxy, _chance: random.Random, tally: Tally
) -> None:
    other.watch_gaps()
    proxy.flows.clear()
    asking = asyncio.create_task(victim.place("on the way"))
    await asyncio.sleep(STALL_S)
    if other.longest_gap_s > STALL_S / 2:
        tally.disturbed.append(f"the other waited {other.longest_gap_s:.1f} s with it")
    proxy.flows.set()
    await tally.note(victim)
    await asyncio.wait_for(asking, LIMIT_S)
    await tally.check(other, "the other")


async def _slowed(
    _served: Served, victim: Guest, other: Guest, proxy: Proxy, _chance: random.Random, tally: Tally
) -> None:
    other.watch_gaps()
    proxy.delay_s, proxy.bytes_per_s = DELAY_S, SLOW_BYTES_PER_S
    asking = asyncio.create_task(victim.place("on the way"))
    await tally.note(victim)
    await asyncio.wait_for(asking, LIMIT_S)
    if other.longest_gap_s > 2.0:
        tally.disturbed.append(f"the other waited {other.longest_gap_s:.1f} s with it")
    proxy.delay_s, proxy.bytes_per_s = 0.0, None
    await tally.check(other, "the other")


_STREAMING = """
import asyncio, sys
from tests.bench.service.guests import Guest
async def stream():
    guest = await Guest(sys.argv[1], sys.argv[2], "killed", keep_s=1.0).begin()
    await guest.goes_on(60.0)
    print("streams", flush=True)
    await asyncio.sleep(600)
asyncio.run(stream())
"""


async def _client_killed(
    served: Served, victim: Guest, other: Guest, _proxy: Proxy, chance: random.Random, tally: Tally
) -> None:
    """The killed one is a process of its own; it is the server that has to report its end."""
    room = victim.room or ""
    process = subprocess.Popen(
        [sys.executable, "-c", _STREAMING, served.url, room], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    with process:
        await asyncio.to_thread(process.stdout.readline)
        await asyncio.sleep(chance.uniform(0.0, 0.5))
        process.kill()
    until = time.perf_counter() + LIMIT_S
    closed = _closed(served)
    while _closed(served) == closed and time.perf_counter() < until:
        await asyncio.sleep(0.1)
    is_told = _closed(served) > closed and (await asyncio.to_thread(served.health))["sessions"] == 2
    tally.outcomes["told: by the server's log, session closed" if is_told else "hung"] += 1
    await tally.check(victim, "a client of its room")
    await tally.check(other, "a client of its room")


def _closed(served: Served) -> int:
    return sum(event.get("event") == "session closed" for event in served.events())


async def _disk_full(
    served: Served, victim: Guest, other: Guest, _proxy: Proxy, _chance: random.Random, tally: Tally
) -> None:
    told, again = _saving(served)
    served.process.send_signal(BEGIN)
    await victim.place("while it is full")
    until = time.perf_counter() + LIMIT_S
    while _saving(served)[0] == told and time.perf_counter() < until:
        await asyncio.sleep(0.1)
    await tally.note(victim)
    served.process.send_signal(END)
    until = time.perf_counter() + LIMIT_S
    while _saving(served)[1] == again and time.perf_counter() < until:
        await asyncio.sleep(0.1)
    found = _saving(served)
    tally.outcomes["told: by the server's log, not saved" if found[0] > told else "hung"] += 1
    if found[1] == again:
        tally.disturbed.append("the room was not saved again")
    await tally.check(other, "the other")


def _saving(served: Served) -> tuple[int, int]:
    """How often the log says that a room was not saved, and that one is again."""
    events = [event.get("event", "") for event in served.events()]
    return sum("was not saved" in e for e in events), sum("is saved again" in e for e in events)


async def _no_build(
    served: Served, victim: Guest, other: Guest, _proxy: Proxy, chance: random.Random, tally: Tally
) -> None:
    await _device_fails(served, victim, other, chance, tally)


async def _device_fails(served: Served, victim: Guest, other: Guest, chance: random.Random, tally: Tally) -> None:
    """Both who are there and one who comes meet it; when it is over, all can begin anew in the same room."""
    served.process.send_signal(BEGIN)
    await victim.change_quality(chance.choice(["rm", "reg4", "art4"]))
    newcomer = Guest(served.url, f"{victim.room} anew", "newcomer", keep_s=1.0)
    try:
        await asyncio.wait_for(newcomer.begin(), LIMIT_S)
    except ClientError as error:
        tally.outcomes[f"told: {error}"] += 1
    except TimeoutError:
        tally.outcomes["hung"] += 1
    else:
        await tally.note(newcomer, 3.0) if not await newcomer.goes_on(1.0) else None
        await newcomer.leave()
    await asyncio.sleep(chance.uniform(0.5, 2.0))
    served.process.send_signal(END)
    await tally.note(victim)
    await tally.note(other)
    for room in (victim.room, None):
        after = Guest(served.url, room, "after it")
        try:
            await asyncio.wait_for(after.begin(), LIMIT_S)
            await tally.check(after, f"a client of {'that room' if room else 'no room'} when it was over")
            await after.leave()
        except (ClientError, TimeoutError) as error:
            tally.disturbed.append(f"when it was over: {error}")


@dataclass(frozen=True)
class Kind:
    """Of fault."""

    work: Fault
    injected: str = ""


FAULTS = {
    "mesh reader killed": Kind(_reader_killed),
    "client killed": Kind(_client_killed),
    "socket cut": Kind(_cut),
    "socket stalled 3 s": Kind(_stalled),
    "socket at 150 ms and 1 Mbit/s": Kind(_slowed),
    "disk full": Kind(_disk_full, "disk"),
    "device builds nothing": Kind(_no_build, "build"),
    "device allocates nothing": Kind(_no_build, "allocation"),
}


def server_killed_part(run: Run, out: Path) -> Part:
    """The server is killed; what comes back with the next one on the same folder and port."""
    tally = Tally()
    chance = random.Random(f"{SEED} server killed")
    trials = run.of(QUICK_TRIALS, TRIALS)
    with TemporaryDirectory() as data:
        log = out / "server_killed.log"
        options = (*OPEN_DOOR, "--data", data)
        served = start(log, *options)
        try:
            for number in range(trials):
                served = asyncio.run(_server_killed(served, f"room {number}", chance, tally))
                run.say(f"server killed: {number + 1} of {trials}, {dict(tally.outcomes)}")
        finally:
            stop(served)
    return part_of("server killed", tally)


async def _server_killed(served: Served, room: str, chance: random.Random, tally: Tally) -> Served:
    guests = [await Guest(served.url, room, f"guest {k}").begin() for k in range(2)]
    scanner, other = guests
    other.is_paused = True  # one of them is the clock
    apart = await Guest(served.url, None, "without a room", keep_s=1.0).begin()
    try:
        await scanner.goes_on(LIMIT_S)
        until, number = time.perf_counter() + chance.uniform(3.0, 9.0), 0
        while time.perf_counter() < until:
            await scanner.place(f"object {number}")
            if number % 3 == 2:
                await scanner.remove(f"object {number - 1}")
            await asyncio.sleep(chance.uniform(0.0, 0.5))
            number += 1
        if (
            tally.trials % 2 == 0
        ):  # each object's coming is a save: without any, fusion rests on those every few seconds
            await asyncio.sleep(chance.uniform(1.0, 5.0))
        shown_s = scanner.shown_s
        scanner.is_paused = True
        served.kill()
        if served.process.stdout is not None:
            served.process.stdout.close()
        served = await asyncio.to_thread(start, served.log, *served.options, port=served.port)
        fused_s = await asyncio.wait_for(scanner.fused_until_s(), 2 * LIMIT_S)
        tally.lost_fusion_s.append(max(shown_s - fused_s, 0.0))
        tally.lost_objects += await scanner.lost_objects(scanner.objects)
        scanner.is_paused = other.is_paused = False
        await tally.note(scanner)
        await tally.note(other)
        await tally.note(apart)
    except (ClientError, TimeoutError) as error:
        tally.disturbed.append(f"{room} did not come back: {error or 'hung'}")
    finally:
        await asyncio.gather(*(guest.leave() for guest in (*guests, apart)))
    tally.trials += 1
    return served
