"""`probeless tune`: what accuracy costs in time on this device, measured once and kept (U1).

The stage set is made by code, so its light, and its pictures with its guests in them, are known exactly. Every point
runs the same frames as `probeless run` would with nothing else said: albedos estimated, indirect light observed, the
guests as virtual objects.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from client.laptop.objects import ObjectFile
from client.laptop.run import place_objects
from client.laptop.synthetic.export import write_guests
from client.laptop.synthetic.source import SyntheticSource, open_synthetic
from client.laptop.volume import default_volume, default_voxel
from client.progress import progress_bar
from protocol.messages import Wishes
from server.costs import rows_of
from server.evaluation.environment import direction_error_deg
from server.fronts import Front, FrontPoint, NoFrontError, own_version, read_front, write_front
from server.opencl.device import Device
from server.operating_points import Point
from server.pipeline import FrameResult, Pipeline
from server.stages.composite import srgb_codes

FRAMES = 14
SETTLING = 4
"""First frames: kernels are compiled, arrays made, and the light has seen little of the room."""
SIZE = "640x480"
STAGE = f"synthetic:stage?size={SIZE}&frames={FRAMES}&texture=market&light=7"

POINTS: tuple[Point, ...] = (
    *(
        Point(preset="gr15fast", rays=rays, stride=stride)
        for rays, stride in ((25, 16), (49, 8), (49, None), (81, None))
    ),
    *(
        Point(preset="reg8", rays=rays, stride=stride)
        for rays, stride in ((25, 16), (25, None), (49, None), (81, None))
    ),
    *(Point(preset="reg4", rays=rays) for rays in (49, 81, 169)),
    *(Point(preset="art4", rays=rays) for rays in (49, 81)),
    Point(preset="reg4", stride=2),
    Point(preset="gr15"),
    Point(preset="art1"),
    Point(preset="rm"),
)
"""From coarse and fast to fine and slow; which of them is on the front, the device says."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class _Truth:
    """Of every frame of the stage."""

    source: SyntheticSource
    light: NDArray[np.float64]
    """[16, 3] in the pictures' units."""
    composites: list[NDArray[np.uint8]]
    """[h, w, 3] sRGB codes with the guests."""
    changed: list[NDArray[np.bool_]]
    """[h, w] where the guests change the picture."""


def tune(device: Device, progress: Progress, points: Sequence[Point] = POINTS) -> Front:
    """Measure `points` on the device; `progress` is told frames done and in all."""
    truth = _truth_of_stage()
    measured: list[FrontPoint] = []
    with TemporaryDirectory() as folder:
        objects = [ObjectFile(path, None) for path in write_guests(Path(folder), _with_guests())]
        for number, point in enumerate(points):
            started = number * FRAMES

            def say(done: int, started: int = started) -> None:
                progress(started + done, len(points) * FRAMES)

            measured.append(_measure(device, truth, point, objects, say))
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    return Front(device=device.name, version=own_version(), measured=today, scene=STAGE, points=tuple(measured))


def ensure_front(device: Device, note: Callable[[str], None]) -> None:
    """Measure the device if that was not done yet. Raises OSError where the front cannot be kept."""
    try:
        read_front(device.name)
    except NoFrontError:
        note(f"measuring once what accuracy costs on {device.name} ...")
        with progress_bar("points") as progress:
            path = write_front(tune(device, progress))
        note(f"kept in {path}")


def lines_of(front: Front) -> Iterator[str]:
    """A front as a table, fastest first."""
    best = {point.point for point in front.best()}
    yield f"{front.device}, {front.measured}: median of {FRAMES - SETTLING} frames, {SIZE}, two objects in view"
    yield f"{'':2}{'ms':>8}{'light off by':>14}{'picture off by':>16}  settings"
    for point in sorted(front.points, key=lambda p: p.total_ms):
        mark = "*" if point.point in best else ""
        light, picture = f"{point.light_error_deg:.2f} deg", f"{point.picture_error:.2f}/255"
        yield f"{mark:2}{point.total_ms:8.1f}{light:>14}{picture:>16}  {point.point.settings}"
    yield "*: no faster point is as good. The choice of --budget-ms, --max-light-error and --preset auto."


def _with_guests() -> SyntheticSource:
    return open_synthetic(f"{STAGE}&with=both")


def _truth_of_stage() -> _Truth:
    bare, guests = open_synthetic(STAGE), _with_guests()
    composites = [srgb_codes(guests.truth(i).radiance) for i in range(FRAMES)]
    pictures = [srgb_codes(bare.truth(i).radiance) for i in range(FRAMES)]
    changed = [(with_guests != without).any(axis=-1) for with_guests, without in zip(composites, pictures, strict=True)]
    return _Truth(bare, np.asarray(bare.truth(0).sh), composites, changed)


def _measure(
    device: Device, truth: _Truth, point: Point, objects: list[ObjectFile], say: Callable[[int], None]
) -> FrontPoint:
    source = truth.source
    volume_m = default_volume(source, range(FRAMES))
    usual = Wishes(volume_m=volume_m, voxel_m=default_voxel(volume_m), up=source.up)
    wishes = structs.replace(point.wishes(usual), albedo="estimated", indirect="observed")
    pipeline = Pipeline(device, source.camera, wishes)
    found: list[FrameResult] = []
    try:
        place_objects(pipeline, tuple(objects), lambda _: None)
        for index in range(FRAMES):
            found.append(pipeline.process(source[index]))
            say(index + 1)
    finally:
        pipeline.close()
    steady = range(SETTLING, FRAMES)
    rows = [rows_of(found[i].timings) for i in steady]
    lights = [np.array(found[i].light.sh, np.float64) for i in steady]
    return FrontPoint(
        point=point,
        ms={name: median(row[name] for row in rows) for name in rows[0]},
        light_error_deg=median(direction_error_deg(light, truth.light) for light in lights),
        picture_error=median(_difference(truth, i, found[i].color) for i in steady),
    )


def _difference(truth: _Truth, index: int, shown: NDArray[np.uint8]) -> float:
    """Mean over the pixels that the guests change, display units."""
    mask = truth.changed[index]
    return float(np.abs(shown[mask].astype(np.float64) - truth.composites[index][mask]).mean())
