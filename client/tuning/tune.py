"""`probeless tune`: accuracy against time of operating points on this device, measured once and saved (U1)."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Iterator, Sequence

from client.tuning.scenes import FRAMES, LIT_FRAMES, SETTLING, SIZE, LitRoom, Stage
from server.opencl.device import Device
from server.quality.pareto_front import ParetoFront, ParetoPoint, own_version, read_front
from server.quality.sampling_settings import SamplingSettings

POINTS: tuple[SamplingSettings, ...] = (
    *(SamplingSettings(preset="reg8", rays=rays) for rays in (25, 49, 81, 169)),
    *(SamplingSettings(preset="reg4", rays=rays) for rays in (49, 81, 169)),
    *(SamplingSettings(preset="gr15fast", rays=rays) for rays in (49, 81, 169)),
    SamplingSettings(preset="art8"),
    SamplingSettings(preset="art4"),
    SamplingSettings(preset="gr15"),
    SamplingSettings(preset="art1"),
    SamplingSettings(preset="rm"),
)
"""From coarse and fast to fine and slow; which are Pareto-optimal depends on the device."""

Progress = Callable[[int, int], None]


def tune(device: Device, progress: Progress, points: Sequence[SamplingSettings] = POINTS) -> ParetoFront:
    """Measure `points` on the device; `progress` receives frames done and total."""
    total, done = LIT_FRAMES + len(points) * (FRAMES + LIT_FRAMES), 0

    def advance(frames: int) -> None:
        progress(done + frames, total)

    room, stage = LitRoom(device, advance), Stage()
    done += LIT_FRAMES
    measured: list[ParetoPoint] = []
    for point in points:
        cost = stage.cost(device, point, advance)
        done += FRAMES
        error_deg = room.error_deg(device, point, advance)
        done += LIT_FRAMES
        measured.append(
            ParetoPoint(point=point, ms=cost.ms, light_error_deg=error_deg, picture_error=cost.picture_error)
        )
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    scene = f"synthetic stage, {SIZE}, two objects; light error: synthetic room under known lights"
    return ParetoFront(device=device.name, version=own_version(), measured=today, scene=scene, points=tuple(measured))


def note_of_front(device: Device) -> str | None:
    """What is to be said of the front that a budget begins with; None where it is the device's own."""
    front = read_front(device.name)
    if front.device == device.name:
        return None
    return (
        f"{device.name} was not measured: what frames cost is learnt while they run, from times of {front.device}; "
        "`probeless tune` measures it, in some minutes"
    )


def lines_of(front: ParetoFront) -> Iterator[str]:
    """A front as a table, fastest point first."""
    best = {point.point for point in front.best()}
    yield f"{front.device}, {front.measured}: median of {FRAMES - SETTLING} frames, {SIZE}, two objects in view"
    yield f"{'':2}{'ms':>8}{'light off by':>14}{'picture off by':>16}  settings"
    for point in sorted(front.points, key=lambda p: p.total_ms):
        mark = "*" if point.point in best else ""
        light, picture = f"{point.light_error_deg:.2f} deg", f"{point.picture_error:.2f}/255"
        yield f"{mark:2}{point.total_ms:8.1f}{light:>14}{picture:>16}  {point.point.settings}"
    yield "*: no faster point is as good. The choice of --budget-ms, --max-light-error and --preset auto."
