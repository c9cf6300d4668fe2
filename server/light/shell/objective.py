"""The one objective of a room's light, and a Gauss-Newton step towards its minimum.

Patch p of surface shows, for the mean logarithm of the channels y and two chroma coordinates q (`LOG_CHROMA`),

    y_p = log(sum_k A_pk x_k + h_p) + log s(B_p m + o_f(p)) + d_r(p) + e_p                     (1)
    q_p = sum_k T_pk u_k + (h_p / E_p) q(h_p) + c_r(p) + e'_p,    T_pk = A_pk x_k / E_p        (2)

with A_pk the share of p's cosine-weighted hemisphere that is unknown cell k, x_k = exp(z_k) its radiance (saturated
cells: x_k = b_k (1 + exp(z_k)), b_k what the clipped picture shows), h_p what known surface brings, E_p the sum in
(1), u_k the chroma of cell k. s is the logistic function, so no albedo exceeds 1; B_p m is the logit of the albedo of
materials, bilinear on a grid over the chroma of albedo, and o_f that of surface f (a floor, a wall) besides; d_r and
c_r are what region r of surface has besides, eliminated exactly. Minimised is

    sum_p huber(e_p / S_p) + sum_k ((z_k - n_k) / s_k)^2 + sum_(k,l) rho(z_k - z_l)
    + sum_g ((m_g - m) / s_m)^2 + sum_f (o_f / s_o)^2 + sum_r (d_r / s_d)^2
    + sum_p |e'_p / S'_p|^2 + sum_k |(u_k - t) / s_u|^2 + sum_(k,l) c |u_k - u_l|^2 + |t / s_t|^2 + sum_r |c_r / s_c|^2

over neighbouring cells (k,l) of the shell. A patch that is clipped only counts where (1) is below what it shows.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from server.light.shell.patches import MOST_WEIGHT, Patches
from server.light.shell.shell import CELLS, Shell, neighbours
from server.light.shell.transport import COLUMNS, Transport

MEAN_ALBEDO = 0.6
"""Reflectance about which materials lie: walls and ceilings are mostly bright. It sets the light's level."""
ALBEDO_SPREAD = 0.8
"""Standard deviation of the logit of a material's albedo: two thirds lie from .4 to .77, none above 1."""
MATERIAL_CHROMA = 0.4
"""Spacing of the grid of materials over log chroma: orange wood and white paint are two nodes apart."""
PATCH_NOISE = 0.1
"""Standard deviation of a patch's log radiance: transfer by 128 rays, normals, what is not diffuse."""
REGION_SPREAD = 0.15
"""Standard deviation of a region's log albedo about its material's: gradients within a region are told from it."""
SURFACE_M, SURFACE_SPREAD = 0.3, 0.5
"""Spacing of the planes that count as one surface (a floor, a wall), and the standard deviation of its logit about its
material's: carpets are dark and walls are bright though both are grey."""
HUBER = 1.5
"""Deviations of the noise from which a patch counts as an outlier."""
CELL_LOW, CELL_HIGH, CELL_HIDDEN = 0.7, 2.0, 0.7
"""Standard deviations of a cell's log radiance about the mean's: of the shell below the height of windows and lamps and
above it (a lamp is 50 times the mean), and of surface that was not seen."""
LAMP_EXCESS, LAMP_SPREAD = 0.2, 1.0
"""Of saturated cells: excess over the clipped radiance, relative to it, and the standard deviation of its log."""
SMOOTHNESS, EDGE = 1.0, 0.5
"""Weight of the squared difference of neighbouring cells' log radiance, and the difference from which it grows
linearly: the rims of lamps and windows."""
CHROMA_NOISE = 0.06
"""Standard deviation of a patch's log chroma."""
REGION_CHROMA = 2.0
"""Standard deviation of a region's chroma of albedo: rooms have orange wood and red walls."""
CELL_CHROMA, TINT = 0.3, 0.2
"""Standard deviations of a cell's chroma about the light's, and of the light's about grey: cameras balance white."""
CHROMA_SMOOTHNESS = 5.0
"""Weight of the squared difference of neighbouring cells' chroma."""
LOGIT = float(np.log(MEAN_ALBEDO / (1 - MEAN_ALBEDO)))
DARKEST = 0.002
"""Radiance below which a logarithm says nothing: a code or two of 8-bit sRGB."""
MOST_STEP = 1.5
"""Greatest change of an unknown logarithm in one step."""
LOG_CHROMA = np.array([[1 / 3, 1 / 3, 1 / 3], [1.0, -1.0, 0.0], [-0.5, -0.5, 1.0]])
"""[3, 3] from log RGB: mean, red against green, blue against both."""
_FROM_CHROMA = np.linalg.inv(LOG_CHROMA)
_NODES = 64  # of the grid of materials along an axis

