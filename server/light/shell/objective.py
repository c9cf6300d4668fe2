"""The one objective of a room's light, and a Gauss-Newton step towards its minimum.

Patch p of surface shows, for the mean logarithm of the channels y and two chroma coordinates q (`LOG_CHROMA`),

    y_p = log(sum_k A_pk x_k + h_p) + log s(B_p m) + o_f(p) + d_r(p) + e_p                     (1)
    q_p = sum_k T_pk u_k + (h_p / E_p) q(h_p) + a_f(p) + c_r(p) + e'_p,    T_pk = A_pk x_k / E_p        (2)

with A_pk the share of p's cosine-weighted hemisphere that is source k (sources.py), x_k = exp(z_k) its radiance
(of saturated surface x_k = b_k exp(z_k), beyond b_k, which the clipped picture shows), h_p what photographed surface
brings, E_p the sum in (1), u_k the chroma of source k. s is the logistic function, B_p m the logit of the albedo of
materials, bilinear on a grid over the chroma of albedo. o_f is what surface f (segments.py: a floor, a painted stripe)
has besides, a_f its chroma, d_r and c_r what region r of it has further; they are eliminated exactly (elimination.py).
Minimised is

    sum_p huber(e_p / S_p) + sum_k ((z_k - n_k) / s_k)^2 + sum_j 2 (exp(z_j - n_j) - z_j + n_j) / s_j^2
    + sum_(k,l) rho(z_k - z_l) + sum_g ((m_g - m) / s_m)^2 + ((m - m_0) / s_0)^2 + ((b - log B) / s_b)^2
    + sum_f tau(o_f) + sum_r (d_r / s_d)^2
    + sum_p |e'_p / S'_p|^2 + sum_k |(u_k - t) / s_u|^2 + sum_(k,l) c |u_k - u_l|^2 + |t / s_t|^2 + sum_f |a_f / s_a|^2
    + sum_r log(1 + |c_r / s_c|^2) + |(w - w_0) / s_w|^2

over lobes j at infinity, all other sources k (all of them in the sums of u), and neighbours (k,l); sums over p, f and r
are divided by GRIDS, each of which has patches of all surface. tau is
2 (d / s_o)^2 (sqrt(1 + (o / d)^2) - 1), which becomes linear at d, sooner below 0 than above, and steep where the
albedo exceeds 1. n_k of floor that was not scanned is the log of what the other sources bring there, with nothing in
between, plus the mean log albedo of floor that was; of all others it is one value, and n_j is another, which grows with
the lobe's elevation.
b is the log albedo of the brightest white surface, the mean of log s(B_p m) + o_f(p) between two ranks of patches that
count as their chroma is like w_0, white paint's; it sets the level. w is the mean chroma of albedo of the patches, of
any chroma, between these ranks. s_t is one along the colours of black bodies, another across them. For the light from
beyond the scan, b and w are left out, tau is quadratic above 0, and S_p^2 is larger by what is near the patch
(CONTACT_NOISE).
n_k and m follow between the steps. m goes to where its own two terms balance, by Newton steps; how far all else goes
along with it, and b, is told by the curvature. The weights stand in weights.py. A patch that is clipped only counts
where (1) is below what it shows; its material is the mean one. A patch much brighter than (1), a window or a screen,
counts 1 / (1 + (e_p / LUMINOUS)^4) for positive e_p.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve

from server.light.shell import weights
from server.light.shell.chroma import solve_chroma
from server.light.shell.elimination import Beside, Offsets, Regions, add_smoothness
from server.light.shell.evidence import DARKEST, LOG_CHROMA, Evidence, materials_of
from server.light.shell.level import Paint, brightest, level_step, logistic
from server.light.shell.patches import GRIDS
from server.light.shell.shell import CELLS, FLOOR
from server.light.shell.sources import Sources
from server.light.shell.switches import Switches
from server.light.shell.unknowns import ALL_NODES, Unknowns, given_logit

MOST_STEP = 3.0
"""Greatest change of an unknown logarithm in a whole step."""
BEGIN_EXCESS = np.arange(9.0)
"""Logarithms of excess, over its prior mean, of which new saturated sources begin at the best. A bulb is e^5 times as
bright as a picture shows it."""
_FROM_CHROMA = np.linalg.inv(LOG_CHROMA)

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]


def step(
    unknowns: Unknowns,
    evidence: Evidence,
    sources: Sources,
    switches: Switches | None = None,
    *,
    with_chroma: bool = True,
) -> Linear:
    """One Gauss-Newton step, in place; returned is the objective before it.

    Sources that are new begin at their prior, or as of `_begin`.

    with_chroma: solve (2) too; else sources keep their chroma.

    Products of matrices are float32: terms are good to a percent, and nothing cancels.
    """
    switches, count = switches or Switches(), sources.count
    finds_level = switches.albedos and sources.finds_level
    here = _linearised(unknowns, evidence, sources, switches)
    unknowns.keep(here.curvature)
    change = unknowns.solve(here.slope)
    change *= min(1.0, MOST_STEP / max(float(np.abs(change).max()), 1e-12))
    change *= unknowns.relax(change[:count])
    if finds_level:
        change += _follow_level(unknowns, here, change)
    parts = here.paint.design[:, :count]
    unknowns.step = float(np.sqrt(np.mean((parts @ change[:count].astype(np.float32)) ** 2)))
    unknowns.z = here.z + change[:count]
    unknowns.materials[here.nodes] += change[count:]
    unknowns.offsets[evidence.rows] = here.paint.offsets(change)
    if with_chroma:
        unknowns.chroma = solve_chroma(
            parts,
            here.seen,
            here.sent_chroma,
            here.paint.surfaces.regions,
            sources.pairs,
            brightest(here.paint.albedos(change), ~evidence.is_clipped) if finds_level else None,
            finds_albedos=switches.albedos,
        )
    unknowns.radiance = _radiance(unknowns, sources)
    return here


@dataclass(frozen=True)
class Linear:
    """The objective about the unknowns as they are, with the derivatives of (1)."""

    z: Floats
    """[k] of all sources."""
    nodes: Ints
    """[albedos] of the patches' materials."""
    paint: Paint
    arriving: Floats
    """[n] radiance that patches receive: the sum in (1)."""
    seen: Floats
    """[n, 2] chroma that they show, without what photographed surface brings."""
    sent_chroma: Floats
    """[n, 2] of what they receive from sources."""
    curvature: Singles
    """[k + albedos] squared, half the second derivative."""
    slope: Floats
    """[k + albedos] downwards, half of it."""
    spread: float
    """s_m."""

    @cached_property
    def beside(self) -> Beside:
        """For more columns than those of the unknowns."""
        return self.paint.surfaces.beside(self.paint.design, self.paint.residual)


