"""Converts the estimated light to the message that the wire and `light.jsonl` contain."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from protocol.messages import DirectedLight, Lamp, Light
from server.light.light_estimation import LightEstimate
from server.maths.dominant import dominant_lights
from server.maths.emitters import Emitter
from server.maths.sh import dominant_direction, dominant_intensity, rotate_sh, webxr_floats

_WIRE_COEFFICIENTS = 16


def light_message(
    frame: int,
    timestamp_s: float,
    estimate: LightEstimate,
    webxr_from_world: NDArray[np.float64],
    lamps: tuple[Emitter, ...] = (),
    exposure: float = 1.0,
) -> Light:
    """Message of `estimate` and lamps in the world; bands not estimated are zeros with unknown deviation.

    exposure: of the frame, by which the light, told in units of the first picture, becomes one of the frame's own.
    """
    sh, std = exposure * estimate.sh, None if estimate.std is None else exposure * estimate.std
    direction = dominant_direction(sh)
    return Light(
        frame=frame,
        timestamp_s=timestamp_s,
        sh=tuple(_rgb(sh[i]) if i < len(sh) else (0.0, 0.0, 0.0) for i in range(_WIRE_COEFFICIENTS)),
        sh_all=tuple(_rgb(row) for row in sh) if len(sh) > _WIRE_COEFFICIENTS else None,
        sh_std=tuple(
            _rgb(std[i]) if std is not None and i < len(std) else (None, None, None) for i in range(_WIRE_COEFFICIENTS)
        ),
        sh_webxr=webxr_floats(sh, webxr_from_world),
        dominant_direction=_rgb(direction),
        dominant_intensity=dominant_intensity(sh),
        dominant_lights=tuple(
            DirectedLight(
                direction=_rgb(light.direction),
                irradiance=_rgb(exposure * light.irradiance),
                spread_deg=math.degrees(light.spread_rad),
            )
            for light in dominant_lights(estimate.sh)  # as split_light asks: found once
        ),
        lamps=tuple(_lamp(lamp, exposure) for lamp in lamps),
        exposure=exposure,
        up=_rgb(webxr_from_world[1]),
        condition=estimate.condition if math.isfinite(estimate.condition) else None,
        valid=estimate.valid,
    )


def seen_from(
    client_from_room: NDArray[np.float64], estimate: LightEstimate, lamps: tuple[Emitter, ...]
) -> tuple[LightEstimate, tuple[Emitter, ...]]:
    """The light of a room in the world of one client; client_from_room: [4, 4] rigid.

    Deviations turn as those of coefficients that err apart from one another.
    """
    turn = client_from_room[:3, :3]
    bands = rotate_sh(np.eye(len(estimate.sh)), turn)
    std = None if estimate.std is None else np.sqrt(bands**2 @ estimate.std**2)
    moved = tuple(
        replace(
            lamp,
            position=turn @ lamp.position + client_from_room[:3, 3],
            position_covariance=turn @ lamp.position_covariance @ turn.T,
        )
        for lamp in lamps
    )
    return replace(estimate, sh=bands @ estimate.sh, std=std), moved


def _lamp(lamp: Emitter, exposure: float) -> Lamp:
    return Lamp(
        position_m=_rgb(lamp.position),
        position_std_m=_rgb(np.sqrt(np.diag(lamp.position_covariance))),
        intensity=_rgb(exposure * lamp.intensity),
        intensity_std=_rgb(exposure * lamp.intensity_std),
        share=lamp.share,
    )


def _rgb(row: NDArray[np.float64]) -> tuple[float, float, float]:
    return float(row[0]), float(row[1]), float(row[2])