Floats = NDArray[np.float64]


@dataclass
class Unknowns:
    """What the objective is minimised over, and its curvature at the last step."""

    z: Floats = field(default_factory=lambda: np.zeros(COLUMNS))
    """[COLUMNS] log radiance of cells; of saturated ones, of their relative excess."""
    chroma: Floats = field(default_factory=lambda: np.zeros((COLUMNS, 2)))
    materials: Floats = field(default_factory=lambda: np.full(_NODES * _NODES, LOGIT))
    """[nodes] logit of albedo."""
    surfaces: dict[int, float] = field(default_factory=dict)
    """Offset of the logit by surface."""
    known: int = 0
    """Cells that have been solved for; later ones begin at their prior."""
    mean: float = 0.0
    """Log of the mean radiance of light, about which cells lie."""
    covariance: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """[known, known] of z, from the curvature."""
    condition: float = float("inf")
    """Of the curvature, 1-norm."""
    step: float = float("inf")
    """Greatest change in the last step."""


@dataclass(frozen=True)
class _Data:
    """The rows of the objective."""

    shares: Floats
    """[n, k]."""
    level: Floats
    """[n] y."""
    chroma: Floats
    """[n, 2] q."""
    known: Floats
    """[n] h."""
    known_chroma: Floats
    """[n, 2]."""
    precision: Floats
    """[n] 1 / S_p^2 of y."""
    is_clipped: NDArray[np.bool_]
    regions: NDArray[np.int64]
    """[n] from 0."""
    surfaces: NDArray[np.int64]
    """[n] number of the surface that a patch is part of."""
    surface_keys: NDArray[np.int64]
    """[surfaces]."""


def radiances(unknowns: Unknowns, transport: Transport, count: int) -> Floats:
    """[count, 3] RGB of the first `count` cells."""
    level = np.log(_levels(unknowns.z[:count], transport, count)[0])
    logs = np.concatenate([level[:, None], unknowns.chroma[:count]], axis=1)
    return np.asarray(np.exp(logs @ _FROM_CHROMA.T))


def step(unknowns: Unknowns, patches: Patches, transport: Transport, shell: Shell) -> None:
    """One Gauss-Newton step, in place. Needs patches whose rays were traced."""
    data, count = _data(patches, transport), transport.columns
    usable = data.level[~data.is_clipped]
    unknowns.mean = float(np.log(np.exp(usable).mean() / MEAN_ALBEDO)) if len(usable) else 0.0
    prior, deviation = _prior(unknowns.mean, transport, shell, count)
    unknowns.z[unknowns.known : count] = prior[unknowns.known :]
    unknowns.known = count
    z = unknowns.z[:count]

    level, slope = _levels(z, transport, count)
    arriving = data.shares @ level + data.known
    parts = data.shares * (level / arriving[:, None])  # T
    known_part = (data.known / arriving)[:, None] * data.known_chroma
    nodes, materials = _materials(data.chroma - parts @ unknowns.chroma[:count] - known_part)
    offsets = np.array([unknowns.surfaces.get(int(key), 0.0) for key in data.surface_keys])
    albedo = 1 / (1 + np.exp(-(materials @ unknowns.materials[nodes] + offsets[data.surfaces])))
    residual = data.level - np.log(arriving) - np.log(albedo)
    weights = data.precision * _huber(residual * np.sqrt(data.precision))
    weights[data.is_clipped & (residual < 0)] = 0.0

    surfaces = np.eye(len(offsets))[data.surfaces]
    design = np.concatenate([parts, (1 - albedo)[:, None] * np.concatenate([materials, surfaces], axis=1)], axis=1)
    scale = np.concatenate([slope / level, np.ones(len(nodes) + len(offsets))])
    gram = _gram(design, weights)
    matrix, vector = _without_regions(
        gram, design, weights, residual[:, None], data.regions, np.full(data.regions.max() + 1, REGION_SPREAD)
    )
    matrix, right = matrix * np.outer(scale, scale), vector[:, 0] * scale
    pairs, differences = _pairs(z)
    strength = SMOOTHNESS / np.sqrt(1 + (differences / EDGE) ** 2)
    _add_smoothness(matrix, pairs, strength)
    right[:CELLS] -= _smoothness_gradient(pairs, strength * differences)
    diagonal = np.concatenate(
        [1 / deviation**2, np.full(len(nodes), 1 / ALBEDO_SPREAD**2), np.full(len(offsets), 1 / SURFACE_SPREAD**2)]
    )
    matrix[np.diag_indices_from(matrix)] += diagonal
    target = np.concatenate([prior - z, LOGIT - unknowns.materials[nodes], -offsets])
    covariance = np.linalg.inv(matrix.astype(np.float32)).astype(np.float64)
    force = right + diagonal * target
    change = covariance @ force
    change += covariance @ (force - matrix @ change)
    unknowns.step = float(np.abs(change).max())
    change *= min(1.0, MOST_STEP / max(unknowns.step, 1e-12))
    unknowns.z[:count] += change[:count]
    unknowns.materials[nodes] += change[count : count + len(nodes)]
    offsets = offsets + change[count + len(nodes) :]
    unknowns.surfaces = {int(key): float(offset) for key, offset in zip(data.surface_keys, offsets, strict=True)}
    unknowns.covariance = covariance[:count, :count]
    unknowns.condition = float(np.abs(matrix).sum(0).max() * np.abs(covariance).sum(0).max())
    _solve_chroma(unknowns, data, parts, gram[:count, :count], weights, data.chroma - known_part)


