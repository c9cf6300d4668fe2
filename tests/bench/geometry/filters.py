"""The input's filters: TV-L1 against OpenCV's at equal iterations and energy, and the bilateral filter of depth."""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median

import cv2
import numpy as np
from numpy.typing import NDArray

from server.input.denoise import bilateral_depth, tv_l1
from server.opencl.device import Device
from server.opencl.engine import Engine
from tests.bench.report.finished import Part

ITERATIONS = (30, 100)
"""30 is `cv2.denoise_TVL1`'s own default."""
CONVERGED = 2000
WEIGHT = 1.0
"""Its default lambda: of the data term, pictures in [0, 1]."""
BILATERAL_GOAL_MS = 15

Picture = NDArray[np.uint8]


def filters_part(device: Device, gray: Picture, depth_m: NDArray[np.float32], trials: int) -> Part:
    """gray: [h, w] 0 to 255, real noise; depth_m: [h, w], 0 = none."""
    part = Part(sizes={"trials of a filter": trials})
    engine = Engine(device)
    try:
        for iterations in ITERATIONS:
            _tv_l1_rows(part, engine, gray, iterations, trials)
        converged = energy(_opencv(gray, CONVERGED), gray)  # falls to ours: both minimise one energy
        part.add(f"TV-L1, {CONVERGED} iterations: energy, OpenCV", converged, "")
        _bilateral_rows(part, engine, depth_m, trials)
    finally:
        engine.close()
    return part


def _tv_l1_rows(part: Part, engine: Engine, gray: Picture, iterations: int, trials: int) -> None:
    picture = engine.workspace.upload("bench_gray", (gray / 255).astype(np.float32))
    theirs = np.zeros_like(gray)

    def run_ours() -> None:
        tv_l1(engine, picture, iterations, WEIGHT)
        engine.queue.finish()

    def run_theirs() -> None:
        nonlocal theirs
        theirs = _opencv(gray, iterations)

    (our_ms, our_cpu), (their_ms, their_cpu) = in_turn((run_ours, run_theirs), trials)
    result = np.clip(engine.download(tv_l1(engine, picture, iterations, WEIGHT)), 0, 1)
    ours = np.rint(255 * result).astype(np.uint8)  # as theirs are
    name = f"TV-L1, {iterations} iterations"
    part.add(f"{name}: probeless, median", our_ms, "ms")
    part.add(f"{name}: OpenCV denoise_TVL1, median", their_ms, "ms")
    part.add(f"{name}: time of OpenCV / probeless", their_ms / our_ms, "", ">= 5")
    part.add(f"{name}: processor time of OpenCV / probeless", their_cpu / our_cpu, "")
    part.add(f"{name}: energy before", energy(gray, gray), "")
    part.add(f"{name}: energy, OpenCV", energy(theirs, gray), "")
    part.add(f"{name}: energy, probeless, rounded to 8 bits as OpenCV's", energy(ours, gray), "")
    part.add(f"{name}: energy of probeless / OpenCV", energy(ours, gray) / energy(theirs, gray), "", "<= 1")


def _bilateral_rows(part: Part, engine: Engine, depth_m: NDArray[np.float32], trials: int) -> None:
    depth = engine.workspace.upload("bench_depth", depth_m)

    def run_ours() -> None:
        bilateral_depth(engine, depth)
        engine.queue.finish()

    def run_theirs() -> None:
        cv2.bilateralFilter(depth_m, 7, 0.03, 2.0)

    (our_ms, our_cpu), (their_ms, _) = in_turn((run_ours, run_theirs), trials)
    part.add("bilateral filter of depth: probeless, median", our_ms, "ms", f"<= {BILATERAL_GOAL_MS}")
    part.add("bilateral filter of depth: probeless, processor time, median", our_cpu, "ms")
    part.add("bilateral filter of depth: OpenCV bilateralFilter 7x7 (holes not left out), median", their_ms, "ms")


def _opencv(gray: Picture, iterations: int) -> Picture:
    result = np.zeros_like(gray)
    cv2.denoise_TVL1([gray], result, WEIGHT, iterations)
    return result


def energy(picture: Picture, noisy: Picture) -> float:
    """TV(u) + lambda |u - f|_1 of 8-bit pictures taken as [0, 1]; isotropic forward differences.

    Without the first two rows and columns: OpenCV's first ones do not converge to this energy's minimum, ours do.
    """
    u, f = picture[2:, 2:] / 255, noisy[2:, 2:] / 255
    right, down = np.diff(u, axis=1, append=u[:, -1:]), np.diff(u, axis=0, append=u[-1:])
    return float(np.hypot(right, down).sum() + WEIGHT * np.abs(u - f).sum())


def in_turn(runs: tuple[Callable[[], None], ...], trials: int) -> list[tuple[float, float]]:
    """Median wall and processor ms of each, run by turns after one round that does not count."""
    times: list[list[tuple[float, float]]] = [[] for _ in runs]
    for trial in range(trials + 1):
        for run, kept in zip(runs, times, strict=True):
            wall, cpu = time.perf_counter(), time.process_time()
            run()
            if trial:
                kept.append(((time.perf_counter() - wall) * 1e3, (time.process_time() - cpu) * 1e3))
    return [(median(wall for wall, _ in kept), median(cpu for _, cpu in kept)) for kept in times]
