"""Converts the estimated light to the message that the wire and `light.jsonl` contain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.messages import ArrivingLight, DirectedLight, Lamp, Light, RgbOrNull
from server.light.light_estimation import LightEstimate
from server.light.place_light import VALID_SPREAD_DEG, LitPlace
from server.maths.emitters import Emitter
from server.maths.sh import dominant_direction, dominant_intensity, sh_rotation, webxr_floats

_WIRE_COEFFICIENTS = 16


@dataclass(frozen=True)
class LightPlaces:
    """Where a light is told."""

    view: NDArray[np.float64] | None = None
    """[3] world metres: the middle of what the frame sees; None before a frame was placed."""
    lit: Sequence[LitPlace] = ()

    def seen_from(self, client_from_room: NDArray[np.float64]) -> LightPlaces:
        """The same in the world of one client; client_from_room: [4, 4] rigid."""
        view = None if self.view is None else client_from_room[:3, :3] @ self.view + client_from_room[:3, 3]
        return LightPlaces(view, [lit.seen_from(client_from_room) for lit in self.lit])


def light_message(
    frame: int,
    timestamp_s: float,
    estimate: LightEstimate,
    webxr_from_world: NDArray[np.float64],
    lamps: tuple[Emitter, ...] = (),
    exposure: float = 1.0,
    places: LightPlaces | None = None,
) -> Light:
    """Message of `estimate`, lamps and places in the world; bands not estimated are zeros with unknown deviation.

    exposure: of the frame, by which the light, told in units of the first picture, becomes one of the frame's own.
    """
    places = places or LightPlaces()
    sh = exposure * estimate.sh
    return Light(
        frame=frame,
        timestamp_s=timestamp_s,
        **_coefficients(estimate.sh, estimate.std, exposure, webxr_from_world),
        sh_all=tuple(_rgb(row) for row in sh) if len(sh) > _WIRE_COEFFICIENTS else None,
        dominant_lights=tuple(
            DirectedLight(
                direction=_rgb(light.direction),
                irradiance=_rgb(exposure * light.irradiance),
                spread_deg=math.degrees(light.spread_rad),
            )
            for light in estimate.dominant_lights
        ),
        lamps=tuple(_lamp(lamp, exposure) for lamp in lamps),
        exposure=exposure,
        up=_rgb(webxr_from_world[1]),
        condition=estimate.condition if math.isfinite(estimate.condition) else None,
        valid=_is_valid(estimate.spread_deg, estimate.valid),
        spread_deg=estimate.spread_deg,
        position=None if places.view is None else _rgb(places.view),
        at=tuple(_arriving(lit, exposure, webxr_from_world) for lit in places.lit),
    )


def _arriving(lit: LitPlace, exposure: float, webxr_from_world: NDArray[np.float64]) -> ArrivingLight:
    place, light = lit.place, lit.light
    return ArrivingLight(
        of=place.of,
        index=place.index,
        position=_rgb(light.position),
        **_coefficients(light.sh, light.std, exposure, webxr_from_world),
        spread_deg=light.spread_deg,
        valid=_is_valid(light.spread_deg, light.valid),
        seen=light.seen,
        object=place.name,
    )


def _coefficients(
    sh: NDArray[np.float64], std: NDArray[np.float64] | None, exposure: float, webxr_from_world: NDArray[np.float64]
) -> dict[str, Any]:
    """Fields of `Light` and `ArrivingLight`: coefficients and what follows from them, in units of the frame's image."""
    sh = exposure * sh
    known = () if std is None else tuple(_rgb(exposure * row) for row in std[:_WIRE_COEFFICIENTS])
    unknown: RgbOrNull = (None, None, None)
    return {
        "sh": tuple(_rgb(sh[i]) if i < len(sh) else (0.0, 0.0, 0.0) for i in range(_WIRE_COEFFICIENTS)),
        "sh_std": (*known, *(unknown,) * (_WIRE_COEFFICIENTS - len(known))),
        "sh_webxr": webxr_floats(sh, webxr_from_world),
        "dominant_direction": _rgb(dominant_direction(sh)),
        "dominant_intensity": dominant_intensity(sh),
    }


def _is_valid(spread_deg: float | None, otherwise: bool) -> bool:
    """`otherwise`: what an estimator says that gives no spread."""
    return otherwise if spread_deg is None else spread_deg <= VALID_SPREAD_DEG


def seen_from(
    client_from_room: NDArray[np.float64], estimate: LightEstimate, lamps: tuple[Emitter, ...]
) -> tuple[LightEstimate, tuple[Emitter, ...]]:
    """The light of a room in the world of one client; client_from_room: [4, 4] rigid.

    Deviations turn as those of coefficients that err apart from one another.
    """
    turn = client_from_room[:3, :3]
    bands = sh_rotation(turn, round(len(estimate.sh) ** 0.5))
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
