"""Lights as a pipeline tells them."""

from __future__ import annotations

import msgspec

from protocol.messages import Light


def light_of(frame: int, **changes: object) -> Light:
    light = Light(
        frame=frame,
        timestamp_s=frame / 30,
        sh=tuple((0.1 * i, 1 / 3, 0.0) for i in range(16)),
        sh_std=tuple((0.01, None, 0.5) for _ in range(16)),
        sh_webxr=tuple(float(i) for i in range(27)),
        dominant_direction=(0.6, 0.8, 0.0),
        dominant_intensity=1.25,
        condition=None,
        valid=False,
    )
    return msgspec.structs.replace(light, **changes)
