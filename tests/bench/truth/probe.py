"""Light probes (thesis 5.3, 6.2.3.1): the light from a sphere whose place is known, to hold the estimate against.

Passive (E2): a matte grey sphere; its shading gives the light by the estimator's own solver. Active (E3): a mirror
sphere; its pixels are the light. (A panorama as an active probe: `server.light.panorama`.) The sphere stands in the
camera's axes (x right, y down, z forward, metres); a marker beside it can say where.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, sqrt

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel
from protocol.messages import Dictionary, Marker
from server.light.light_estimation import prior_precision
from server.maths.bayes import NormalEquations, Posterior, solve_with_evidence
from server.maths.sh import lambert_transfer, sh_basis
from server.tracking.markers import find_marker

LEAST_FACING = 0.2
"""Cosine of the steepest usable view: nearer to the rim a pixel mixes sphere and background."""
LEAST_MIRROR_FACING = 0.05
"""The same of a mirror, whose rim shows what is behind it."""
POOL = 50.0
"""How many neighbouring pixels share their errors (surface, lens, texture)."""

Floats = NDArray[np.float64]


class ProbeError(ValueError):
    """The probe cannot be found or used; one line."""


@dataclass(frozen=True)
class Sphere:
    """A sphere in the camera's axes."""

    center_m: Floats
    """[3]."""
    radius_m: float


@dataclass(frozen=True)
class SpherePixels:
    """The pixels of a picture that show a sphere's front."""

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    normals: Floats
    """[n, 3] unit, camera axes."""


def find_sphere(
    gray: NDArray[np.uint8],
    camera: CameraModel,
    marker_id: int,
    marker_side_m: float,
    center_in_marker_m: Floats,
    radius_m: float,
    dictionary: Dictionary = "4x4_50",
) -> Sphere:
    """The sphere beside an ArUco marker. Raises ProbeError where the marker is not seen.

    gray: [h, w]. center_in_marker_m: [3] in the marker's axes: x right and y up on the sheet, z out of it, origin in
    its middle. The marker's side is that of the black square.
    """
    marker = Marker(id=marker_id, side_m=marker_side_m, dictionary=dictionary)
    try:
        camera_from_marker = find_marker(gray, camera, marker)
    except ValueError as error:
        raise ProbeError(str(error)) from error
    center = camera_from_marker @ np.append(np.asarray(center_in_marker_m, np.float64), 1.0)
    return Sphere(center[:3], radius_m)


def sphere_pixels(camera: CameraModel, sphere: Sphere, least_facing: float = LEAST_FACING) -> SpherePixels:
    """Which pixels of a rectified picture show the sphere, and its normals there. Raises ProbeError for none."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    views = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    near, under_root = _distance(views, sphere)
    normals = (near[..., None] * views - sphere.center_m) / sphere.radius_m
    seen = (under_root > 0) & (near > 0) & (-np.sum(normals * views, axis=-1) >= least_facing)
    rows, columns = np.nonzero(seen)
    if not len(rows):
        raise ProbeError("the sphere is not in the picture")
    return SpherePixels(rows, columns, normals[seen])


def passive_probe(
    radiance: Floats,
    pixels: SpherePixels,
    bands: int,
    camera_to_world: Floats | None = None,
    albedo: float = 0.5,
    usable: NDArray[np.bool_] | None = None,
) -> Posterior:
    """The light [bands^2, 3] (`mean`) of a matte sphere's picture: E2, by the estimator's solver.

    radiance: [h, w, 3] linear RGB. camera_to_world: [3, 3] rotation into the axes of the light; None: the camera's.
    usable: [h, w], False for clipped pixels, highlights and the marker. Raises ProbeError for too few pixels.
    """
    kept = np.ones(len(pixels.rows), bool) if usable is None else usable[pixels.rows, pixels.columns]
    normals = pixels.normals[kept] @ (np.eye(3) if camera_to_world is None else camera_to_world).T
    observed = radiance[pixels.rows, pixels.columns][kept].astype(np.float64)
    if len(normals) < bands * bands:
        raise ProbeError(f"{len(normals)} usable pixels on the sphere are too few for {bands} bands")
    return light_on_normals(normals, observed / albedo, bands)


def light_on_normals(
    normals: Floats, shading: Floats, bands: int, weights: Floats | None = None, pool: float = POOL
) -> Posterior:
    """The light [bands^2, 3] that shades unoccluded `normals` [n, 3] to `shading` [n, 3]; see `solve_with_evidence`.

    weights: [n], none negative. pool: how many samples count as one independent one.
    """
    return solve_with_evidence(shading_equations(normals, shading, bands, weights, pool), prior_precision(bands))


def shading_equations(
    normals: Floats, shading: Floats, bands: int, weights: Floats | None = None, pool: float = POOL
) -> NormalEquations:
    """The normal equations of `light_on_normals`."""
    weight = np.full(len(normals), 1 / pool) if weights is None else weights / pool
    transfer = lambert_transfer(normals, bands)
    weighted = weight[:, None] * transfer
    energy = np.sum(weight[:, None] * shading**2, axis=0)
    return NormalEquations(weighted.T @ transfer, weighted.T @ shading, energy, float(weight.sum()))


def active_probe(
    radiance: Floats, camera: CameraModel, sphere: Sphere, bands: int, camera_to_world: Floats | None = None
) -> Floats:
    """The light [bands^2, 3] that a mirror sphere shows: E3. It shows all but a cone behind itself.

    radiance: [h, w, 3] linear RGB, divided by the mirror's reflectance. Each pixel stands for the solid angle that its
    reflection covers, so that the sum is an integral; what no pixel shows is taken for the mean of what is seen.
    """
    pixels = sphere_pixels(camera, sphere, LEAST_MIRROR_FACING)
    turn = np.eye(3) if camera_to_world is None else camera_to_world
    right = _reflected(camera, sphere, pixels, 0.5, 0.0) - _reflected(camera, sphere, pixels, -0.5, 0.0)
    down = _reflected(camera, sphere, pixels, 0.0, 0.5) - _reflected(camera, sphere, pixels, 0.0, -0.5)
    solid_angle = np.linalg.norm(np.cross(right, down), axis=1)
    basis = sh_basis(_reflected(camera, sphere, pixels, 0.0, 0.0) @ turn.T, bands)
    observed = radiance[pixels.rows, pixels.columns].astype(np.float64)
    seen = basis.T @ (solid_angle[:, None] * observed)
    unseen = sqrt(4 * pi) * np.eye(1, bands * bands)[0] - solid_angle @ basis
    return np.asarray(seen + np.outer(unseen, solid_angle @ observed / solid_angle.sum()))


def _reflected(camera: CameraModel, sphere: Sphere, pixels: SpherePixels, right_px: float, down_px: float) -> Floats:
    """[n, 3] unit directions, camera axes, that the mirror shows where the pixels are, moved by so much."""
    u, v = pixels.columns + right_px, pixels.rows + down_px
    views = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))], axis=-1)
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    normals = (_distance(views, sphere)[0][:, None] * views - sphere.center_m) / sphere.radius_m
    return np.asarray(views - 2 * np.sum(views * normals, axis=1, keepdims=True) * normals)


def _distance(views: Floats, sphere: Sphere) -> tuple[Floats, Floats]:
    """Metres to the sphere along unit `views` [..., 3], and what is negative where they miss it [...]."""
    along = views @ sphere.center_m
    under_root = along**2 - (sphere.center_m @ sphere.center_m - sphere.radius_m**2)
    return along - np.sqrt(np.maximum(under_root, 0.0)), under_root
