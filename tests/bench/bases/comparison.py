"""B9 (thesis 8.3): spherical harmonics, spherical Gaussians and Haar wavelets of as many coefficients, on one kernel.

Lights that none of them holds exactly shade two scenes. Each basis holds them as known lights, and finds them again in
8-bit pictures, by the prior alone and without negative light; each then shades a virtual ball and the floor under it.
Besides, each is given the prior's weight that suits it best, which only the truth tells: what is then left between
bases is theirs, not the evidence's. Times are of the kernels that all share: transfer and the estimator's sums.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from statistics import median
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from client.sources.volume import default_volume, default_voxel
from client.synthetic.source import open_synthetic
from protocol.messages import Wishes
from server.light.panorama import read_panorama
from tests.bench.bases.bases import SIZES, Basis, bases_of, largest_haar
from tests.bench.bases.estimation import estimate_light
from tests.bench.bases.lights import HardLight, disc, of_panorama, sun, two_lamps
from tests.bench.bases.pictures import draw_bases
from tests.bench.bases.scene import Ball, LitScene
from tests.bench.bases.scores import Score, Transfers, Truth, score_light
from tests.bench.report.finished import Part, UnmeasurableError
from tests.bench.report.run import Run, data_folder

SamplingSettings = dict[str, Any]
Floats = NDArray[np.float64]

__all__ = ["bases_part", "draw_bases"]

SIZE = "320x240"
PANORAMAS = ("uffizi_latlong_1200x600", "venice_sunset_1k", "pedestrian_overpass_1k", "vogl_materialtest_envmap")
PANORAMA_SIZE = (256, 128)
SCENES = {
    "table": ((0, 45, 90), Ball((0.06, 0.0, -0.07), 0.06)),
    "stage": ((0, 120, 240), Ball((0.1, 0.0, 0.13), 0.035)),
}
"""Frames that are fused and estimated from, and a ball with things close to it."""
REFERENCE = ("SH", 16)
VARIANTS = ("known", "estimated", "estimated, not negative")
BEST = "estimated, best weight of the prior"
STRENGTHS = (10.0, 100.0, 1000.0)
"""Of the prior, times what evidence says; the best of them and of 1 is BEST's."""
MEASURES = {
    "direction_deg": ("dominant direction, mean angle", "deg"),
    "irradiance": ("irradiance, relative RMSE", ""),
    "msad": ("environment map, relative MSAD", ""),
    "shading": ("virtual ball, relative RMSE", ""),
    "near": ("floor under the ball, relative RMSE", ""),
}
"""Of each point, means over the lights: what its row says, and in which unit."""
FEW = ("direction_deg", "shading")
"""What has rows for other numbers of coefficients than the reference's."""
_WARM_UP = 2


def bases_part(run: Run) -> Part:
    """Rows of each basis, and `details["points"]` for `draw_bases`."""
    part = Part()
    lights = lights_of(part, run.of(2, 8), run.of(2, len(PANORAMAS)))
    trials = run.of(7, 31)
    part.sizes = {"lights of B9": len(lights), "trials of B9's times": trials}
    points: list[SamplingSettings] = []
    for name in SCENES:
        run.say(f"B9, {name}: {len(lights)} lights")
        scene = scene_of(run, name, lights)
        times_ms = device_ms(scene, trials, on_gpu=run.device.is_gpu)
        for size in SIZES:
            run.say(f"B9, {name}: {size} coefficients")
            for basis in bases_of(size):
                points += _points(name, basis, scene, times_ms)
            points.append(_largest(name, size, scene, times_ms))
        scene.close()
    for point in points:
        _add_rows(part, point)
    part.details["points"] = points
    return part


def lights_of(part: Part, turns: int, panoramas: int) -> list[HardLight]:
    """Every light from `turns` sides; `part` is told of panoramas that are not there."""
    found = {}
    try:
        for name in PANORAMAS[:panoramas]:
            whole = read_panorama(data_folder("hdr") / f"{name}.hdr")
            found[name] = np.asarray(cv2.resize(whole, PANORAMA_SIZE, interpolation=cv2.INTER_AREA), np.float64)
    except UnmeasurableError as error:
        part.leave_out("B9 under photographed lights", str(error))
    sides = 0.4 + 2 * np.pi * np.arange(turns) / turns
    made = [light(float(side)) for light in (sun, two_lamps, disc) for side in sides]
    return made + [of_panorama(name, p, float(side)) for name, p in found.items() for side in sides]


def scene_of(run: Run, name: str, lights: Sequence[HardLight]) -> LitScene:
    """One of SCENES under `lights`."""
    frames, ball = SCENES[name]
    source = open_synthetic(f"synthetic:{name}?size={SIZE}&frames={frames[-1] + 1}&noise=1")
    volume_m = default_volume(source, range(len(source)))
    wishes = Wishes(volume_m=volume_m, voxel_m=default_voxel(volume_m), up=source.up)
    return LitScene(run.device, source.camera, [source[i] for i in frames], wishes, lights, ball)


