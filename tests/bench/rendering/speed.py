"""What rendering costs: each effect against the picture's size and the object's triangles, and the whole stage.

Frames of a moving camera go through the whole pipeline; the stage's work is timed where it is done. Before an effect
starts and after it ends the device has nothing queued. Processor time over two cores stands beside the wall's, which
other load distorts.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from statistics import median
from typing import Any
from unittest.mock import patch

import msgspec
import pyopencl as cl
import trimesh

from client.synthetic.source import SyntheticSource, open_synthetic
from protocol.frames import RgbdFrame
from server.client_session import ClientSession
from server.effects import plan, renderer
from server.effects.plan import Effect
from server.scene.mesh import Mesh, load_mesh
from server.scene.placement import Placement
from server.shading.composite import composite
from tests.bench.light.runs import at_preset, refusal, wishes_for
from tests.bench.rendering.common import PRESETS
from tests.bench.report.finished import Part
from tests.bench.report.run import Run

SCENE = "table"
SIZES = ("160x120", "320x240", "640x480", "1280x960")
SECTIONS = {1_000: (25, 20), 20_000: (125, 80), 100_000: (250, 200), 500_000: (625, 400)}
"""Of a torus of so many triangles: along its ring, around its tube."""
SIZE, COUNT, FAST = "640x480", 20_000, "gr15fast"
"""What the budget is for: the thesis's 20 000 triangles."""
BUDGET_MS = 60
CORES, WARM_UP = 2, 3
PLACE_M = (0.05, 0.0, 0.12)
RING_M, TUBE_M = 0.13, 0.06
"""The torus covers about a twentieth of the picture."""
EVERYTHING = "whole rendering stage"

Times = dict[str, list[float]]


@dataclass
class StageClock:
    """Milliseconds of each effect and of the whole stage, a list entry a frame that has it."""

    queue: cl.CommandQueue
    wall_ms: Times = field(default_factory=lambda: defaultdict(list))
    cpu_ms: Times = field(default_factory=lambda: defaultdict(list))

    def forget(self) -> None:
        """Begin anew."""
        self.wall_ms.clear()
        self.cpu_ms.clear()

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Count what is done inside, on the host and on the device, under `name`."""
        self.queue.finish()
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        self.queue.finish()
        self.wall_ms[name].append((time.perf_counter() - wall) * 1e3)
        self.cpu_ms[name].append((time.process_time() - cpu) * 1e3)

    def run_effect(self, effect: Effect[Any], arguments: Mapping[str, Any]) -> object:
        """As `server.effects.plan.run_effect`, with the time that it takes."""
        with self.timed(effect.name):
            return effect.run(**arguments)

    def composite(self, *arguments: Any) -> Any:
        """As `server.shading.composite.composite`, with the time that it takes."""
        with self.timed("composite"):
            return composite(*arguments)


@cache
def _source(size: str) -> SyntheticSource:
    return open_synthetic(f"synthetic:{SCENE}?size={size}")


@cache
def _frame(size: str, index: int) -> RgbdFrame:
    return _source(size)[index]


def speed_part(run: Run) -> Part:
    """Rows against pixels, against triangles, and the budget."""
    part = Part(sizes={"frames of rendering's speed": run.of(4, 15)})
    parts = [speed_of(run, FAST, size, COUNT) for size in SIZES]
    parts += [speed_of(run, FAST, SIZE, count) for count in SECTIONS if count != COUNT]
    parts += [speed_of(run, preset, SIZE, COUNT) for preset in PRESETS if preset != FAST]
    for one in parts:
        part.rows += one.rows
        part.unmeasured += one.unmeasured
    return part


def speed_of(run: Run, preset: str, size: str, triangles: int) -> Part:
    """Rows of each effect and of the whole stage."""
    part = Part()
    row = f"{preset.upper()}, {size}, {triangles} triangles"
    source = _source(size)
    wishes = at_preset(wishes_for(source, range(1)), preset)
    refused = refusal(wishes)
    if refused:
        part.leave_out(row, refused)
        return part
    run.say(row)
    light = tuple((float(r), float(g), float(b)) for r, g, b in source.truth(0).sh)
    pipeline = ClientSession(run.device, source.camera, msgspec.structs.replace(wishes, light=light))
    pipeline.place_object("object-0", torus(triangles), Placement(position_m=PLACE_M))
    clock = StageClock(pipeline._engine.queue)
    with clocked(pipeline, clock):
        for index in range(WARM_UP + run.of(4, 15)):
            if index == WARM_UP:
                clock.forget()
            pipeline.process(_frame(size, index))
    pipeline.close()
    for name, spent in clock.cpu_ms.items():
        times = median(clock.wall_ms[name]), median(spent) / CORES
        is_held = name == EVERYTHING and (preset, size, triangles) == (FAST, SIZE, COUNT)
        part.add(
            f"{row}: {name}: processor time of {CORES} cores, median",
            times[1],
            "ms",
            f"<= {BUDGET_MS}" if is_held else "",
        )
        part.add(f"{row}: {name}: wall, median", times[0], "ms")
    return part


@contextmanager
def clocked(pipeline: ClientSession, clock: StageClock) -> Iterator[None]:
    """Times the effects and the stage of every frame that `pipeline` processes inside."""
    profile = pipeline._engine.profile
    stage = profile.stage

    @contextmanager
    def timed_stage(row: str) -> Iterator[None]:
        with stage(row):
            if row == "rendering":
                with clock.timed(EVERYTHING):
                    yield
            else:
                yield

    with (
        patch.object(profile, "stage", timed_stage),
        patch.object(plan, "run_effect", clock.run_effect),
        patch.object(renderer, "composite", clock.composite),
    ):
        yield


def torus(triangles: int) -> Mesh:
    """Closed, lying on its side, of the same shape and size whatever its triangles; PLY's up is z."""
    along, around = SECTIONS[triangles]
    shape = trimesh.creation.torus(RING_M, TUBE_M, major_sections=along, minor_sections=around)
    return load_mesh(shape.export(file_type="ply"), "ply")
