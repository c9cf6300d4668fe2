"""A virtual ball before a wall that it shades, projected exactly: what a server draws of it from anywhere."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.shading.layer import Layer, LayerPart

CAMERA = CameraModel(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)
BALL_M, RADIUS_M = np.array([-0.08, 0.01, 0.7]), 0.07
WALL_M = 1.0
"""Its z."""
SHADOW_M, SHADOW_RADIUS_M, SOFT_M, DARKEST = np.array([0.22, 0.08]), 0.08, 0.02, 0.25
DEPTH_SCALE_M = 0.001
NEUTRAL = 128
SUBPIXELS = 4

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Seen:
    """A layer as it is sent, of the whole picture."""

    virtual: NDArray[np.uint8]
    """[h, w, 4] sRGB and coverage."""
    virtual_depth: NDArray[np.uint16]
    """[h, w] in DEPTH_SCALE_M, as all depths here."""
    ratio: NDArray[np.uint8]
    """[h, w, 3] the root of it, times NEUTRAL."""
    wall_depth: NDArray[np.uint16]

    def over(self, picture: NDArray[np.uint8]) -> Floats:
        """[h, w, 3] the camera's picture (sRGB) with the layer over it, not rounded, 0 to 255."""
        coverage = self.virtual[..., 3:] / 255.0
        behind = (self.ratio / NEUTRAL) ** 2 * linear(picture)
        return srgb(coverage * linear(self.virtual[..., :3]) + (1 - coverage) * behind)

    def layer(self) -> Layer:
        """What the pipeline gives: parts no larger than what they say."""
        return Layer(
            virtual=_part(self.virtual, self.virtual_depth, self.virtual[..., 3] > 0),
            ratio=_part(self.ratio, self.wall_depth, (self.ratio != NEUTRAL).any(axis=-1)),
            depth_scale_m=DEPTH_SCALE_M,
        )


def look(world_from_camera: Floats) -> Seen:
    """The scene from there. World axes are those of a camera that looks at the wall."""
    return _look(np.asarray(world_from_camera, np.float64).tobytes())


@cache
def _look(pose: bytes) -> Seen:
    """Of a pose's bytes: a test looks from a few places, a hundred times."""
    world_from_camera = np.frombuffer(pose).reshape(4, 4)
    rays = _rays(SUBPIXELS) @ world_from_camera[:3, :3].T  # [h, w, s, s, 3], one metre ahead each
    origin = world_from_camera[:3, 3]
    apart = origin - BALL_M
    a, b, c = (rays * rays).sum(-1), rays @ apart, apart @ apart - RADIUS_M**2
    hit = b * b - a * c > 0
    depth_m = np.where(hit, (-b - np.sqrt(np.maximum(b * b - a * c, 0))) / a, 0)
    normals = (apart + depth_m[..., None] * rays) / RADIUS_M
    shade = 0.2 + 0.8 * np.clip(normals @ np.array([0.5, -0.7, -0.51]), 0, 1)
    color = shade[..., None] * np.array([0.8, 0.06, 0.03])
    hits = hit.sum(axis=(2, 3))
    mean_color = (color * hit[..., None]).sum(axis=(2, 3)) / np.maximum(hits, 1)[..., None]
    mean_depth_m = (depth_m * hit).sum(axis=(2, 3)) / np.maximum(hits, 1)

    middle = _rays(1)[:, :, 0, 0] @ world_from_camera[:3, :3].T
    ahead_m = (WALL_M - origin[2]) / middle[..., 2]
    places = (origin + ahead_m[..., None] * middle)[..., :2]
    outside = np.clip((np.linalg.norm(places - SHADOW_M, axis=-1) - SHADOW_RADIUS_M) / SOFT_M + 0.5, 0, 1)
    ratio = DARKEST + (1 - DARKEST) * outside * outside * (3 - 2 * outside)
    return Seen(
        virtual=np.dstack([np.rint(srgb(mean_color)), np.rint(255 * hits / SUBPIXELS**2)]).astype(np.uint8),
        virtual_depth=np.rint(mean_depth_m / DEPTH_SCALE_M).astype(np.uint16),
        ratio=np.repeat(np.rint(NEUTRAL * np.sqrt(ratio))[..., None], 3, axis=-1).astype(np.uint8),
        wall_depth=np.rint(ahead_m / DEPTH_SCALE_M).astype(np.uint16),
    )


def linear(codes: NDArray[np.uint8]) -> Floats:
    """sRGB codes as shares of the largest radiance."""
    value = codes / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def srgb(radiance: Floats) -> Floats:
    """sRGB, 0 to 255, not rounded."""
    value = np.clip(radiance, 0, 1)
    return 255 * np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)


def _rays(parts: int) -> Floats:
    """[h, w, parts, parts, 3] through the middles of the parts of each pixel, in the camera's axes, z = 1."""
    inside = (np.arange(parts) + 0.5) / parts - 0.5
    v = np.arange(CAMERA.height)[:, None, None, None] + inside[:, None]
    u = np.arange(CAMERA.width)[None, :, None, None] + inside[None, :]
    v, u = np.broadcast_arrays(v, u)
    return np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)


def _part(color: NDArray[np.uint8], depth: NDArray[np.uint16], counts: NDArray[np.bool_]) -> LayerPart | None:
    rows, columns = np.flatnonzero(counts.any(axis=1)), np.flatnonzero(counts.any(axis=0))
    if not len(rows):
        return None
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    return LayerPart(int(columns[0]), int(rows[0]), color[box].copy(), depth[box].copy())
