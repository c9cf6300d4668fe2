"""One operating point on one scene: what its light and its pictures err by, and what that costs."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from statistics import mean
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from msgspec import Struct, structs
from numpy.typing import NDArray

from client.objects.object_file import ObjectFile
from client.objects.placing import place_objects
from protocol.messages import TIMING_ROWS
from server.client_session import ClientSession
from server.maths.light_direction import direction_error_deg
from server.opencl.device import Device
from server.pipeline import FrameResult
from server.quality.sampling_settings import option_of
from tests.bench.accuracy.scenes import Shot, SweptScene
from tests.bench.light.environment import environment_difference, irradiance_error
from tests.bench.rendering.flip import flip_map
from tests.bench.rendering.ssim import ssim_map
from tests.bench.report.processor import ProcessorTime

SETTLING = 2
"""First frames of a run, which do not count: kernels are compiled, arrays made."""


class MeasuredPoint(Struct, frozen=True, kw_only=True):
    """A line of points.jsonl. Every list has an entry a frame whose truth is known; none where there is no such metric.

    Errors of light are means over the places where it is judged.
    """

    scene: str
    knob: str
    """What was turned, from the scene's usual wishes."""
    settings: dict[str, Any]
    """Wishes that differ from the usual ones."""
    words: str
    """The settings as options of the command line."""
    frames: list[int]
    direction_deg: list[float]
    irradiance: list[float]
    """Relative RMSE over all normals."""
    msad: list[float]
    """Of the environment map, relative."""
    flip: list[float]
    """Mean over what virtual objects change."""
    ssim: list[float]
    """Likewise; 1 is alike."""
    jod: list[float]
    """ColorVideoVDP, just objectionable differences of the whole picture, 10 is alike; where it is installed."""
    ms: dict[str, list[float]]
    """By the rows of `Timings`."""
    cpu_ms: list[float]
    """Of all cores."""
    device_bytes: int


def measure_point(device: Device, scene: SweptScene, knob: str, settings: dict[str, Any], frames: int) -> MeasuredPoint:
    """Run a scene at one point. Raises ValueError for wishes that cannot be fulfilled."""
    wishes = structs.replace(scene.wishes, **settings)
    pipeline = ClientSession(device, scene.camera, wishes)
    results: list[FrameResult] = []
    cpu_ms: list[float] = []
    shots = scene.shots(frames)
    try:
        with TemporaryDirectory() as folder:
            objects = tuple(ObjectFile(path, None) for path in scene.write_objects(Path(folder)))
            place_objects(pipeline, objects, lambda _: None)
        for shot in shots:
            spent = ProcessorTime()
            results.append(pipeline.process(shot.frame))
            cpu_ms.append(spent.ms())
        device_bytes = pipeline.device_bytes
    finally:
        pipeline.close()
    kept = slice(min(SETTLING, frames - 1), None)
    lights = [lights_of(result, shot) for result, shot in zip(results, shots, strict=True)][kept]
    rows = [{n: getattr(result.timings, n) for n in (*TIMING_ROWS, "total")} for result in results[kept]]
    drawn = [*zip(shots, results, strict=True)][kept]
    pictures = [(shot, result.color) for shot, result in drawn if shot.composite is not None]
    return MeasuredPoint(
        scene=scene.name,
        knob=knob,
        settings=settings,
        words=words_of(settings),
        frames=[shot.frame.index for shot in shots][kept],
        direction_deg=[mean(direction_error_deg(*pair) for pair in places) for places in lights],
        irradiance=[mean(irradiance_error(*pair) for pair in places) for places in lights],
        msad=[mean(environment_difference(*pair) for pair in places) for places in lights],
        flip=[_flip(*pair) for pair in pictures] if find_spec("flip_evaluator") else [],
        ssim=[_ssim(*pair) for pair in pictures],
        jod=[_jod(*pair) for pair in pictures] if find_spec("pycvvdp") else [],
        ms={name: [row[name] for row in rows] for name in rows[0]},
        cpu_ms=cpu_ms[kept],
        device_bytes=device_bytes,
    )


def lights_of(result: FrameResult, shot: Shot) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Found and true light [n, 3] of a frame: at each place, or the one from beyond the scan."""
    if shot.light.ndim == 2:
        return [(_cut(np.array(result.light.sh_all or result.light.sh), shot.light), shot.light)]
    found = [np.array(light.sh) for light in result.light.at if light.of == "place"]
    return [(_cut(light, true), true) for light, true in zip(found, shot.light, strict=True)]


def words_of(settings: dict[str, Any]) -> str:
    """Options of the command line that say the same."""
    return " ".join(option_of(name, value) for name, value in settings.items()) or "as usual"


def _cut(found: NDArray[np.float64], true: NDArray[np.float64]) -> NDArray[np.float64]:
    """`found` with as many coefficients as the truth: what it lacks is zero, what the truth lacks cannot be judged."""
    same = np.zeros_like(true)
    count = min(len(found), len(true))
    same[:count] = found[:count]
    return same


def _flip(shot: Shot, shown: NDArray[np.uint8]) -> float:
    assert shot.composite is not None
    return float(flip_map(shot.composite, shown)[shot.changed].mean())


def _ssim(shot: Shot, shown: NDArray[np.uint8]) -> float:
    assert shot.composite is not None
    return float(ssim_map(shot.composite, shown)[shot.changed].mean())


def _jod(shot: Shot, shown: NDArray[np.uint8]) -> float:
    import pycvvdp

    metric = pycvvdp.cvvdp(display_name="standard_4k", heatmap="none")
    found, _ = metric.predict(shown, shot.composite, dim_order="HWC")
    return float(found)
