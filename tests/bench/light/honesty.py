"""`sh_std` on 200 synthetic scenes: the true coefficient should lie inside its 95 % interval 90 to 99 % of the time.

A scene is a view of a synthetic room or table, its surfaces all alike or textured, under a random light of 16
coefficients, seen with camera noise. As in E1 the reconstructed geometry is shaded, so the truth is exact.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from client.synthetic.source import SyntheticSource, open_synthetic
from client.tuning.known_light import ALBEDO, ShadedView, shaded_views
from protocol.frames import CameraModel
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.maths.sh import lambert_transfer, sh_basis, spherical_fibonacci
from server.opencl.device import Device
from tests.bench.light.coverage import Estimate, coverage
from tests.bench.light.runs import refusal, wishes_for
from tests.bench.report.finished import Part
from tests.bench.report.run import Run

SCENES, QUICK_SCENES = 200, 48
LIGHTS_A_VIEW = 4
SPECS = ("table", "table?texture=1", "room?texture=0", "room")
STEP = 12
"""Frames between views."""
LOBES = 4
BRIGHTEST = 0.9
"""Of the picture's range."""
NOISE = 0.004
"""Standard deviation of the camera's noise, of the picture's range."""

Floats = NDArray[np.float64]


def honesty_part(run: Run) -> Part:
    """Coverage over all scenes."""
    count = run.of(QUICK_SCENES, SCENES)
    part = Part(sizes={"scenes of honesty": count})
    estimates: list[Estimate] = []
    for number, spec in enumerate(SPECS):
        run.say(f"honesty: {spec}")
        estimates += _estimates(run.device, spec, count // len(SPECS), seed=number)
    shares = coverage(estimates)
    row = "sh_std: true coefficient inside its 95 % interval"
    part.add(f"{row}, at least", 100 * float(shares.mean()), "%", ">= 90")
    part.add(f"{row}, at most", 100 * float(shares.mean()), "%", "<= 99")
    unknown = 100 * float(np.mean([~np.isfinite(item.std) for item in estimates]))
    part.add("sh_std: coefficients without an interval", unknown, "%")
    for band in range(4):
        part.add(f"{row}, band {band}", 100 * float(shares[band * band : (band + 1) ** 2].mean()), "%")
    for number, spec in enumerate(SPECS):
        own = coverage(estimates[number * (count // len(SPECS)) : (number + 1) * (count // len(SPECS))])
        part.add(f"{row}, {spec}", 100 * float(own.mean()), "%")
    return part


def _estimates(device: Device, spec: str, count: int, seed: int) -> Iterator[Estimate]:
    views = -(-count // LIGHTS_A_VIEW)
    joint = "&" if "?" in spec else "?"
    source = open_synthetic(f"synthetic:{spec}{joint}size=320x240&frames={views * STEP}")
    wishes = _wishes(source)
    assert wishes.volume_m is not None
    assert wishes.voxel_m is not None
    generator = np.random.default_rng(seed)
    left = count
    frames = (source[i] for i in range(0, len(source), STEP))
    for view in shaded_views(device, source.camera, frames, wishes.volume_m, wishes.voxel_m):
        albedo = source.truth(view.frame.index).albedo.astype(float) if source.options.texture else ALBEDO
        for _ in range(min(left, LIGHTS_A_VIEW)):
            yield _estimate(device, source.camera, wishes, view, albedo, generator)
            left -= 1


def _wishes(source: SyntheticSource) -> Wishes:
    """The pictures have no indirect light; where there are textures the albedo is estimated, if this server can."""
    wishes = msgspec.structs.replace(wishes_for(source, range(len(source))), preset="reg4", indirect="none")
    estimated = msgspec.structs.replace(wishes, albedo="estimated")
    return estimated if source.options.texture and not refusal(estimated) else wishes


def _estimate(
    device: Device,
    camera: CameraModel,
    wishes: Wishes,
    view: ShadedView,
    albedo: Floats | float,
    generator: np.random.Generator,
) -> Estimate:
    light = random_light(generator)
    radiance = view.under(light, albedo)
    light *= BRIGHTEST / float(np.percentile(radiance[view.covered], 99.9))
    frame = view.lit(light, albedo).frame
    noise = generator.normal(0, 255 * NOISE, frame.color.shape)
    noisy = replace(frame, color=np.rint(frame.color + noise).clip(0, 255).astype(np.uint8))
    pipeline = ClientSession(device, camera, wishes)
    found = pipeline.process(noisy).light
    pipeline.close()
    std = np.array([[np.inf if value is None else value for value in row] for row in found.sh_std], np.float64)
    return Estimate(np.array(found.sh), std, light)


def random_light(generator: np.random.Generator) -> Floats:
    """[16, 3] a few lobes of random place, width and colour over an even sky; white shades to 1 at the brightest."""
    directions = spherical_fibonacci(2000)
    radiance = np.full((len(directions), 3), 0.15) * generator.uniform(0.5, 1.5, 3)
    for _ in range(LOBES):
        axis = generator.normal(size=3)
        cosine = directions @ (axis / np.linalg.norm(axis))
        sharpness = generator.uniform(1, 8)
        radiance += np.outer(np.exp(sharpness * (cosine - 1)), generator.uniform(0.3, 1, 3) * generator.exponential())
    light: Floats = sh_basis(directions, 4).T @ radiance * (4 * np.pi / len(directions))
    return light / float((lambert_transfer(directions, 4) @ light).max())
