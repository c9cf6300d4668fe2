"""Light in cells of the sphere for given albedos: its width, colours and covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from server.light.cell_transfer import PoolGrid, PoolWindow
from server.light.light_estimation import ASSUMED_ALBEDO, LightEstimate
from server.light.light_model import ALBEDO_SPREAD, COLOR_PULL, Rows, Solution
from server.maths.lobes import CellEquations, LobeFit, cells_to_sh, fit_lobes, fit_width, spread_of
from server.maths.surfaces import Albedos

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

MODEL_DOUBT = 1.6
"""Of the standard deviation over what the residuals tell of it, as in light_estimation.py; albedos err too."""
_PATCH = 8  # pools along the side of a patch, within which their errors are alike
_VALID_RAD = np.deg2rad(15.0)
_QUANTILE_95 = 2.4477  # radius that holds 95 % of a two-dimensional normal distribution
_LINEAR = [3, 1, 2]  # x, y, z


def solve_cells(
    window: PoolWindow,
    rows: Rows,
    albedos: Albedos,
    weights: Floats,
    solution: Solution,
    slot: int,
    grid: PoolGrid,
    bands: int,
    lit: dict[float, Bools],
    *,
    albedo_known: bool,
) -> tuple[LobeFit, LightEstimate]:
    """The light in cells, of the width that the pictures call for, and what is known of it.

    slot, grid: of the newest frame, whose residuals tell how alike neighbours err. `albedo_known`: the mean albedo is
    what is assumed. lit: as fit_lobes has it, of the last frame.
    """
    to_sh, mean_albedo = cells_to_sh(bands), solution.mean_albedo
    count = window.slots * window.capacity
    place = rows.slots * window.capacity + rows.places
    targets, scaled = np.zeros((count, 4)), np.zeros(count)
    lightness = albedos.lightness
    targets[place, 0] = rows.luminance / lightness - mean_albedo * rows.sent_luminance
    targets[place, 1:] = rows.seen / (lightness[:, None] * albedos.color) - mean_albedo * rows.sent
    scaled[place] = weights * lightness**2
    luminance, *channels = window.equations(targets, scaled)
    light = fit_lobes(luminance, lit)
    radiances, tints = _channels(channels, light)
    is_new = rows.slots == slot
    expected = np.zeros(grid.count)
    shading = rows.columns[is_new] @ solution.amounts
    expected[rows.places[is_new]] = np.sqrt(scaled[place[is_new]]) * (targets[place[is_new], 0] - shading)
    alike = _dependence(expected.reshape(grid.rows, -1))
    noise = alike * luminance.misfit(light.cells) / max(float((rows.weights).sum()), 1e-300)
    root = to_sh @ spread_of(luminance, light, noise)
    std = MODEL_DOUBT * np.sqrt((root**2).sum(axis=1))[:, None] * tints
    if not albedo_known:  # brightness is known as well as the albedo
        std = np.hypot(std, ALBEDO_SPREAD / ASSUMED_ALBEDO * np.abs(to_sh @ radiances))
    vector = (to_sh @ light.cells)[_LINEAR]
    scale = mean_albedo if rows.sent.any() else ASSUMED_ALBEDO
    return light, LightEstimate(
        to_sh @ radiances / scale,
        std / scale if light.cells.any() else None,  # relative to the light: of none it would be nothing
        _condition(luminance.matrix),
        valid=bool(_direction_spread_rad(vector, root[_LINEAR]) <= _VALID_RAD),
    )


def _channels(channels: list[CellEquations], light: LobeFit) -> tuple[Floats, Floats]:
    """Radiances [CELLS, 3] of the light in colour, and the mean colour [3]."""
    radiances, tints = [], []
    for channel in channels:
        along = max(float(light.cells @ channel.matrix @ light.cells), 1e-300)
        tint = max(float(light.cells @ channel.vector) / along, 0.0)
        near, lit = tint * light.cells, light.amounts > 0
        radiances.append(fit_width(channel, light.width_deg, near=near, pull=COLOR_PULL, guess=lit).cells)
        tints.append(tint)
    return np.stack(radiances, axis=1), np.array(tints)


def _dependence(residual: Floats) -> float:
    """How many pools count as one: sums of residuals [rows, cols] over patches scatter so much more than independent
    ones would; at least 1."""
    square = float((residual**2).sum())
    rows, cols = (np.arange(0, size, _PATCH) for size in residual.shape)
    patches = np.add.reduceat(np.add.reduceat(residual, rows, 0), cols, 1)
    return max(1.0, float((patches**2).sum()) / square) if square > 0 else 1.0


def _condition(matrix: Floats) -> float:
    """Of what the normal equations say of the cells, before any prior; infinite if singular."""
    values = np.linalg.eigvalsh(matrix)
    return float(values[-1] / values[0]) if values[0] > values[-1] * 1e-14 and values[-1] > 0 else float("inf")


def _direction_spread_rad(vector: Floats, root: Floats) -> float:
    """Half-angle of the cone that holds the direction of `vector` [3] with 95 %; root [3, k]: of its covariance."""
    length = float(np.linalg.norm(vector))
    if length < 1e-12:
        return float(np.pi)
    across = (np.eye(3) - np.outer(vector, vector) / length**2) @ root
    spread = float(np.sqrt(max(np.linalg.eigvalsh(across @ across.T)[-1], 0.0)))
    return float(np.arctan2(_QUANTILE_95 * spread, length))