def device_ms(scene: LitScene, trials: int, *, on_gpu: bool) -> dict[tuple[str, int], float]:
    """Milliseconds by basis and size of one picture's transfer and sums, medians, turn by turn.

    Of the processor's time where the kernels run on it, which other programs do not disturb.
    """
    view = scene.views[0]
    radiance, queue = scene.show(0, view), scene.engine.queue
    clock = time.perf_counter if on_gpu else time.process_time
    spent: dict[tuple[str, int], list[float]] = {}
    order = [basis for size in SIZES for basis in bases_of(size)]
    for trial in range(_WARM_UP + trials):
        order = order[7:] + order[:7]  # no basis is always first after another number of coefficients
        for basis in order:
            queue.finish()
            start = clock()
            scene.sum_up(radiance, scene.traced(basis, view), view)
            queue.finish()
            if trial >= _WARM_UP:
                spent.setdefault((basis.name, basis.size), []).append((clock() - start) * 1e3)
    return {key: median(values) for key, values in spent.items()}


def _points(
    name: str, basis: Basis, scene: LitScene, times_ms: Mapping[tuple[str, int], float]
) -> list[SamplingSettings]:
    """One of each of VARIANTS, and BEST."""
    transfers = Transfers(scene.ball.transfer(basis), scene.floor.transfer(basis))
    truths = [_truth(scene, number) for number in range(len(scene.lights))]
    sums = scene.sums(basis)
    ratio = times_ms[basis.name, basis.size] / times_ms[REFERENCE]

    def point(variant: str, lights: Iterable[Floats]) -> SamplingSettings:
        scores = [score_light(basis, light, transfers, truth) for light, truth in zip(lights, truths, strict=True)]
        return _point(name, basis, variant, scores, scene, ratio)

    start = time.process_time()
    found = [estimate_light(item, basis) for item in sums]
    solve_ms = (time.process_time() - start) * 1e3 / len(sums)
    nearest = [basis.nearest(light.directions(), light.flux()) for light in scene.lights]
    points = [
        point(variant, lights) for variant, lights in zip(VARIANTS, (nearest, *zip(*found, strict=True)), strict=True)
    ]
    tried = points[1:]
    for strength in STRENGTHS:
        stronger = zip(*(estimate_light(item, basis, strength) for item in sums), strict=True)
        tried += [{**point(BEST, lights), "strength": strength} for lights in stronger]
    best = min(tried, key=lambda item: float(item["irradiance"]))
    return [*({**item, "solve_ms": solve_ms} for item in points), {"strength": 1.0, **best, "variant": BEST}]


def _largest(name: str, size: int, scene: LitScene, times_ms: Mapping[tuple[str, int], float]) -> SamplingSettings:
    """Wavelets chosen for each light anew, which must be known for that; they cost what others do."""
    scores = []
    for number, light in enumerate(scene.lights):
        basis = largest_haar(size, light.directions(), light.flux())
        transfers = Transfers(scene.ball.transfer(basis), scene.floor.transfer(basis))
        nearest = basis.nearest(light.directions(), light.flux())
        scores.append(score_light(basis, nearest, transfers, _truth(scene, number)))
    return _point(name, basis, "known", scores, scene, times_ms["SH", size] / times_ms[REFERENCE])


def _truth(scene: LitScene, light: int) -> Truth:
    return Truth.of(scene.lights[light], scene.shading(scene.ball, light), scene.shading(scene.floor, light))


def _point(
    name: str, basis: Basis, variant: str, scores: list[Score], scene: LitScene, ratio: float
) -> SamplingSettings:
    """Means over the lights, the least of what rings, and the means of each kind of light."""
    columns = {key: np.array([asdict(score)[key] for score in scores]) for key in asdict(scores[0])}
    kinds = sorted({light.name for light in scene.lights})
    of_kind = {kind: np.array([light.name == kind for light in scene.lights]) for kind in kinds}
    return {
        "basis": basis.name,
        "coefficients": basis.size,
        "scene": name,
        "variant": variant,
        "ms_ratio": ratio,
        **{key: float(columns[key].mean()) for key in MEASURES},
        **{f"{key}_error": float(columns[key].std() / np.sqrt(len(scores))) for key in MEASURES},
        **{key: float(columns[key].min()) for key in columns if key not in MEASURES},
        "by_light": {kind: {key: float(columns[key][of_kind[kind]].mean()) for key in MEASURES} for kind in kinds},
    }


def _add_rows(part: Part, point: SamplingSettings) -> None:
    is_reference = point["coefficients"] == REFERENCE[1]
    row = f"B9, {point['scene']}: {point['basis']}, {point['coefficients']} coefficients: {point['variant']}"
    for key in MEASURES if is_reference else FEW:
        part.add(f"{row}: {MEASURES[key][0]}", point[key], MEASURES[key][1])
    if is_reference:
        part.add(f"{row}: least irradiance over the truth's mean", point["least_irradiance"], "")
    if "strength" in point and is_reference:
        part.add(f"{row}: that weight, times what evidence says", point["strength"], "")
    if point["variant"] == VARIANTS[-1]:
        part.add(f"{row}: transfer and sums, of SH's time with {REFERENCE[1]}", point["ms_ratio"], "")
        part.add(f"{row}: solving, median", point["solve_ms"], "ms")
