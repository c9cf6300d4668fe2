"""What the objective's solver tells of the sources of light, once it has settled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Solved:
    """k sources. It never changes."""

    radiance: NDArray[np.float64]
    """[k, 3] RGB."""
    covariance: NDArray[np.float32]
    """[n, n] of the logarithms of the first n sources' radiance."""
    condition: float
    """Of the objective's curvature, in the 1-norm, with the first n columns of its inverse; infinite before anything is
    solved."""
    mean: float
    """Logarithm of the mean radiance about which sources lie."""
    step: float
    """As of Unknowns."""

    @property
    def known(self) -> int:
        """Sources that have been solved for."""
        return len(self.radiance)

    def covariance_of(self, gradient: NDArray[np.float64]) -> NDArray[np.float64]:
        """[..., m, m] covariance of what changes by `gradient` [..., m, n] with these logarithms."""
        turned = self.covariance @ gradient.swapaxes(-1, -2).astype(np.float32)
        return np.asarray(gradient @ turned.astype(np.float64))
