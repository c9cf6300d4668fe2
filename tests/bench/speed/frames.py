"""Frames of one scene at several settings, turn by turn: their times, counts and pictures."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from statistics import median

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from client.sources.frame_source import Source
from client.sources.volume import default_volume, default_voxel
from protocol.frames import RgbdFrame
from protocol.messages import TIMING_ROWS, Timings, Vector3, Wishes
from server.client_session import ClientSession
from server.opencl.device import Device
from server.pipeline import FrameResult
from server.scene.mesh import load_mesh
from server.scene.placement import Placement
from tests.bench.rendering.flip import flip_map
from tests.bench.report.finished import Part
from tests.bench.report.processor import ProcessorTime
from tests.scenes.turns import Alone

WARM_UP = 8
"""Frames whose time does not count: kernels are compiled, and the scan begins."""
DEFAULT, WITHOUT, FAST, EMPTY = "defaults", "--cache off", "GR15FAST", "no object"
LIVE = "defaults, live"
"""As a server draws a camera's frames, which do not wait for the light beside them."""

Say = Callable[[str], None]


@dataclass(frozen=True)
class Stage:
    """A scene and the virtual object in it."""

    source: Source
    mesh: Path
    position_m: Vector3
    scale: float

    def session(self, device: Device, frames: range, *, has_object: bool = True, **wishes: str) -> ClientSession:
        """A session whose volume is for `frames`; wishes: what is not the default."""
        volume_m = default_volume(self.source, frames)
        asked = Wishes(volume_m=volume_m, voxel_m=default_voxel(volume_m), up=self.source.up)
        session = ClientSession(device, self.source.camera, structs.replace(asked, **wishes))
        if has_object:
            mesh = load_mesh(self.mesh.read_bytes(), "glb")
            session.place_object("thing", mesh, Placement(position_m=self.position_m, scale=self.scale))
        return session


@dataclass
class Measured:
    """Frames at one setting after the warm-up."""

    timings: list[Timings] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)
    """Of all threads, and of the process that solves the light."""

    def process(
        self, session: ClientSession, frame: RgbdFrame, *, counts: bool, turn: Alone | None = None
    ) -> FrameResult:
        """One frame; its times are kept if it `counts`."""
        spent = ProcessorTime()
        result = session.process(frame, turn=turn)
        if counts:
            self.cpu_ms.append(spent.ms())
            self.timings.append(result.timings)
        return result

    def of(self, row: str) -> list[float]:
        """A field of the timings, frame by frame."""
        return [float(getattr(timings, row)) for timings in self.timings]

    def median(self, row: str = "total") -> float:
        """Of all frames."""
        return median(self.of(row))


def measure_moving(device: Device, stage: Stage, frames: range, say: Say) -> Part:
    """Rows of a moving camera."""
    sessions = {
        DEFAULT: stage.session(device, frames),
        WITHOUT: stage.session(device, frames, cache="off"),
        FAST: stage.session(device, frames, preset="gr15fast"),
        EMPTY: stage.session(device, frames, has_object=False),
        LIVE: stage.session(device, frames),
    }
    measured = {name: Measured() for name in sessions}
    flips: list[float] = []
    for number, index in enumerate(frames):
        if number % 10 == 0:
            say(f"moving camera: frame {number} of {len(frames)}")
        frame = stage.source[index]
        counts = number >= WARM_UP
        results = {
            name: measured[name].process(session, replace(frame), counts=counts, turn=Alone() if name == LIVE else None)
            for name, session in sessions.items()
        }
        if counts and find_spec("flip_evaluator") is not None:
            flips.append(_flip(results[DEFAULT], results[WITHOUT]))
    for session in sessions.values():
        session.close()
    part = Part(sizes={"frames of a moving camera": len(frames) - WARM_UP})
    _add_times(part, measured)
    _add_counts(part, measured[DEFAULT])
    if flips:
        part.add("moving camera: FLIP, with caches to without, median", median(flips), "", "<= 0.01")
        part.add("moving camera: FLIP, with caches to without, worst frame", max(flips), "", "<= 0.03")
    else:
        part.leave_out("moving camera: FLIP", "flip_evaluator not installed: make install-bench")
    return part


def _flip(some: FrameResult, others: FrameResult) -> float:
    pictures: Sequence[NDArray[np.uint8] | None] = (some.color, others.color)
    assert pictures[0] is not None
    assert pictures[1] is not None
    return float(flip_map(pictures[0], pictures[1]).mean())


def _add_times(part: Part, measured: Mapping[str, Measured]) -> None:
    goals = {DEFAULT: "<= 100", FAST: "<= 50", WITHOUT: "", EMPTY: "", LIVE: ""}
    cores = os.cpu_count() or 1
    for name, found in measured.items():
        part.add(f"moving camera, {name}: frame, median", found.median(), "ms", goals[name])
        part.add(
            f"moving camera, {name}: processor time over {cores} cores, median", median(found.cpu_ms) / cores, "ms"
        )
    for name, goal in ((DEFAULT, "<= 180"), (LIVE, "")):
        p95 = float(np.quantile(measured[name].of("total"), 0.95))
        part.add(f"moving camera, {name}: frame, 95 % of them", p95, "ms", goal)
    ratios = np.array(measured[WITHOUT].of("total")) / np.array(measured[DEFAULT].of("total"))
    part.add("moving camera: frame without caches / with, median", float(np.median(ratios)), "", ">= 2.5")
    for row in TIMING_ROWS:
        part.add(f"moving camera, {DEFAULT}: {row}, median", measured[DEFAULT].median(row), "ms")
        part.add(f"moving camera, {WITHOUT}: {row}, median", measured[WITHOUT].median(row), "ms")


def _add_counts(part: Part, found: Measured) -> None:
    """What a faster device would leave."""
    part.add("moving camera: host's own time, median", found.median("host"), "ms", "<= 8")
    part.add("moving camera: kernels launched, median", found.median("launches"), "", "<= 40")
    part.add("moving camera: blocking reads, median", found.median("reads"), "", "<= 3")
    part.add("moving camera: bytes read, median", found.median("read_bytes"), "B")
    part.add("moving camera: copies to, from and on the device, median", found.median("copies"), "", "<= 12")
    in_rows = [sum(getattr(timings, row) for row in TIMING_ROWS) / timings.total for timings in found.timings]
    part.add("moving camera: share of the frame that no row tells", 100 * (1 - median(in_rows)), "%", "<= 5")


def measure_rest(device: Device, stage: Stage, index: int, frames: int, say: Say) -> Part:
    """Rows of a camera that stands still: the frame `index` again and again."""
    session, found, reused = stage.session(device, range(index, index + 1)), Measured(), 0
    frame = stage.source[index]
    for number in range(frames):
        if number % 20 == 0:
            say(f"camera at rest: frame {number} of {frames}")
        result = found.process(session, replace(frame, index=number), counts=reused >= WARM_UP)
        reused += result.is_reused
    session.close()
    part = Part(sizes={"frames of a camera at rest": len(found.timings)})
    if not found.timings:
        part.leave_out("camera at rest: frame", f"the view did not settle within {frames} frames")
        return part
    part.add("camera at rest: frame, median", found.median(), "ms", "<= 35")
    part.add("camera at rest: frames until nothing is computed again", frames - len(found.timings) - WARM_UP, "")
    return part
