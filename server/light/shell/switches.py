"""Which parts of the model are used (thesis 5.2, 5.4 and 7.1)."""

from __future__ import annotations

from dataclasses import dataclass

from server.maths.normals import NormalWeights


@dataclass(frozen=True)
class Switches:
    """Settings of the one model."""

    albedos: bool = True
    """Surfaces have albedos of their own."""
    indirect: bool = True
    """Surfaces light one another. Only the light from beyond the scan can be solved without that."""
    normals: NormalWeights = "none"
    """Weights by the distribution of normals (eq. 5.7)."""
    memory: bool = True
    """Evidence of earlier frames is kept (5.4)."""
    outliers: bool = True
    """Patches with large residuals count less."""
