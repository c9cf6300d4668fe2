"""Float64 twin of cl_kernels/rasterize.cl: one triangle after the other, no tiles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel

NEAR_M = 0.05
GUARD_PX = 2.0**20
SUBPIXELS = 256

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Piece:
    """A clipped triangle: subpixel corners [3, 2] of positive area, 1 / z at them, the triangle it comes from."""

    corners: Ints
    inverse_depths: Floats
    triangle: int


def pixel_from_camera(camera: CameraModel) -> Floats:
    """[3, 3] camera metres to (u z, v z, z)."""
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])


def clip_triangle(corners: Floats) -> Floats:
    """[n, 3] what is left of corners [3, 3] (u z, v z, z) beyond the near plane and within the guard band."""
    planes = [(0, 0, 1, -NEAR_M), (-1, 0, GUARD_PX, 0), (1, 0, GUARD_PX, 0), (0, -1, GUARD_PX, 0), (0, 1, GUARD_PX, 0)]
    for plane in np.array(planes, np.float64):
        kept = []
        for here, onward in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            d_here, d_onward = here @ plane[:3] + plane[3], onward @ plane[:3] + plane[3]
            if d_here >= 0:
                kept.append(here)
            if (d_here >= 0) != (d_onward >= 0):
                kept.append(here + (onward - here) * d_here / (d_here - d_onward))
        corners = np.array(kept).reshape(-1, 3)
    return corners


def setup_triangles(camera: CameraModel, camera_from_model: Floats, vertices: Floats, triangles: Ints) -> list[Piece]:
    """The pieces of each triangle, fanned from the first corner that is left of it."""
    points = (vertices @ camera_from_model[:3, :3].T + camera_from_model[:3, 3]) @ pixel_from_camera(camera).T
    pieces = []
    for number, triangle in enumerate(triangles):
        corners = clip_triangle(points[triangle])
        for i in range(2, len(corners)):
            fan = corners[[0, i - 1, i]]
            snapped = np.rint(fan[:, :2] / fan[:, 2:] * SUBPIXELS).astype(np.int64)
            a, b, c = snapped
            area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
            order = [0, 1, 2] if area > 0 else [0, 2, 1]
            if area != 0:
                pieces.append(Piece(snapped[order], 1 / fan[order, 2], number))
    return pieces


def edge_values(piece: Piece, u: Ints, v: Ints) -> tuple[Ints, Ints]:
    """[3, ...] edge functions opposite to each corner at pixel centres; [3] bias, -1 for edges that own no centre."""
    values, biases = [], []
    for k in range(3):
        (ax, ay), (bx, by) = piece.corners[(k + 1) % 3], piece.corners[(k + 2) % 3]
        values.append((bx - ax) * (v * SUBPIXELS - ay) - (by - ay) * (u * SUBPIXELS - ax))
        biases.append(0 if by < ay or (by == ay and bx > ax) else -1)
    return np.array(values), np.array(biases)


def raster_tiles(camera: CameraModel, pieces: list[Piece]) -> Ints:
    """[h, w] the triangle that each pixel shows, -1 for none; the lower number where two are equally near."""
    visible = np.full((camera.height, camera.width), -1, np.int64)
    nearest = np.zeros(visible.shape)
    for piece in pieces:
        low, high = piece.corners.min(axis=0), piece.corners.max(axis=0)
        x0, y0 = np.maximum(-(-low // SUBPIXELS), 0)
        x1, y1 = np.minimum(high // SUBPIXELS + 1, (camera.width, camera.height))
        if x0 >= x1 or y0 >= y1:
            continue
        v, u = np.mgrid[y0:y1, x0:x1]
        edges, bias = edge_values(piece, u, v)
        covered = (edges + bias[:, None, None] >= 0).all(axis=0)
        inverse_depth = np.tensordot(piece.inverse_depths, edges / edges.sum(axis=0), 1)
        window = (slice(y0, y1), slice(x0, x1))
        # Pieces come in the order of their triangles, so an equal one is later.
        better = covered & (inverse_depth > nearest[window])
        nearest[window][better] = inverse_depth[better]
        visible[window][better] = piece.triangle
    return visible


def shade_surface(
    camera: CameraModel, camera_from_model: Floats, vertices: Floats, triangles: Ints, attributes: Floats, visible: Ints
) -> tuple[Floats, Floats]:
    """Model-space position [h, w, 3] and mean attributes [h, w, n] where each pixel's ray meets its triangle."""
    v, u = np.mgrid[: camera.height, : camera.width]
    model_from_camera = np.linalg.inv(camera_from_model)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(pixel_from_camera(camera)).T
    rays = rays @ model_from_camera[:3, :3].T
    corners = vertices[triangles[visible]]
    origin = np.broadcast_to(model_from_camera[:3, 3], rays.shape)
    hits = intersect_plane(corners[..., 0, :], corners[..., 1, :], corners[..., 2, :], origin, rays)
    shares = np.clip(hits[..., :2], 0, 1)
    shares /= np.maximum(shares.sum(axis=-1, keepdims=True), 1)
    weights = np.concatenate([1 - shares.sum(axis=-1, keepdims=True), shares], axis=-1)[..., None]
    depths = corners @ camera_from_model[2, :3] + camera_from_model[2, 3]
    t = np.clip(hits[..., 2], np.maximum(depths.min(axis=-1), 0), depths.max(axis=-1))
    return origin + t[..., None] * rays, (weights * attributes[triangles[visible]]).sum(axis=-2)


def intersect_plane(a: Floats, b: Floats, c: Floats, origin: Floats, direction: Floats) -> Floats:
    """[..., 3] where a ray meets the plane of a, b, c: shares of b and c, and its t (Moeller and Trumbore)."""
    ab, ac = b - a, c - a
    p, q = np.cross(direction, ac), np.cross(origin - a, ab)
    determinant = (ab * p).sum(axis=-1)[..., None]
    values = [((origin - a) * p).sum(axis=-1), (direction * q).sum(axis=-1), (ac * q).sum(axis=-1)]
    edge_on = determinant == 0
    return np.where(edge_on, (1 / 3, 1 / 3, 0), np.stack(values, axis=-1) / np.where(edge_on, 1, determinant))


def facing_camera(normal: Floats, facing: Floats, to_camera: Floats) -> Floats:
    """`normal` [n, 3] on the seen side of the triangle's `facing`, bent where it still turns its back on the camera."""

    def unit(vectors: Floats) -> Floats:
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)

    def along(a: Floats, b: Floats) -> Floats:
        return (a * b).sum(axis=-1, keepdims=True)

    flat = unit(np.where(along(facing, to_camera) < 0, -facing, facing))
    smooth = unit(normal)
    turned = np.where(along(smooth, flat) < 0, -smooth, smooth)
    return unit(turned - np.minimum(along(turned, to_camera), 0) * to_camera)
