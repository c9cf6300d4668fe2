"""What the objective of a room's light is minimised over, and how far steps towards its minimum go."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from server.light.shell import weights
from server.light.shell.evidence import NODES
from server.light.shell.level import LOGIT
from server.light.shell.patches import MOST_PATCHES
from server.light.shell.solved import Solved
from server.light.shell.sources import Sources
from server.light.shell.switches import Switches

LEAST_RELAXATION = 0.05
"""Least share of a Gauss-Newton step that is taken. It falls while steps turn back, and rises again, by TURNING_BACK
and GOING_ON: the albedo that makes a surface white and the chroma that tells its material follow the light, and are
not in the step's derivatives."""
TURNING_BACK, GOING_ON = 0.7, 1.1
ALL_NODES = np.arange(NODES * NODES)

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]


def _empty() -> Floats:
    return np.zeros(0)


@dataclass
class Unknowns:
    """What the objective is minimised over, and its curvature at the last step."""

    z: Floats = field(default_factory=_empty)
    """[k] log radiance of sources; of saturated ones, of their relative excess."""
    chroma: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    """[k, 2]."""
    materials: Floats = field(default_factory=lambda: np.full(len(ALL_NODES), LOGIT))
    """[nodes] logit of albedo."""
    offsets: Floats = field(default_factory=lambda: np.zeros(MOST_PATCHES))
    """[MOST_PATCHES] o of the surface that each patch is part of."""
    middle: float = LOGIT
    """m, about which the materials lie."""
    mean: float = 0.0
    """Log of the mean radiance about which sources lie: of what pictures show, or of the light where the mean albedo is
    given."""
    radiance: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """[k, 3] RGB of the sources."""
    curvature: Singles = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    """[k + albedos] squared: half the second derivative of the objective at the last step, sources first."""
    factor: tuple[Singles, bool] = field(default_factory=lambda: (np.zeros((0, 0), np.float32), False))
    """Of the curvature (Cholesky), and whether it is the lower triangle."""
    step: float = float("inf")
    """By how much the last step changed the logarithm of what patches receive, root mean square."""

    most_relaxation: float = 1.0
    """Greatest share of a step to take."""
    relaxation: float = 1.0
    """Share of the last step that was taken, of those that are at most `most_relaxation`."""
    last: Floats = field(default_factory=_empty)
    """[k] the last whole step of z."""

    @property
    def known(self) -> int:
        """Sources that have been solved for."""
        return len(self.z)

    def relax(self, change: Floats) -> float:
        """The share of the step `change` [k] of z to take."""
        turns_back = float(change[: len(self.last)] @ self.last) < 0
        factor = TURNING_BACK if turns_back else GOING_ON
        self.relaxation = float(np.clip(self.relaxation * factor, LEAST_RELAXATION, self.most_relaxation))
        self.last = change.copy()
        return self.relaxation

    def forget(self, share: float, sources: Sources, switches: Switches) -> None:
        """Go that share of the way back to the prior. Steps after it are whole ones again, as far as they may be."""
        self.z += share * (self.prior(sources)[: self.known] - self.z)
        self.materials += share * (given_logit(has_materials=switches.albedos) - self.materials)
        self.relaxation, self.last = self.most_relaxation, _empty()

    def prior(self, sources: Sources) -> Floats:
        """[k] n, but for floor that was not scanned."""
        return np.asarray(np.where(sources.is_saturated, 0.0, self.mean) + sources.offset)

    def keep(self, curvature: Singles) -> None:
        """The curvature of this step."""
        self.curvature = curvature
        # Transposed, it is the same and in LAPACK's order, which saves a copy.
        self.factor = cho_factor(self.curvature.T, check_finite=False)

    def solve(self, right: Floats) -> Floats:
        """[k + albedos] the change to which the slope `right` leads by the curvature."""
        return cho_solve(self.factor, right.astype(np.float32), check_finite=False).astype(np.float64)  # type: ignore[no-any-return]

    def solved(self, count: int | None = None) -> Solved:
        """What it tells of all sources, with the covariance of the first `count`; None: of all."""
        if self.known == 0:
            return Solved(np.zeros((0, 3)), np.zeros((0, 0), np.float32), float("inf"), self.mean, self.step)
        count = self.known if count is None else count
        right = np.eye(len(self.curvature), count, dtype=np.float32)
        inverse = cho_solve(self.factor, right, check_finite=False)
        condition = _norm(self.curvature) * _norm(inverse)  # LAPACK's estimate has other last bits in each run
        return Solved(self.radiance, inverse[:count], condition, self.mean, self.step)


def _norm(matrix: Singles) -> float:
    """The 1-norm."""
    return float(np.abs(matrix).sum(axis=0).max())


def given_logit(*, has_materials: bool) -> float:
    """Of the mean albedo where it is not found."""
    given = weights.DISTANT_ALBEDO if has_materials else weights.GIVEN_ALBEDO
    return float(np.log(given / (1 - given)))
