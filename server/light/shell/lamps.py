"""Saturated surface and bright parts of the shell as lights with a place and a size, which cast shadows; the rest stays
soft.

Saturated cells that touch become one disc. A mode of the radiance above the shell's median, found by a mean shift over
the shell, becomes another. Its window is Gaussian, so that a lamp moves and grows with the evidence and does not jump
between cells.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from server.light.shell.emitters import CELL_M, Emitters
from server.maths.direct_lights import DirectLight, lamp_at
from server.maths.dominant import MOST_LIGHTS

WINDOW_M = 0.5
"""Standard deviation of the window: a ceiling panel or half a window."""
WEAK, STRONG = 0.02, 0.06
"""Shares of the radiance that arrives from the shell. Below the first value a mode is no lamp; above the second its
light becomes a disc completely; between the two, in part."""
LEAST_RADIUS_M, LEAST_BULB_M = 0.3, 0.02
"""Least radius of a disc on the shell, half a cell and half a ceiling panel: smaller ones are not told apart. And of
one of saturated surface: shadows of smaller discs are no sharper."""
TOUCHING_M = 1.5 * CELL_M
"""Emitters nearer to each other than this are parts of one window."""
_SHIFTS = 12

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ShellLamp:
    """A disc on the shell."""

    center: Floats
    """[3] metres, world."""
    radius_m: float
    radiance: Floats
    """[3] above what is around it."""

    def as_direct_light(self, origin_world: Floats) -> DirectLight:
        """For the renderer; origin_world: [3] of the volume."""
        return lamp_at(self.center - origin_world, self.radius_m, self.radiance)


def emitting_lamps(position: Floats, emitters: Emitters, radiance: Floats, others: float) -> list[ShellLamp]:
    """At most MOST_LIGHTS lamps of saturated surface, strongest first at `position` [3].

    radiance: [k, 3] that emitters send; others: radiance of all else times its solid angle, summed over channels.
    """
    if not emitters.count:
        return []
    _, areas = emitters.seen_from(position[None])
    sent = emitters.solid_angles(position[None])[0] * emitters.presence * radiance.sum(axis=1)
    total = float(sent.sum()) + others
    lamps = []
    for own in _touching(emitters.centers):
        share = sent[own] / max(float(sent[own].sum()), 1e-12)
        fade = np.clip((float(sent[own].sum()) / total - WEAK) / (STRONG - WEAK), 0.0, 1.0)
        area = float(areas[0, own].sum())
        if fade > 0 and area > 0:
            center = share @ emitters.centers[own]
            power = (emitters.presence[own] * areas[0, own]) @ radiance[own]
            radius_m = max(float(np.sqrt(area / np.pi)), LEAST_BULB_M)
            lamps.append((fade * sent[own].sum(), ShellLamp(center, radius_m, fade * power / (np.pi * radius_m**2))))
    lamps.sort(key=lambda one: -one[0])
    return [lamp for _, lamp in lamps[:MOST_LIGHTS]]


def _touching(centers: Floats) -> list[NDArray[np.int64]]:
    """Numbers of the `centers` [k, 3] of each group of which each is near another."""
    near = ((centers[:, None] - centers) ** 2).sum(axis=-1) <= TOUCHING_M**2
    count, groups = connected_components(csr_matrix(near), directed=False)
    return [np.flatnonzero(groups == group) for group in range(count)]


@dataclass(frozen=True)
class BrightParts:
    """Parts of the shell whose radiance above a floor lamps have, in the order in which they are taken."""

    floor: Floats
    """[3] radiance."""
    centers: tuple[Floats, ...] = ()
    """[3] world metres each."""
    shares: tuple[float, ...] = ()
    """Of what is above the floor in the middle of each."""

    def taken(self, number: int, ends: Floats, rest: Floats) -> Floats:
        """[m, 3] what part `number` takes of `rest` [m, 3], the radiance of `ends` [m, 3] that those before it left."""
        near = np.exp(-((ends - self.centers[number]) ** 2).sum(axis=1) / (2 * WINDOW_M**2))
        return np.asarray(self.shares[number] * near[:, None] * np.maximum(rest - self.floor, 0.0))

    def rest(self, ends: Floats, radiance: Floats) -> Floats:
        """[m, 3] what all lamps leave of the radiance of `ends` on the shell, [m, 3] both."""
        for number in range(len(self.centers)):
            radiance = radiance - self.taken(number, ends, radiance)
        return radiance


def find_lamps(
    position: Floats,
    ends: Floats,
    radiance: Floats,
    blur_m2: Floats,
    most: int = MOST_LIGHTS,
    emitted: float = 0.0,
) -> tuple[list[ShellLamp], BrightParts]:
    """At most `most` lamps seen from `position` [3], and the parts of the shell that they stand for.

    Modes nearer to each other than two standard deviations of the window are one lamp: two Gaussians then have one
    peak, and a large lamp leaves a rim around its middle.
    ends: [m, 3] where evenly spread directions from there end on the shell; radiance: [m, 3]; blur_m2: [m] by how much
    its variance over the shell is too large (Shell.blur_m2). emitted: what comes from elsewhere, as a sum of radiance
    over such directions and channels.
    """
    rest, parts = radiance, BrightParts(np.median(radiance, axis=0))
    total = float(radiance.sum()) + emitted
    of_lamps: list[Floats] = []  # what each takes
    for _ in range(most):
        weights = np.maximum(rest - parts.floor, 0.0).sum(axis=1)
        if weights.sum() <= WEAK * total:
            break
        center = _mode(ends, weights)
        near = np.exp(-((ends - center) ** 2).sum(axis=1) / (2 * WINDOW_M**2))
        share = float(np.clip((float(near @ weights) / total - WEAK) / (STRONG - WEAK), 0.0, 1.0))
        if share <= 0.0:
            break
        parts = replace(parts, centers=(*parts.centers, center), shares=(*parts.shares, share))
        taken = parts.taken(len(parts.centers) - 1, ends, rest)
        _add(of_lamps, ends, taken)
        rest = rest - taken
    return [_disc(position, ends, taken, blur_m2) for taken in of_lamps], parts


def _add(of_lamps: list[Floats], ends: Floats, taken: Floats) -> None:
    """To the first lamp whose middle is as near as two standard deviations of the window, or as a new one."""
    middle = _middle(ends, taken)
    for number, others in enumerate(of_lamps):
        if np.linalg.norm(_middle(ends, others) - middle) < 2 * WINDOW_M:
            of_lamps[number] = others + taken
            return
    of_lamps.append(taken)


def _mode(ends: Floats, weights: Floats) -> Floats:
    """[3] where the weights are densest, from the strongest end."""
    center = ends[weights.argmax()]
    for _ in range(_SHIFTS):
        near = weights * np.exp(-((ends - center) ** 2).sum(axis=1) / (2 * WINDOW_M**2))
        center = near @ ends / near.sum()
    return np.asarray(center)


def _middle(ends: Floats, taken: Floats) -> Floats:
    """[3] of the radiance `taken` [m, 3] at `ends` [m, 3]."""
    weights = taken.sum(axis=1)
    return np.asarray(weights @ ends / weights.sum())


def _disc(position: Floats, ends: Floats, taken: Floats, blur_m2: Floats) -> ShellLamp:
    """The disc of the same centre, second moment, less `blur_m2`, and irradiance as the radiance `taken` [m, 3]."""
    weights = taken.sum(axis=1) / taken.sum()
    center = _middle(ends, taken)
    spread = float(weights @ (((ends - center) ** 2).sum(axis=1) - blur_m2))
    radius_m = max(float(np.sqrt(2 * max(spread, 0.0))), LEAST_RADIUS_M)
    distance_m = float(np.linalg.norm(center - position))
    irradiance = 4 * np.pi / len(ends) * taken.sum(axis=0)
    return ShellLamp(center, radius_m, irradiance * distance_m**2 / (np.pi * radius_m**2))
