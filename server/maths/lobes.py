"""Light as non-negative combinations of smooth lobes: what keeps an estimate from a room finite, positive and as simple
as the pictures allow.

The sphere is cut into CELLS cells of one radiance each; a family of lobes of one width spans smooth functions of them.
A room fixes light from wide lobes well and from narrow ones badly, so the widest family is taken that explains the
pictures: a narrower one must leave clearly less.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

from server.maths.nonnegative_qp import solve_nonnegative
from server.maths.sh import sh_basis, spherical_fibonacci

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

CELLS = 256
CELL_SR = 4 * np.pi / CELLS
WIDTHS_DEG = (35.0, 25.0, 18.0, 12.0, 8.0)
"""Standard deviations of the families' lobes, widest first."""
LEAST_GAIN = 0.8
"""A narrower family must leave less than this share of the residual's variance, once for every step in width."""
RIDGE = 1e-3
"""Of the mean diagonal: the least prior that keeps what no surface sees finite."""
_LOBES_PER_WIDTH = 1.5  # centres for every square width of the sphere
_FEWEST_LOBES = 24
_LEAST_KNOWN = 1e-12  # of the best known: rounding


@cache
def cell_directions() -> Floats:
    """[CELLS, 3] unit, world axes."""
    return spherical_fibonacci(CELLS)


@cache
def cells_to_sh(bands: int) -> Floats:
    """[bands^2, CELLS]: coefficients of radiances of the cells."""
    return np.ascontiguousarray(sh_basis(cell_directions(), bands).T * CELL_SR)


@cache
def lobe_family(width_deg: float) -> Floats:
    """[CELLS, lobes]: radiances of the cells, each lobe with sum 1."""
    width = np.deg2rad(width_deg)
    count = int(np.clip(np.ceil(4 * np.pi / width**2 * _LOBES_PER_WIDTH), _FEWEST_LOBES, CELLS))
    apart = np.arccos(np.clip(cell_directions() @ spherical_fibonacci(count).T, -1, 1))
    lobes = np.exp(-0.5 * (apart / width) ** 2)
    return np.asarray(lobes / lobes.sum(axis=0))


@cache
def _lobes_from_cells(width_deg: float) -> Floats:
    """[lobes, CELLS]: least squares."""
    lobes = lobe_family(width_deg)
    return np.asarray(np.linalg.pinv(lobes, rcond=float(np.finfo(np.float64).eps) * max(lobes.shape)))


@dataclass(frozen=True)
class LobeFit:
    """A non-negative light."""

    width_deg: float
    cells: Floats
    """[CELLS] radiance."""
    misfit: float
    """Weighted sum of squares that is left."""
    amounts: Floats
    """[lobes] of its family."""


@dataclass(frozen=True)
class CellEquations:
    """Sums over samples of one channel: y = M x with x the cells' radiances."""

    matrix: Floats
    """[CELLS, CELLS] sum w m m^T."""
    vector: Floats
    """[CELLS] sum w m y."""
    energy: float
    """Sum w y^2."""
    projected: dict[float, Floats] = field(default_factory=dict, repr=False, compare=False)
    """`under` so far; equations of one matrix may share it."""

    def under(self, width_deg: float) -> Floats:
        """[lobes, lobes] `matrix` of the amounts of one family. Multiplied as float32, as what is summed was."""
        if width_deg not in self.projected:
            lobes = lobe_family(width_deg).astype(np.float32)
            self.projected[width_deg] = (lobes.T @ (self.matrix.astype(np.float32) @ lobes)).astype(np.float64)
        return self.projected[width_deg]

    def misfit(self, cells: Floats) -> float:
        """What radiances [CELLS] leave of the energy."""
        left = self.energy + cells @ (self.matrix @ cells - 2 * self.vector)
        return max(float(left), 1e-12 * self.energy)


def fit_lobes(equations: CellEquations, lit: dict[float, Bools] | None = None) -> LobeFit:
    """The simplest light that explains the sums: see the module.

    lit: of each width a guess of which lobes [lobes] are lit, as of a similar light; renewed. It only saves time.
    """
    lit = {} if lit is None else lit

    def fitted(width: float) -> LobeFit:
        fit = fit_width(equations, width, guess=lit.get(width))
        lit[width] = fit.amounts > 0
        return fit

    chosen = fitted(WIDTHS_DEG[0])
    allowed = 1.0
    for width in WIDTHS_DEG[1:]:
        allowed *= LEAST_GAIN
        narrower = fitted(width)
        if narrower.misfit < allowed * chosen.misfit:
            chosen, allowed = narrower, 1.0
    return chosen


def fit_width(
    equations: CellEquations,
    width_deg: float,
    near: Floats | None = None,
    pull: float = 0.0,
    guess: Bools | None = None,
) -> LobeFit:
    """The best light of one family; drawn to radiances `near` [CELLS] by `pull` times the ridge, if they are given.

    guess: which lobes [lobes] may be lit. It saves time and changes nothing.
    """
    lobes = lobe_family(width_deg)
    matrix = equations.under(width_deg)
    count = len(matrix)
    ridge = RIDGE * max(float(np.trace(matrix)) / count, 1e-300)
    vector = lobes.T @ equations.vector
    if near is not None:
        vector = vector + ridge * pull * (_lobes_from_cells(width_deg) @ near)
    regular = matrix + ridge * (1.0 + pull) * np.eye(count)
    amounts, _ = solve_nonnegative(regular, vector, guess)
    cells = lobes @ amounts
    return LobeFit(width_deg, cells, equations.misfit(cells), amounts)


def spread_of(equations: CellEquations, fit: LobeFit, noise: float) -> Floats:
    """[CELLS, lobes]: its outer square is the cells' covariance, where `noise` is the variance of an observation.

    The prior lets any lobe be as bright as the light's are on average, so what no sample sees is as uncertain as that.
    That light is not negative is left out: it would say less of what is dark.
    """
    lobes = lobe_family(fit.width_deg)
    prior = noise / max(float((fit.amounts**2).mean()), 1e-300)
    information = equations.under(fit.width_deg) + prior * np.eye(lobes.shape[1])
    known, ways = np.linalg.eigh(information)
    known = np.maximum(known, _LEAST_KNOWN * known.max())  # sums of float32 may say less than nothing of some
    return np.asarray(lobes @ (ways * np.sqrt(noise / known)))
