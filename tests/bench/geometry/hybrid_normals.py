"""Normals of the hybrid geometry buffer beside those of the measured depth, against the truth."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from client.sources.frame_source import Source
from client.sources.volume import default_volume, default_voxel
from client.synthetic.source import SyntheticSource, open_synthetic
from server.opencl.device import Device
from server.volume.bounds import Bounds
from tests.bench.geometry.noise import plane_normals
from tests.bench.geometry.normals import BufferNormals, TrueNormals, measure_normals
from tests.bench.report.finished import Part

HAND_FRAMES = 30
HAND_THERE = range(8, 24)
"""Frames in which the synthetic hand is before the table."""
_KINDS = ((True, "noisy depth", ">= 0"), (False, "exact depth", ""))
"""Noise or not, words, goal. Exact depth needs no smoothing: a row without a goal says what smoothing costs there."""


def add_still_rows(
    part: Part, device: Device, clean: Source, noisy: Source, volume_m: Bounds, voxel_m: float, count: int
) -> None:
    """The noisy sequence, truth from the clean one: `count` frames fused, of the later half every tenth measured."""

    def truth(index: int) -> TrueNormals:
        normals, known = plane_normals(clean.camera, clean[index].depth * clean.camera.depth_scale_m)
        return TrueNormals(normals, {"still": known})

    measured = range(count // 2, count, 10)
    found = measure_normals(device, noisy, truth, volume_m, voxel_m, range(count), measured)
    part.sizes["frames fused for the buffer's normals"] = count
    _add_rows(part, "normals of noisy depth, still room", found["still"], ">= 0")


def add_moving_rows(part: Part, device: Device, step: int, say: Callable[[str], None]) -> None:
    """A hand over a table, with the truth of its renderer: every `step`-th frame in which it is there."""
    measured = HAND_THERE[::step]
    part.sizes["frames of the moving hand's normals"] = len(measured)
    for noise, words, goal in _KINDS:
        source = open_synthetic(f"synthetic:hand?frames={HAND_FRAMES}&noise={int(noise)}")
        say(f"normals of {source.name}, {words}")

        volume_m = default_volume(source, range(HAND_FRAMES))
        found = measure_normals(
            device,
            source,
            partial(_of_hand, source),
            volume_m,
            default_voxel(volume_m),
            range(HAND_THERE.stop),
            measured,
        )
        _add_rows(part, f"normals of {words}, moving hand", found["hand"], goal)


def _of_hand(source: SyntheticSource, index: int) -> TrueNormals:
    exact = source.truth(index)
    return TrueNormals(exact.normals.astype(float) @ source.pose(index)[:3, :3], {"hand": exact.dynamic})


def _add_rows(part: Part, name: str, found: BufferNormals, goal: str) -> None:
    for words, error in (("raw", found.raw), ("hybrid buffer", found.hybrid)):
        part.add(f"{name}, {words}: median error", error.median_deg, "deg")
        part.add(f"{name}, {words}: mean error", error.mean_deg, "deg")
    part.add(f"{name}: better by hybrid buffer", found.gained_deg, "deg", goal)
    part.add(f"{name}: pixels without a normal in the buffer", 100 * found.missing, "%")
