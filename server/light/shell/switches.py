"""What of the model is on (thesis 5.2, 5.4 and 7.1)."""

from __future__ import annotations

from dataclasses import dataclass

from server.maths.normals import NormalWeights


@dataclass(frozen=True)
class Switches:
    """Settings of the one model."""

    albedos: bool = True
    """Surfaces have albedos of their own."""
    indirect: bool = True
    """Surfaces send light to one another. Only for light from beyond the scan: a room without it is no room."""
    normals: NormalWeights = "none"
    """Weights by the distribution of normals (eq. 5.7)."""
    memory: bool = True
    """Earlier frames count (5.4)."""
    outliers: bool = True
    """Patches that fit badly count less."""
