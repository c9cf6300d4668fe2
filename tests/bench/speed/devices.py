"""The same frames on every OpenCL device of this machine, turn by turn: frames, and which kernels differ."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from statistics import median

from client.tuning.devices import other_devices
from server.opencl.device import Device
from tests.bench.report.finished import Part
from tests.bench.speed.frames import WARM_UP, Measured, Say, Stage

LEAST_MS = 1.0
"""Kernels that take less on both are not told."""
MUCH = 1.5
"""Times as long as on the other device."""


def measure_devices(device: Device, stage: Stage, frames: range, say: Say) -> Part:
    """Rows of each usable device; the first is the one that the other parts are measured on."""
    devices = [device, *other_devices(device)]
    part = Part(sizes={"devices": len(devices)})
    if len(devices) == 1:
        part.leave_out("devices side by side", "this machine has one usable OpenCL device")
        return part
    sessions = [stage.session(one, frames) for one in devices]
    measured = [Measured() for _ in devices]
    kernels: list[dict[str, list[float]]] = [defaultdict(list) for _ in devices]
    for number, index in enumerate(frames):
        if number % 10 == 0:
            say(f"devices: frame {number} of {len(frames)}")
        frame = stage.source[index]
        for session, found, times in zip(sessions, measured, kernels, strict=True):
            found.process(session, replace(frame), counts=number >= WARM_UP)
            if number >= WARM_UP:
                for name, ms in session.kernel_ms.items():
                    times[name].append(ms)
    for session in sessions:
        session.close()
    for one, found, times in zip(devices, measured, kernels, strict=True):
        part.add(f"{one.name}: frame, median", found.median(), "ms")
        part.add(f"{one.name}: host's own time, median", found.median("host"), "ms")
        part.add(f"{one.name}: kernels, sum of medians", sum(median(ms) for ms in times.values()), "ms")
    _add_kernels(part, devices, kernels)
    return part


def _add_kernels(part: Part, devices: list[Device], kernels: list[dict[str, list[float]]]) -> None:
    """Kernels that take MUCH longer on one device than on the first."""
    first = kernels[0]
    for one, times in zip(devices[1:], kernels[1:], strict=True):
        for name in sorted(first.keys() & times.keys()):
            here, there = median(first[name]), median(times[name])
            if max(here, there) >= LEAST_MS and max(here / there, there / here) >= MUCH:
                part.add(f"{name}: {devices[0].name} over {one.name}", here / there, "")
