"""By how much the hybrid geometry buffer's normals are better than those of the measured depth, against the truth."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from server.opencl.device import Device
from server.volume.bounds import Bounds
from tests.bench.geometry.hybrid import run_geometry, vectors
from tests.bench.geometry.noise import NormalError, depth_normals
from tests.bench.truth.hand_frames import Frames

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class TrueNormals:
    """Exact normals of one frame."""

    normals: Floats
    """[h, w, 3] unit, camera axes, towards the camera."""
    groups: Mapping[str, Bools]
    """Pixels [h, w] to be reported together, by name; where `normals` hold."""


@dataclass(frozen=True)
class BufferNormals:
    """Normals of the same pixels by differences of the measured depth, and of the geometry buffer."""

    raw: NormalError
    hybrid: NormalError
    missing: float
    """Share of the pixels with depth that have no normal in the buffer."""

    @property
    def gained_deg(self) -> float:
        """Degrees by which the median is better."""
        return self.raw.median_deg - self.hybrid.median_deg


def measure_normals(
    device: Device,
    source: Frames,
    truth: Callable[[int], TrueNormals],
    volume_m: Bounds,
    voxel_m: float,
    frames: range,
    measured: range,
) -> dict[str, BufferNormals]:
    """Fuse `frames` of `source`; of those that are in `measured`, the errors of each group that the truth names."""
    errors: dict[str, list[Floats]] = defaultdict(list)
    for engine, index, seen in run_geometry(device, source, volume_m, voxel_m, frames):
        if index not in measured:
            continue
        true = truth(index)
        raw = depth_normals(source.camera, engine.download(seen.measurement.depth_m))
        _, normals = vectors(engine, seen.surface)
        hybrid = normals[..., :3] @ seen.volume_from_camera[:3, :3]  # volume's axes to the camera's: the transpose's
        for name, group in true.groups.items():
            chosen = group & raw.any(axis=-1)
            angles = [_angles_deg(kind[chosen], true.normals[chosen]) for kind in (raw, hybrid)]
            errors[name].append(np.stack([*angles, normals[chosen][:, 3]]))
    return {name: _summary(np.concatenate(parts, axis=1)) for name, parts in errors.items()}


def _angles_deg(normals: Floats, truth: Floats) -> Floats:
    degrees: Floats = np.degrees(np.arccos(np.clip((normals * truth).sum(axis=-1), -1, 1)))
    return degrees


def _summary(errors: Floats) -> BufferNormals:
    """errors: [3, n] angles of raw and hybrid normals, and whether the latter is there."""
    there = errors[2] > 0
    raw, hybrid = (
        NormalError(float(np.median(kind[there])), float(kind[there].mean()))
        if there.any()
        else NormalError(90.0, 90.0)
        for kind in errors[:2]
    )
    return BufferNormals(raw, hybrid, float(1 - there.mean()) if there.size else 0.0)