def _linearised(unknowns: Unknowns, evidence: Evidence, sources: Sources, switches: Switches) -> Linear:
    """Where sources are new, at their prior, or as of `_begin`; the unknowns know them from then on."""
    count = sources.count
    finds_level = switches.albedos and sources.finds_level
    middle = _begin_level(unknowns, evidence, finds_level=finds_level, has_materials=switches.albedos)
    prior = unknowns.prior(sources)
    known = sources.known_level
    offsets = _means(unknowns.offsets[evidence.rows], evidence.surfaces)
    z = np.concatenate([unknowns.z, prior[unknowns.known :]])
    z += _begin(z, unknowns.known, evidence, sources, known, np.log(logistic(middle)) + offsets)
    unknowns.z, unknowns.chroma = z, np.concatenate([unknowns.chroma, np.zeros((count - len(unknowns.chroma), 2))])

    level = _levels(z, sources).astype(np.float32)
    arriving = np.maximum(sources.shares @ level + known, DARKEST)
    _set_floor_prior(prior, level, evidence.level - np.log(arriving), ~evidence.is_clipped, sources)
    sent_chroma = sources.shares @ (level[:, None] * unknowns.chroma.astype(np.float32)) / arriving[:, None]
    seen = evidence.chroma - (known / arriving)[:, None] * sources.known_logs[:, 1:]
    seen = np.where(evidence.is_clipped[:, None], sent_chroma, seen)
    nodes, materials = materials_of(seen - sent_chroma)
    albedo = logistic(materials @ unknowns.materials[nodes])
    residual = evidence.level - np.log(arriving) - np.log(albedo)
    error = residual - offsets[evidence.surfaces]
    counts = _counts(error, evidence, switches)
    counts[sources.says_nothing] = 0.0

    design = _design(sources.shares, level, arriving, (1 - albedo)[:, None] * materials)
    spreads = _albedo_spreads(switches, finds_level=finds_level)
    regions = Regions.of(design, counts, evidence)
    whitest = -_means(np.log(albedo), evidence.surfaces)
    surfaces = _albedo_offsets(offsets, whitest, regions, spreads)
    residual = residual - surfaces.center[evidence.surfaces]
    matrix, vector = surfaces.normal_equations(design, residual[:, None])
    slope = vector[:, 0].astype(np.float64)
    slope[:count] -= _smoothen(matrix, z, sources.pairs)
    bent, pull = _priors(z - prior, sources, unknowns.materials[nodes] - middle, spreads.material)
    matrix[np.diag_indices_from(matrix)] += bent
    paint = Paint(materials, unknowns.materials[nodes], design, residual, surfaces, evidence)
    return Linear(z, nodes, paint, arriving, seen, sent_chroma, matrix, slope + pull, spreads.material)


