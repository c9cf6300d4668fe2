"""What a session's wishes mean: the presets, and which wishes this server can fulfil."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Wishes
from server.stages.denoise import DenoiseMethod
from server.stages.sampling import PRESETS, Sampling

WHOLE_ROOM_M = 1000.0
"""Visibility rays this long leave any volume."""
THESIS_REACH_M = 0.1

_VOXELS_PER_SIDE = 256
_FINEST_VOXEL_M = 0.004
_TRUSTED_DEPTH_M = 5.0
_MARGIN_M = 0.15
_LEAST_SIDE_M = 0.5

T = TypeVar("T")
Bounds = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Settings:
    """A session's operating point."""

    sampling: Sampling
    lamps: Literal["auto", "on", "off"]
    """Whether lights inside the room are looked for."""
    rays: int
    bands: int
    reach_m: float
    as_thesis: bool
    robustness: frozenset[str]
    """P3: which of `openness`, `normals`, `normals_printed`, `memory`, `outliers` are on."""
    edges: Literal["smooth", "hard"]
    tone_mapping: Literal["auto", "light", "average"]
    """What virtual things' brightness rests on: the light's scale, or the averages of picture and shading."""
    light_color: Literal["estimated", "white"]
    albedo: Literal["constant", "estimated"]
    indirect: Literal["none", "observed"]
    denoise: DenoiseMethod
    denoise_iterations: int
    plan: Literal["needed", "everything"]
    """Whether what would hardly be seen is left out."""
    smooth_depth: bool
    """Whether merged depth is smoothed once more (D''')."""


def read_wishes(wishes: Wishes) -> Settings:
    """Settings for `wishes`. Raises ValueError, one line, for what this server cannot do."""
    reach_m = WHOLE_ROOM_M if wishes.ray_length_m is None else wishes.ray_length_m
    return Settings(
        sampling=sampling_of(wishes),
        lamps="off" if wishes.as_thesis else wishes.lamps,
        rays=wishes.rays,
        bands=wishes.bands,
        reach_m=THESIS_REACH_M if wishes.as_thesis else reach_m,
        as_thesis=wishes.as_thesis,
        robustness=frozenset(wishes.robustness),
        edges=wishes.edges,
        tone_mapping=wishes.tone_mapping,
        light_color=wishes.light_color,
        albedo="constant" if wishes.as_thesis else wishes.albedo,
        indirect="none" if wishes.as_thesis else wishes.indirect,
        denoise=wishes.denoise,
        denoise_iterations=wishes.denoise_iterations,
        plan=wishes.plan,
        smooth_depth=wishes.smooth_depth,
    )


def sampling_of(wishes: Wishes) -> Sampling:
    """How the preset samples transfer, with what is wished otherwise.

    Raises ValueError for a preset that does not exist, and for wishes that mean nothing to it.
    """
    if wishes.preset not in PRESETS:
        raise ValueError(f"preset {wishes.preset!r} is not available: use one of {', '.join(PRESETS)}")
    sampling = PRESETS[wishes.preset]
    if sampling.image_space and (wishes.interleave not in (None, 1) or wishes.visibility_state):
        raise ValueError(f"preset {wishes.preset} traces no rays that --interleave or --visibility-state could spare")
    if not sampling.image_space and wishes.auxiliary_views is not None:
        raise ValueError(f"preset {wishes.preset} looks into no --auxiliary-views: use gr15 or gr15fast")
    return replace(
        sampling,
        stride=_or(wishes.stride, sampling.stride),
        interleave=_or(wishes.interleave, sampling.interleave),
        upsampling=_or(wishes.upsampling, sampling.upsampling),
        visibility_state=_or(wishes.visibility_state, sampling.visibility_state),
        views=_or(wishes.auxiliary_views, sampling.views),
    )


def _or(wished: T | None, usual: T) -> T:
    return usual if wished is None else wished


def bounds_seen(camera: CameraModel, frame: RgbdFrame, world_from_camera: NDArray[np.float64]) -> Bounds:
    """World box around what one frame sees within 5 m, for a live session that names no volume.

    Raises ValueError where the frame has no depth.
    """
    depth = frame.depth[::4, ::4] * camera.depth_scale_m
    v, u = np.nonzero((depth > 0) & (depth <= _TRUSTED_DEPTH_M) & (frame.depth[::4, ::4] != 65535))
    if len(u) < 16:
        raise ValueError("the first frame has no depth to place a volume around: point the camera at the scene")
    z = depth[v, u]
    lens, world_from_depth = camera.depth_lens, world_from_camera @ camera.color_from_depth
    points = np.stack([(4 * u - lens.cx) / lens.fx * z, (4 * v - lens.cy) / lens.fy * z, z], axis=1)
    points = points @ world_from_depth[:3, :3].T + world_from_depth[:3, 3]
    low, high = np.percentile(points, (1, 99), axis=0)
    center, half = (low + high) / 2, np.maximum((high - low) / 2 + _MARGIN_M, _LEAST_SIDE_M / 2)
    x0, y0, z0, x1, y1, z1 = (float(value) for value in (*(center - half), *(center + half)))
    return x0, y0, z0, x1, y1, z1


def default_voxel_m(bounds: Bounds) -> float:
    """Voxel side for `bounds`: the longest side over 256, 4 mm at least."""
    return max(_FINEST_VOXEL_M, max(bounds[axis + 3] - bounds[axis] for axis in range(3)) / _VOXELS_PER_SIDE)
