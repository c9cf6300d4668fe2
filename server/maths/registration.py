"""The 6x6 system of a rigid registration, solved only along the motions that the scene fixes.

A twist is (omega, tau): a point p moves by omega x p + tau, radians and metres. Degenerate directions are left where
they were (solution remapping, Zhang, Kaess and Singh 2016), with thresholds from noise instead of a ratio.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_UPPER = np.triu_indices(6)


@dataclass(frozen=True)
class Scale:
    """Extent of the registered points, which makes rotations and translations comparable."""

    center: Floats
    """[3] metres; centre of rotations."""
    radius_m: float
    """Radius in metres: a rotation moves the points by its angle times this."""

    def twist_from_scaled(self) -> Floats:
        """[6, 6]: the twist of (radius * turn about the centre, shift of the centre), both in metres."""
        x, y, z = self.center / self.radius_m
        matrix = np.eye(6)
        matrix[:3, :3] /= self.radius_m
        matrix[3:, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
        return matrix


@dataclass(frozen=True)
class Solution:
    """A Gauss-Newton step."""

    twist: Floats
    """[6] step that moves the origin, the camera, as little as the fixed directions allow."""
    free: Floats
    """[k, 6] orthonormal scaled directions that are not fixed, the most nearly pure shifts first."""
    step_m: float
    """Distance by which the step moves the points, metres."""


def symmetric(upper: Floats) -> Floats:
    """[6, 6] from its upper triangle [21] by rows."""
    matrix = np.zeros((6, 6))
    matrix[_UPPER] = upper
    return matrix + np.triu(matrix, 1).T


def least_information(variance: float, tolerance_m: float, normal_noise: float, total: float) -> float:
    """What a direction's information (1/m^2) must exceed for the scene to fix it.

    Residuals of `variance` (their own units) must fix it to `tolerance_m`; and noise of the normals (radians) alone
    makes normal_noise^2 of the `total` information of all residuals appear along any direction.
    """
    return max(variance / tolerance_m**2, 2 * normal_noise**2 * total)


def solve_where_fixed(information: Floats, gradient: Floats, scale: Scale, least: float) -> Solution:
    """Minimise over the scaled directions whose information exceeds `least` (1/m^2).

    What the others leave open is chosen so that the camera, at the origin, stays where it is: along a corridor it does
    not advance by turning, though what it sees does.

    information [6, 6] and gradient [6]: J^T W J and J^T W e of twists.
    """
    twist_from_scaled = scale.twist_from_scaled()
    scaled = twist_from_scaled.T @ information @ twist_from_scaled
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    fixed = values > max(least, 0.0)
    along = vectors[:, fixed]
    step = -along @ ((along.T @ twist_from_scaled.T @ gradient) / values[fixed])
    free = _shifts_first(vectors[:, ~fixed])
    twist = _with_least_motion(twist_from_scaled @ step, twist_from_scaled @ free.T, scale.radius_m)
    return Solution(twist, free, float(np.linalg.norm(step)))


def _with_least_motion(twist: Floats, free: Floats, radius_m: float) -> Floats:
    """The shortest sum of `twist` and multiples of the columns of `free` [6, k], turns times the radius."""
    lengths = np.array([radius_m] * 3 + [1.0] * 3)[:, None]
    share = np.linalg.lstsq(lengths * free, lengths[:, 0] * twist, rcond=None)[0]
    return twist - free @ share


def _shifts_first(directions: Floats) -> Floats:
    """[k, 6] another basis of the columns of [6, k]: turns and shifts as far apart as they can be."""
    if not directions.shape[1]:
        return np.empty((0, 6))
    mix = np.linalg.svd(directions[:3])[2]
    return np.ascontiguousarray((directions @ mix.T).T[::-1])


def motion_of_twist(twist: Floats) -> Floats:
    """The rigid 4x4 that a constant twist moves to in unit time (exponential map of SE(3))."""
    omega, tau = twist[:3], twist[3:]
    angle = float(np.linalg.norm(omega))
    x, y, z = omega
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    small = angle < 1e-4  # series: the closed forms cancel
    a = 1 - angle**2 / 6 if small else np.sin(angle) / angle
    b = 0.5 - angle**2 / 24 if small else (1 - np.cos(angle)) / angle**2
    c = 1 / 6 - angle**2 / 120 if small else (angle - np.sin(angle)) / angle**3
    motion = np.eye(4)
    motion[:3, :3] += a * cross + b * cross @ cross
    motion[:3, 3] = tau + b * cross @ tau + c * cross @ cross @ tau
    return motion


def angle_between(a: Floats, b: Floats) -> float:
    """Radians between the rotations of two rigid 4x4."""
    difference = a[:3, :3].T @ b[:3, :3]
    sine = np.linalg.norm([difference[2, 1] - difference[1, 2], difference[0, 2] - difference[2, 0],
                           difference[1, 0] - difference[0, 1]]) / 2  # fmt: skip
    return float(np.arctan2(sine, (np.trace(difference) - 1) / 2))


def distance_between(a: Floats, b: Floats) -> float:
    """Metres between the origins of two rigid 4x4."""
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
