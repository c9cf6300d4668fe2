"""Resolves a session's wishes into settings, and refuses unsupported ones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeVar

from protocol.messages import Wishes
from server.input.denoise import DenoiseMethod
from server.transfer.sampling import PRESETS, Sampling

WHOLE_ROOM_M = 1000.0
"""Visibility rays of this length leave any volume."""
THESIS_REACH_M = 0.1

T = TypeVar("T")


@dataclass(frozen=True)
class Settings:
    """Resolved settings of a session."""

    sampling: Sampling
    lamps: Literal["auto", "on", "off"]
    """Whether to search for lights inside the room."""
    rays: int
    bands: int
    ray_length_m: float
    as_thesis: bool
    robustness: frozenset[str]
    """P3: enabled measures, of `openness`, `normals`, `normals_printed`, `memory`, `outliers`."""
    edges: Literal["smooth", "hard"]
    tone_mapping: Literal["auto", "light", "average"]
    """Brightness of virtual objects: by the scale of the light, or by the averages of picture and shading; `auto`, only
    as in the thesis: by the averages where the light is estimated."""
    light_color: Literal["estimated", "white"]
    albedo: Literal["constant", "estimated"]
    indirect: Literal["none", "observed"]
    denoise: DenoiseMethod
    denoise_iterations: int
    plan: Literal["needed", "everything"]
    """Whether to leave out effects whose change is bounded by less than a display unit."""
    has_caches: bool
    """Whether what belongs to places of the world is kept from frame to frame."""
    smooth_depth: bool
    """Whether merged depth is filtered by the last median (D''')."""


def read_wishes(wishes: Wishes) -> Settings:
    """Settings for `wishes`. Raises ValueError, one line, for unsupported wishes."""
    ray_length_m = WHOLE_ROOM_M if wishes.ray_length_m is None else wishes.ray_length_m
    return Settings(
        sampling=sampling_of(wishes),
        lamps="off" if wishes.as_thesis else wishes.lamps,
        rays=wishes.rays,
        bands=wishes.bands,
        ray_length_m=THESIS_REACH_M if wishes.as_thesis else ray_length_m,
        as_thesis=wishes.as_thesis,
        robustness=frozenset(wishes.robustness),
        edges=wishes.edges,
        tone_mapping=wishes.tone_mapping if wishes.as_thesis or wishes.tone_mapping != "auto" else "light",
        light_color=wishes.light_color,
        albedo="constant" if wishes.as_thesis else wishes.albedo,
        indirect="none" if wishes.as_thesis else wishes.indirect,
        denoise=wishes.denoise,
        denoise_iterations=wishes.denoise_iterations,
        plan=wishes.plan,
        has_caches=wishes.cache == "on" and wishes.plan != "everything" and not wishes.as_thesis,
        smooth_depth=wishes.smooth_depth,
    )


def sampling_of(wishes: Wishes) -> Sampling:
    """Sampling of the preset, with the wishes that override it.

    Raises ValueError for an unknown preset, and for wishes that it does not support.
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


def _or(value: T | None, default: T) -> T:
    return default if value is None else value
