"""Every knob and the values it is turned to, the others being as usual (REG4, 81 rays)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from server.transfer.sampling import PRESETS

Settings = dict[str, Any]

KNOBS: dict[str, tuple[Settings, ...]] = {
    "preset": tuple({"preset": name} for name in PRESETS),
    "rays": tuple({"rays": n} for n in (16, 25, 49, 121, 169, 324)),
    "stride": tuple({"stride": n} for n in (1, 2, 8, 12, 16)),
    "ray_length_m": tuple({"ray_length_m": m} for m in (0.0, 0.05, 0.1, 0.2, 0.5, 1.0)),
    "bands": tuple({"bands": n} for n in (2, 3, 5, 6)),
    "voxel_m": tuple({"voxel_m": m} for m in (0.006, 0.012, 0.02, 0.03)),
    "interleave": tuple({"interleave": n} for n in (2, 4, 8)),
    "visibility_state": ({"visibility_state": True}, {"visibility_state": True, "ray_length_m": 0.1}),
    "ssdo_samples": tuple({"preset": "gr15fast", "rays": n} for n in (25, 49, 81, 169)),
    "auxiliary_views": tuple({"preset": "gr15fast", "auxiliary_views": n} for n in (64, 256, 1024, 2048)),
    "denoise": ({"denoise": "bilateral"}, {"denoise": "tv_l1"}),
    "upsampling": ({"upsampling": "bicubic"},),
    "smooth_depth": ({"smooth_depth": False},),
    "model": (
        {"albedo": "constant", "indirect": "none"},
        {"albedo": "estimated", "indirect": "none"},
        {"albedo": "estimated", "indirect": "observed"},
    ),
    "preset_and_rays": tuple(
        {"preset": preset, "rays": rays}
        for preset in ("reg8", "reg4", "gr15fast", "art4", "rm")
        for rays in (25, 49, 169)
    ),
}
QUICK = {
    "preset": ("rm", "reg4", "reg8", "art4", "gr15", "gr15fast"),
    "rays": (25, 169),
    "stride": (8,),
    "ray_length_m": (0.1,),
    "preset_and_rays": (),
}
"""With --quick, these values alone; of knobs that are not named, the first."""


def points(quick: bool) -> Iterator[tuple[str, Settings]]:
    """The usual one first, then every knob's; none twice."""
    done: list[Settings] = [{}]
    yield "usual", {}
    for knob, values in KNOBS.items():
        chosen = values if not quick else _few(knob, values)
        for settings in chosen:
            if settings not in done:
                done.append(settings)
                yield knob, settings


def _few(knob: str, values: tuple[Settings, ...]) -> tuple[Settings, ...]:
    if knob not in QUICK:
        return values[:1]
    return tuple(settings for settings in values if settings.get(knob) in QUICK[knob])
