"""Time of the estimation alone, and of each preset's transfer and estimation against RM's, turn by turn in one run."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from statistics import median
from typing import Any

import numpy as np

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.geometry.geometry import Geometry
from server.light.light_estimation import LightEstimator, sum_tiles
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.quality.settings import WHOLE_ROOM_M
from server.transfer.radiance_transfer import direction_sets, transfer_radiance
from tests.bench.light.runs import PRESETS, REFERENCE, at_preset, refusal, wishes_for
from tests.bench.report.finished import Part
from tests.bench.report.run import Run, data_source

SOURCE = "mitsuba_track_clean"
STRIDE, RAYS, BANDS = 4, 81, 4
"""19 200 samples of 640x480, 16 coefficients."""
ESTIMATION_GOAL_MS = 3
RATIO_GOALS = {"reg4": 5, "art4": 4, "gr15fast": 10}
WARM_UP = 3
CORES = 2


def speed_part(run: Run) -> Part:
    """Rows of estimation alone and of the presets' ratios."""
    source = data_source(SOURCE)
    count = WARM_UP + run.of(8, 40)
    frames = [source[i] for i in range(count)]
    part = Part(sizes={"frames of light's speed": count - WARM_UP, "trials of estimation": run.of(20, 100)})
    wishes = wishes_for(source, range(count))
    run.say("estimation alone")
    _add_estimation(part, run.device, source.camera, frames, wishes, run.of(20, 100))
    _add_presets(part, run, source.camera, frames, wishes)
    return part


def _add_estimation(
    part: Part, device: Device, camera: CameraModel, frames: list[RgbdFrame], wishes: Wishes, trials: int
) -> None:
    """Normal equations and the solve; processor time is held beside the wall's, which other load distorts."""
    engine = Engine(device)
    geometry = Geometry(engine, camera, wishes)
    for frame in frames[:WARM_UP]:
        seen = geometry.scan(frame)
    volume = geometry.volume
    assert volume is not None
    rays = direction_sets(RAYS, BANDS)
    transfer = transfer_radiance(engine, camera, volume, seen.surface, STRIDE, rays, WHOLE_ROOM_M)
    estimator = LightEstimator(BANDS)

    def estimate() -> None:
        estimator.update(sum_tiles(engine, camera, seen.measurement.radiance, seen.surface, transfer, volume.voxel_m))

    wall_ms, cpu_ms = timed(engine, estimate, trials)
    row = f"estimation of {transfer.rows * transfer.cols} samples, {BANDS**2} coefficients, 3 channels"
    part.add(f"{row}: median", median(wall_ms), "ms", f"<= {ESTIMATION_GOAL_MS}")
    part.add(f"{row}: minimum", min(wall_ms), "ms")
    part.add(
        f"{row}: processor time of {CORES} cores, median", median(cpu_ms) / CORES, "ms", f"<= {ESTIMATION_GOAL_MS}"
    )
    engine.close()


def timed(engine: Engine, work: Callable[[], None], trials: int) -> tuple[list[float], list[float]]:
    """Wall and processor milliseconds of each of `trials` calls after the warm-up."""
    wall_ms, cpu_ms = [], []
    for trial in range(WARM_UP + trials):
        engine.queue.finish()
        wall, cpu = time.perf_counter(), time.process_time()
        work()
        engine.queue.finish()
        if trial >= WARM_UP:
            wall_ms.append((time.perf_counter() - wall) * 1e3)
            cpu_ms.append((time.process_time() - cpu) * 1e3)
    return wall_ms, cpu_ms


def _add_presets(part: Part, run: Run, camera: CameraModel, frames: list[RgbdFrame], wishes: Wishes) -> None:
    """Each frame goes to every preset before the next one does."""
    pipelines: dict[str, ClientSession] = {}
    for preset in PRESETS:
        refused = refusal(at_preset(wishes, preset))
        if refused:
            part.leave_out(f"transfer + estimation, RM / {preset.upper()}", refused)
        else:
            pipelines[preset] = ClientSession(run.device, camera, at_preset(wishes, preset))
    spent: dict[str, list[float]] = {preset: [] for preset in pipelines}
    for index, frame in enumerate(frames):
        run.say(f"presets' times: frame {index + 1} of {len(frames)}")
        for preset, pipeline in pipelines.items():
            times = pipeline.process(frame).timings
            if index >= WARM_UP:
                spent[preset].append(times.radiance_transfer + times.light_estimation)
    for pipeline in pipelines.values():
        pipeline.close()
    for preset, times_ms in spent.items():
        part.add(f"transfer + estimation, {preset.upper()}: median", median(times_ms), "ms")
        if preset != REFERENCE:
            number = RATIO_GOALS.get(preset)
            ratios = np.array(spent[REFERENCE]) / np.array(times_ms)
            part.add(
                f"transfer + estimation, RM / {preset.upper()}: median",
                float(np.median(ratios)),
                "",
                f">= {number}" if number else "",
            )
            part.add(
                f"transfer + estimation, RM / {preset.upper()}: of minima", min(spent[REFERENCE]) / min(times_ms), ""
            )


def errors_beside(e1: Mapping[str, Mapping[str, Any]]) -> Part:
    """The presets' light error, to stand beside their times. e1: details of the E1 sequences."""
    part = Part()
    for preset in PRESETS:
        dots = np.concatenate([found[preset]["dots"] for found in e1.values() if preset in found] or [np.empty(0)])
        if len(dots):
            error = np.degrees(np.arccos(np.clip(dots, -1, 1)))
            part.add(f"light error beside the time of {preset.upper()}: E1, mean angle", float(error.mean()), "deg")
    return part
