"""Shades the virtual objects of `mitsuba_room` under an estimated light, by exact geometry and many rays.

What a light is for is the look of an object where it stands. So an estimate is judged by the radiance on the objects'
pixels against the path-traced composite, apart from what the project's renderer adds: visibility comes from the exact
meshes through Open3D (Embree), which the bench dependencies bring. Open directions send the light; what the room hides
sends, if asked, the radiance that a camera has seen there (see light_estimation's indirect light).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.sh import lambert_transfer, sh_basis, spherical_fibonacci
from tests.bench.light.environment import bands_of, relative_rmse
from tests.bench.truth.exact_room import UNSEEN, ExactMeshes, Views
from tests.bench.truth.mitsuba_room import OBJECTS, RoomSet

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

DIRECTIONS = 1024
"""Over the sphere, the same at every pixel; what is open is exact, only what is hidden is sampled."""
LIFT_M = 1e-4


@dataclass(frozen=True)
class FrameObjects:
    """The objects' pixels of one frame."""

    mask: Bools
    """[h, w]"""
    albedo: Floats
    """[n, 3]"""
    normals: Floats
    """[n, 3] world."""
    distances_m: Floats
    """[n, directions] to what a ray meets, infinite where it leaves the room; 0 below the horizon."""
    sources: NDArray[np.int32]
    """[n, directions] picture element (frame * h * w + pixel) that shows what a ray meets; UNSEEN where none does,
    _OBJECT where it is an object."""


_OBJECT, _OPEN = -2, -3


class ObjectShading:
    """The objects' pixels of all frames, traced once; then any light can be judged by them."""

    def __init__(self, room: Path, camera: CameraModel, poses: list[Floats]) -> None:
        """Raises ImportError where Open3D is not installed."""
        self._truth = dict(np.load(room / "truth" / "geometry.npz").items())
        self._camera, self._poses = camera, poses
        self._directions = spherical_fibonacci(DIRECTIONS)
        self._room = ExactMeshes([room / "truth" / "room.ply", *(room / "objects" / name for name in OBJECTS)])
        self.views = Views(camera, poses, self._truth["depth_m"])
        """What the frames show of the room."""
        self.frames = [self._trace(index) for index in range(len(poses))]

    def radiance(
        self, index: int, light: Floats, ray_length_m: float = np.inf, pictures: list[Floats] | None = None
    ) -> Floats:
        """[n, 3] radiance of the objects' pixels of frame `index` under `light` [bands^2, 3].

        Occluders farther than `ray_length_m` are not seen. `pictures`: the camera's, [h, w, 3] each in the units of the
        light, for what occluded directions send; None: nothing.
        """
        frame, bands = self.frames[index], bands_of(light)
        weights = np.maximum(frame.normals @ self._directions.T, 0) * (4 / DIRECTIONS)  # cosine * 4 pi / n / pi
        hidden = (frame.distances_m < ray_length_m) & (weights > 0)
        arriving = sh_basis(self._directions, bands) @ light
        shading = lambert_transfer(frame.normals, bands) @ light - (weights * hidden) @ arriving
        if pictures is not None:
            shading += self._observed(frame, weights * hidden, shading, pictures)
        return frame.albedo * np.maximum(shading, 0)

    def error(
        self,
        item: RoomSet,
        index: int,
        light: Floats,
        ray_length_m: float = np.inf,
        pictures: list[Floats] | None = None,
    ) -> float:
        """Relative RMSE of `radiance` against the composite's pixels, after one scale."""
        true = item.composite(index)[self.frames[index].mask]
        return relative_rmse(self.radiance(index, light, ray_length_m, pictures), true)

    def _observed(self, frame: FrameObjects, weights: Floats, shading: Floats, pictures: list[Floats]) -> Floats:
        """[n, 3] irradiance over pi from what is hidden: seen surfaces as pictured, unseen ones as bright as the mean
        of the seen, objects as bright as their own mean."""
        shown = np.concatenate([picture.reshape(-1, 3) for picture in pictures])
        seen = frame.sources >= 0
        total = np.zeros_like(shading)
        for channel in range(3):
            sent = np.where(seen, shown[np.maximum(frame.sources, 0), channel], 0.0)
            of_rooms = float((weights * sent).sum() / max(float((weights * seen).sum()), 1e-12))
            of_objects = float((frame.albedo[:, channel] * np.maximum(shading[:, channel], 0)).mean())
            sent = np.where(frame.sources == UNSEEN, of_rooms, sent)
            sent = np.where(frame.sources == _OBJECT, of_objects, sent)
            total[:, channel] = (weights * sent).sum(axis=1)
        return total

    def _trace(self, index: int) -> FrameObjects:
        """Normals from the meshes, smooth across their triangles; one ray a direction above the horizon."""
        mask = self._truth["virtual_mask"][index] & (self._truth["depth_with_virtual_m"][index] > 0)
        points = self._points(index, mask, self._truth["depth_with_virtual_m"][index])
        normals = self._normals(points, self._poses[index][:3, 3])
        albedo = self._truth["virtual_albedo"][index][mask].astype(np.float64)
        above = normals @ self._directions.T > 0
        pixel, direction = np.nonzero(above)
        origins = points[pixel] + LIFT_M * normals[pixel]
        met, kind = self._cast(origins, self._directions[direction])
        distances, sources = np.zeros(above.shape), np.full(above.shape, _OPEN, np.int32)
        distances[pixel, direction] = met
        hit = np.isfinite(met)
        found = np.full(len(met), _OPEN, np.int32)
        found[hit] = np.where(
            kind[hit] > 0,
            _OBJECT,
            self.views.sources(origins[hit] + met[hit, None] * self._directions[direction[hit]], index),
        )
        sources[pixel, direction] = found
        return FrameObjects(mask, albedo, normals, distances, sources)

    def _points(self, index: int, mask: Bools, depth_m: Floats) -> Floats:
        camera, pose = self._camera, self._poses[index]
        v, u = np.nonzero(mask)
        z = depth_m[mask].astype(np.float64)
        points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=1)
        return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])

    def _cast(self, origins: Floats, directions: Floats) -> tuple[Floats, NDArray[np.int64]]:
        """Distance to the first hit, infinite without one, and the mesh: 0 the room, else an object."""
        answer = self._room.cast(origins, directions)
        return answer["t_hit"].astype(np.float64), answer["geometry_ids"].astype(np.int64)

    def _normals(self, points: Floats, eye: Floats) -> Floats:
        """[n, 3] interpolated vertex normals of the mesh that each point lies on."""
        towards = points - eye
        length = np.linalg.norm(towards, axis=1, keepdims=True)
        answer = self._room.cast(np.broadcast_to(eye, points.shape), towards / length)
        mesh, triangle = answer["geometry_ids"], answer["primitive_ids"]
        uv = answer["primitive_uvs"].astype(np.float64)
        normals = np.zeros_like(points)
        for number, (triangles, of_vertices) in enumerate(self._room.meshes):
            here = mesh == number
            corners = of_vertices[triangles[triangle[here]]]
            u, v = uv[here, 0, None], uv[here, 1, None]
            normals[here] = (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
        unit: Floats = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        return unit
