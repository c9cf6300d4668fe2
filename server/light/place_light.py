"""The light that arrives at a place of a room, surfaces included."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from protocol import limits
from server.maths.sh import sh_rotation

VALID_SPREAD_DEG = limits.VALID_SPREAD_DEG
"""A dominant direction counts as known if 90 % of the possible ones are within this angle: a shadow then falls on the
right side of its object."""


@dataclass(frozen=True)
class PlaceLight:
    """Radiance that arrives at one place, in units of the first picture."""

    position: NDArray[np.float64]
    """[3] world metres."""
    sh: NDArray[np.float64]
    """[16, 3] radiance, RGB, world axes; from every direction, scanned surface included."""
    std: NDArray[np.float64] | None
    """[16, 3] one standard deviation; None where unknown."""
    spread_deg: float | None
    """Angle that 90 % of the possible dominant directions are within; None where unknown."""
    valid: bool
    """Whether the dominant direction is known."""
    seen: float | None = None
    """Share of the directions in which photographed surface is met, 0 to 1; None where unknown."""

    def seen_from(self, client_from_room: NDArray[np.float64]) -> PlaceLight:
        """The same in the world of one client; client_from_room: [4, 4] rigid.

        Deviations turn as those of coefficients that err independently.
        """
        turn = client_from_room[:3, :3]
        bands = sh_rotation(turn, round(len(self.sh) ** 0.5))
        std = None if self.std is None else np.sqrt(bands**2 @ self.std**2)
        return replace(self, position=turn @ self.position + client_from_room[:3, 3], sh=bands @ self.sh, std=std)


@dataclass(frozen=True)
class Place:
    """A place whose light is told."""

    of: Literal["view", "place", "object"]
    index: int
    """Among the places of this kind."""
    position: NDArray[np.float64]
    """[3] world metres."""
    name: str | None = None
    """Of the object."""


@dataclass(frozen=True)
class LitPlace:
    """A place and its light."""

    place: Place
    light: PlaceLight

    def seen_from(self, client_from_room: NDArray[np.float64]) -> LitPlace:
        """The same in the world of one client; client_from_room: [4, 4] rigid."""
        light = self.light.seen_from(client_from_room)
        return LitPlace(replace(self.place, position=light.position), light)