def profile(unknowns: Unknowns, here: Linear, columns: Singles) -> tuple[Floats, Floats]:
    """Half the slope [m] downwards, and half the curvature [m, m], of the objective by what is no unknown yet.

    All unknowns go along as the curvature tells, which `unknowns` have kept. columns: [n, m] derivatives of (1).
    """
    across, own, slope = here.beside.blocks(columns)
    along = cho_solve(unknowns.factor, across, check_finite=False)
    return (slope - along.T @ here.slope).astype(np.float64), (own - across.T @ along).astype(np.float64)


def received(unknowns: Unknowns, sources: Sources) -> Floats:
    """[n] the logarithm of (1) without albedo: what patches receive. Sources that are new are at their prior."""
    z = np.concatenate([unknowns.z, unknowns.prior(sources)[unknowns.known :]])
    level = _levels(z, sources).astype(np.float32)
    return np.log(np.maximum(sources.shares @ level + sources.known_level, DARKEST))


def _priors(above: Floats, sources: Sources, materials: Floats, spread: float) -> tuple[Floats, Floats]:
    """[k + albedos] half the curvature of the priors, and half their slope downwards.

    above: [k] z - n of the sources; materials: [albedos] m_g - m, with this standard deviation. The curvature for a
    lobe is at least that at n: it vanishes where lobes are dark, and steps would have no end.
    """
    bent = np.concatenate([1 / sources.deviation**2, np.full(len(materials), 1 / spread**2)])
    pull = -bent * np.concatenate([above, materials])
    excess = np.exp(above[: sources.lobes])
    pull[: sources.lobes] = bent[: sources.lobes] * (1 - excess)
    bent[: sources.lobes] *= np.maximum(excess, 1.0)
    return bent, pull


def _design(shares: Singles, level: Singles, arriving: Floats, of_albedos: Floats) -> Singles:
    """[n, k + albedos] T of (2), beside it `of_albedos` [n, albedos], the derivatives of log albedo."""
    design = np.empty((len(shares), len(level) + of_albedos.shape[1]), np.float32)
    parts = design[:, : len(level)]
    np.multiply(shares, level, out=parts)
    parts *= (1 / arriving).astype(np.float32)[:, None]
    design[:, len(level) :] = of_albedos
    return design


def _set_floor_prior(
    prior: Floats, level: Singles, albedos: Floats, is_usable: NDArray[np.bool_], sources: Sources
) -> None:
    """Floor that was not scanned sends back what arrives there, times the albedo of scanned floor; in place.

    level: [k] radiance of the sources; albedos: [n] logarithms, of patches of which those that are usable count.
    """
    if sources.floor is None:
        return
    floor, others = albedos[is_usable & sources.floor.is_scanned], albedos[is_usable]
    of_room = others.sum() / max(len(others), 1)
    of_all = GRIDS * weights.FLOOR_PATCHES
    albedo = (floor.sum() + of_all * of_room) / (len(floor) + of_all)
    prior[FLOOR] = np.log(np.maximum(sources.floor.shares @ level[:CELLS], DARKEST)) + albedo


def _begin_level(unknowns: Unknowns, evidence: Evidence, *, finds_level: bool, has_materials: bool) -> float:
    """The logit of albedo about which the materials lie; sets the mean of the sources.

    has_materials: albedos are found; else all of them are the given one.
    """
    middle = unknowns.middle if finds_level else given_logit(has_materials=has_materials)
    unknowns.mean = float(np.log(evidence.mean / (1.0 if finds_level else logistic(middle))))
    if unknowns.known == 0:
        unknowns.materials[:] = middle
    return middle


def _begin(z: Floats, count: int, evidence: Evidence, sources: Sources, known: Floats, albedos: Floats) -> Floats:
    """[k] by how much sources from `count` on begin above `z`: saturated ones, all alike, at what fits the level best.

    From too little light the first steps do not find a lamp; from too much they take all surface for black.
    known: [n] radiance of photographed surface; albedos: [surfaces] logarithms.
    """
    is_new = sources.is_saturated.copy()
    is_new[:count] = False
    if not is_new.any():
        return np.zeros_like(z)
    level = _levels(z, sources)
    brought = sources.shares[:, is_new] @ level[is_new]
    others = sources.shares[:, ~is_new] @ level[~is_new] + known
    target = evidence.level - albedos[evidence.surfaces]
    arriving = np.log(np.maximum(others + np.exp(BEGIN_EXCESS)[:, None] * brought, DARKEST))
    errors = np.abs(target - arriving)[:, ~evidence.is_clipped].sum(axis=1)
    return np.where(is_new, BEGIN_EXCESS[errors.argmin()], 0.0)


