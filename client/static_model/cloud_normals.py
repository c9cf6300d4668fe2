"""Normals of a point cloud by moving least squares, oriented by the viewing direction (thesis 4.1.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.errors import RunError
from client.static_model.point_cloud import Floats, PointCloud

NORMAL_ERROR_RAD = 0.0175
"""Target error of normals due to noise: one degree."""
LEAST_RADIUS, GREATEST_RADIUS = 2.5, 6.0
"""Radius in multiples of the point spacing: smaller has too few points for a plane, larger loses edges."""
LEAST_NEIGHBOURS = 6
DENSITY_NEIGHBOURS = 8
MOST_NEIGHBOURS = 48
"""The nearest ones are used."""
_BATCH = 1 << 15


@dataclass(frozen=True)
class SurfacePoints:
    """A cloud projected onto its smooth surface, with normals. Points with too few neighbours are removed."""

    cloud: PointCloud
    normals: Floats
    """[n, 3] unit, world; the sign is arbitrary before `oriented_outwards`."""
    residual_m: Floats
    """[n] weighted RMS distance of the neighbours to the fitted plane."""
    radius_m: float


def smooth(cloud: PointCloud, radius_m: float | None = None) -> SurfacePoints:
    """Fit a plane around every point and project the point onto it; `radius_m` None: chosen from density and noise.

    Raises RunError if there are too few points, or if they are too far apart.
    """
    spacing = spacing_m(cloud.points)
    if radius_m is None:
        first = fit_planes(cloud, 3.0 * spacing)
        radius_m = chosen_radius_m(spacing, float(np.median(first.residual_m)))
    moved = fit_planes(cloud, radius_m)
    # Again with the projected points: these normals are of the smooth surface.
    return fit_planes(moved.cloud, radius_m)


def spacing_m(points: Floats) -> float:
    """Square root of the surface area per point, median over the points. Raises RunError for fewer than 16 points.

    With k points in a disc of radius d the area is pi d^2 / k. One neighbour is not enough, because of close pairs.
    """
    if len(points) < 16:
        raise RunError(f"{len(points)} points are too few for a model: give more --frames or a smaller --voxel")
    chosen = points[:: max(len(points) // 20_000, 1)]
    distances, _ = _tree(points).query(chosen, k=[DENSITY_NEIGHBOURS + 1])
    return float(np.median(distances) * np.sqrt(np.pi / DENSITY_NEIGHBOURS))


def chosen_radius_m(spacing: float, noise: float) -> float:
    """Radius at which points with this spacing and noise give normals with an error of NORMAL_ERROR_RAD.

    n points in a disc of radius r give a slope error of noise / sqrt(n r^2 / 4), with n = pi r^2 / spacing^2.
    """
    radius = np.sqrt(2 * noise * spacing / (np.sqrt(np.pi) * NORMAL_ERROR_RAD))
    return float(np.clip(radius, LEAST_RADIUS * spacing, GREATEST_RADIUS * spacing))


def fit_planes(cloud: PointCloud, radius_m: float) -> SurfacePoints:
    """One step of moving least squares (Levin 2003) with planes.

    Neighbours within `radius_m` are weighted by inverse variance and a Gaussian of half the radius. The plane contains
    their mean; its normal is the direction of least variance. Raises RunError if no point has enough neighbours.
    """
    tree = _tree(cloud.points)
    parts = []
    for start in range(0, len(cloud.points), _BATCH):
        places = cloud.points[start : start + _BATCH]
        distances, neighbours = tree.query(places, k=min(MOST_NEIGHBOURS, len(cloud.points)), workers=-1)
        weights = np.exp(-2 * (distances / radius_m) ** 2) * (distances < radius_m)
        enough = (weights > 0).sum(axis=1) > LEAST_NEIGHBOURS
        parts.append((enough, *_plane(places, cloud, neighbours, weights)))
    enough, moved, normals, residuals = (np.concatenate(column) for column in zip(*parts, strict=True))
    if not enough.any():
        raise RunError("the points are too far apart for a surface: give more --frames or a larger --voxel")
    kept = replace(
        cloud,
        points=moved[enough],
        colors=cloud.colors[enough],
        towards_camera=cloud.towards_camera[enough],
        weights=cloud.weights[enough],
        frames=cloud.frames[enough],
    )
    return SurfacePoints(kept, normals[enough], residuals[enough], radius_m)


def oriented_outwards(surface: SurfacePoints) -> tuple[SurfacePoints, NDArray[np.bool_]]:
    """The surface with normals towards the cameras, and [n] which normals were flipped.

    A visible surface faces its camera: the dot product with the direction to the camera is not negative.
    """
    away = (surface.normals * surface.cloud.towards_camera).sum(axis=1) < 0
    return replace(surface, normals=np.where(away[:, None], -surface.normals, surface.normals)), away


def _plane(
    places: Floats, cloud: PointCloud, neighbours: NDArray[np.intp], weights: Floats
) -> tuple[Floats, Floats, Floats]:
    """Points projected onto their planes [n, 3], unit normals [n, 3], residuals [n]."""
    weights = weights * cloud.weights[neighbours]
    total = np.maximum(weights.sum(axis=1), 1e-300)
    offsets = cloud.points[neighbours] - places[:, None]  # small numbers keep precision far from the origin
    mean = np.einsum("nk,nki->ni", weights, offsets) / total[:, None]
    offsets -= mean[:, None]
    covariance = np.einsum("nk,nki,nkj->nij", weights, offsets, offsets) / total[:, None, None]
    spreads, axes = np.linalg.eigh(covariance)
    normals: Floats = axes[:, :, 0]
    moved = places + (mean * normals).sum(axis=1, keepdims=True) * normals
    return moved, normals, np.sqrt(np.maximum(spreads[:, 0], 0))


def _tree(points: Floats) -> Any:
    try:
        from scipy.spatial import KDTree
    except ImportError as error:
        raise RunError("a model needs SciPy: run make install, or pip install scipy") from error
    return KDTree(points)