def _data(patches: Patches, transport: Transport) -> _Data:
    rows, count = patches.used, transport.columns
    surface_keys, surfaces = _surfaces(patches.positions[rows], patches.normals[rows])
    logs = patches.logarithms[rows] @ LOG_CHROMA.T
    known = transport.known[rows]
    known_logs = np.log(np.maximum(known, DARKEST)) @ LOG_CHROMA.T
    age = patches.weights[rows]
    noise = PATCH_NOISE**2 + patches.variances[rows] / np.maximum(np.minimum(age, MOST_WEIGHT), 1.0)
    return _Data(
        shares=transport.shares[rows, :count].astype(np.float64),
        level=logs[:, 0],
        chroma=logs[:, 1:],
        known=np.where(known.max(axis=1) > 0, np.exp(known_logs[:, 0]), 0.0),
        known_chroma=known_logs[:, 1:],
        precision=np.minimum(age, 1.0) / noise,
        is_clipped=patches.clipped[rows] > 0.5,
        regions=np.unique(patches.regions[rows], return_inverse=True)[1].ravel(),
        surfaces=surfaces,
        surface_keys=surface_keys,
    )


def _surfaces(positions: Floats, normals: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keys [k] of planes through the room, and which of them each patch lies on [n]."""
    facing = np.rint(normals * 1.2).astype(np.int64)
    unit = facing / np.linalg.norm(facing, axis=1, keepdims=True)
    place = np.floor((positions * unit).sum(axis=1) / SURFACE_M).astype(np.int64)
    parts = np.concatenate([facing, place[:, None]], axis=1) + (1 << 9)
    keys, numbers = np.unique(parts @ (1 << (10 * np.arange(4, dtype=np.int64))), return_inverse=True)
    return keys, numbers.ravel()


def _levels(z: Floats, transport: Transport, count: int) -> tuple[Floats, Floats]:
    """[count] radiance of cells and its derivative by z."""
    slope = np.exp(z)
    at_least = np.exp(np.log(np.maximum(transport.at_least[:count], DARKEST)).mean(axis=1))
    saturated = transport.is_saturated[:count]
    level = np.where(saturated, at_least * (1 + slope), slope)
    return level, np.where(saturated, at_least * slope, slope)


def _prior(mean: float, transport: Transport, shell: Shell, count: int) -> tuple[Floats, Floats]:
    """[count] means and deviations of z."""
    saturated = transport.is_saturated[:count]
    prior = np.where(saturated, np.log(LAMP_EXCESS), mean)
    deviation = np.where(saturated, LAMP_SPREAD, CELL_HIDDEN)
    deviation[:CELLS] = np.where(shell.is_low, CELL_LOW, CELL_HIGH)
    return prior, deviation


def _huber(ratio: Floats) -> Floats:
    return np.asarray(np.minimum(1.0, HUBER / np.maximum(np.abs(ratio), 1e-9)))


def _materials(chroma: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Nodes [g] of the grid of materials that are near `chroma` [n, 2] of albedo, and their bilinear weights [n, g]."""
    place = np.clip(chroma / MATERIAL_CHROMA + _NODES / 2, 0.0, _NODES - 1.001)
    low = place.astype(np.int64)
    share = place - low
    columns, weights = [], []
    for right in (0, 1):
        for above in (0, 1):
            columns.append((low[:, 0] + right) * _NODES + low[:, 1] + above)
            weights.append(np.abs(1 - right - share[:, 0]) * np.abs(1 - above - share[:, 1]))
    nodes, inverse = np.unique(np.stack(columns, axis=1), return_inverse=True)
    result = np.zeros((len(chroma), len(nodes)))
    np.add.at(result, (np.arange(len(chroma))[:, None], inverse.reshape(-1, 4)), np.stack(weights, axis=1))
    return nodes, result


def _gram(design: Floats, weights: Floats) -> Floats:
    """Weighted sums of products of columns; float32, since terms are good to a percent and nothing cancels."""
    root = (design * np.sqrt(weights)[:, None]).astype(np.float32)
    return (root.T @ root).astype(np.float64)


def _without_regions(
    gram: Floats, design: Floats, weights: Floats, residuals: Floats, regions: NDArray[np.int64], spreads: Floats
) -> tuple[Floats, Floats]:
    """Normal matrix and vector [n, c] without each region's own offset, of deviation `spreads` [regions]."""
    count = len(spreads)
    order = np.argsort(regions, kind="stable")
    starts = np.searchsorted(regions[order], np.arange(count))
    weighted = (design * weights[:, None]).astype(np.float32)
    sums = np.add.reduceat(weighted[order], starts, axis=0)
    totals = np.add.reduceat(weights[order], starts)
    differences = np.add.reduceat((weights[:, None] * residuals)[order], starts, axis=0)
    factor = spreads**2 / (1 + spreads**2 * totals)
    root = sums * np.sqrt(factor).astype(np.float32)[:, None]
    matrix = gram - (root.T @ root).astype(np.float64)
    return matrix, weighted.T @ residuals - sums.T @ (factor[:, None] * differences)


_PAIRS = neighbours()


def _pairs(z: Floats) -> tuple[NDArray[np.int64], Floats]:
    return _PAIRS, z[_PAIRS[:, 0]] - z[_PAIRS[:, 1]]


def _add_smoothness(matrix: Floats, pairs: NDArray[np.int64], strength: Floats | float) -> None:
    first, second = pairs.T
    np.add.at(matrix, (first, first), strength)
    np.add.at(matrix, (second, second), strength)
    np.add.at(matrix, (first, second), -np.asarray(strength))
    np.add.at(matrix, (second, first), -np.asarray(strength))


def _smoothness_gradient(pairs: NDArray[np.int64], pull: Floats) -> Floats:
    up, down = (np.bincount(side, pull, CELLS) for side in pairs.T)
    return np.asarray(up - down)


def _solve_chroma(unknowns: Unknowns, data: _Data, parts: Floats, gram: Floats, weights: Floats, seen: Floats) -> None:
    """Equation (2), linear in the chroma of the cells and the light's; a clipped patch has no chroma."""
    count, ratio = parts.shape[1], (PATCH_NOISE / CHROMA_NOISE) ** 2
    predicted = parts @ unknowns.chroma[:count]
    residual = np.where(data.is_clipped[:, None], predicted, seen)
    spreads = np.full(data.regions.max() + 1, REGION_CHROMA)
    matrix, vector = _without_regions(ratio * gram, parts, ratio * weights, residual, data.regions, spreads)
    _add_smoothness(matrix, _PAIRS, CHROMA_SMOOTHNESS)
    matrix[np.diag_indices_from(matrix)] += 1 / CELL_CHROMA**2
    # The light's own chroma t is eliminated: u about t, t about 0.
    pull = 1 / CELL_CHROMA**2
    matrix -= pull**2 / (count * pull + 1 / TINT**2)
    unknowns.chroma[:count] = np.linalg.solve(matrix, vector)