def _follow_level(unknowns: Unknowns, here: Linear, change: Floats) -> Floats:
    """[k + albedos] how sources and materials go along with a step of m, which is taken.

    Materials of no patch go along whole: nothing else holds them. change: [k + albedos] of the Gauss-Newton step.
    """
    towards_m = np.zeros(len(change))
    towards_m[-len(here.nodes) :] = 1 / here.spread**2
    along = unknowns.solve(towards_m)
    wanted = level_step(unknowns.middle, here.paint, change, along, here.seen - here.sent_chroma)
    taken = unknowns.relaxation * float(np.clip(wanted, -MOST_STEP, MOST_STEP))
    unknowns.middle += taken
    unknowns.materials[np.setdiff1d(ALL_NODES, here.nodes)] += taken
    return taken * along


@dataclass(frozen=True)
class _AlbedoSpreads:
    material: float = weights.ALBEDO_SPREAD
    surface: float = weights.SURFACE_SPREAD
    region: float = weights.REGION_SPREAD
    bright_edge: float = np.inf


def _counts(error: Floats, evidence: Evidence, switches: Switches) -> Floats:
    """[n] weights of the patches, by the error [n] of (1)."""
    counts = evidence.precision / (1 + (np.maximum(error, 0.0) / weights.LUMINOUS) ** 4)
    if switches.outliers:
        counts *= _huber(error * np.sqrt(evidence.precision))
    return np.where(evidence.is_clipped & (error < 0), 0.0, counts)


def _albedo_spreads(switches: Switches, *, finds_level: bool) -> _AlbedoSpreads:
    if not switches.albedos:
        return _AlbedoSpreads(*[weights.ONE_ALBEDO] * 3)
    return _AlbedoSpreads(bright_edge=weights.BRIGHT_EDGE if finds_level else np.inf)


def _albedo_offsets(offsets: Floats, whitest: Floats, regions: Regions, spreads: _AlbedoSpreads) -> Offsets:
    """By the last `offsets` [surfaces] and the greatest, `whitest`, with which an albedo is 1.

    The prior grows slowly for dark ones, since paint may be black, and for bright ones, less slowly: white things among
    grey ones; and sharply from `whitest` on.
    """
    is_white = offsets >= whitest
    edge = np.where(offsets < 0, weights.DARK_EDGE, spreads.bright_edge)
    variance = spreads.surface**2 * np.sqrt(1 + (offsets / edge) ** 2)
    beyond = np.where(is_white, 1 / weights.WHITE**2, 0.0)  # precision of a second prior, about `whitest`
    variance = variance / (1 + variance * beyond)
    return Offsets.of(regions, spreads.region**2, variance, variance * beyond * whitest)


def _levels(z: Floats, sources: Sources) -> Floats:
    """[k] radiance of sources."""
    clipped = np.exp(np.log(np.maximum(sources.clipped, DARKEST)).mean(axis=1))
    return np.asarray(np.where(sources.is_saturated, clipped, 1.0) * np.exp(z))


def _radiance(unknowns: Unknowns, sources: Sources) -> Floats:
    """[k, 3] RGB of sources."""
    logs = np.concatenate([np.log(_levels(unknowns.z, sources))[:, None], unknowns.chroma], axis=1)
    return np.asarray(np.exp(logs @ _FROM_CHROMA.T))


def _huber(ratio: Floats) -> Floats:
    return np.asarray(np.minimum(1.0, weights.HUBER / np.maximum(np.abs(ratio), 1e-9)))


def _means(values: Floats, groups: Ints) -> Floats:
    """[groups] of values [n]."""
    return np.asarray(np.bincount(groups, values) / np.bincount(groups))


def _smoothen(matrix: Singles, z: Floats, pairs: Ints) -> Floats:
    """[k] half the gradient of the sum of rho at z [k]; its curvature is added to `matrix`."""
    differences = z[pairs[:, 0]] - z[pairs[:, 1]]
    strength = weights.SMOOTHNESS / np.sqrt(1 + (differences / weights.EDGE) ** 2)
    add_smoothness(matrix, pairs, strength)
    up, down = (np.bincount(side, strength * differences, len(z)) for side in pairs.T)
    return np.asarray(up - down)
