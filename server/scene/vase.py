"""Built-in virtual object: a glazed vase as a surface of revolution, as GLB bytes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from server.scene import glb

HEIGHT_M = 0.24
SEGMENTS = 64
RINGS_PER_SPAN = 8

_OUTLINE = np.array(  # height and radius, parts of the height; from the foot's middle up the outside, then inside down
    [
        (0.0, 0.0),
        (0.0, 0.2),
        (0.03, 0.21),
        (0.06, 0.16),
        (0.14, 0.2),
        (0.3, 0.31),
        (0.46, 0.34),
        (0.62, 0.26),
        (0.76, 0.13),
        (0.86, 0.12),
        (0.95, 0.17),
        (1.0, 0.2),
        (0.99, 0.185),
        (0.9, 0.11),
        (0.78, 0.1),
        (0.7, 0.0),
    ]
)
_GLAZE, _BAND, _CLAY = (38, 92, 138), (226, 196, 120), (170, 92, 60)
"""sRGB."""


def vase_glb() -> bytes:
    """A closed surface with normals and vertex colours, standing on y = 0, `HEIGHT_M` high."""
    outline = _smooth(_OUTLINE) * HEIGHT_M
    positions, normals = _turn(outline)
    colors = np.repeat(_colors(outline[:, 0] / HEIGHT_M), SEGMENTS, axis=0)
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0}}],
    }
    body = bytearray()
    primitive = {
        "attributes": {
            "POSITION": glb.add_array(document, body, positions, bounds=True),
            "NORMAL": glb.add_array(document, body, normals),
            "COLOR_0": glb.add_array(document, body, colors),
        },
        "indices": glb.add_array(document, body, _triangles(len(outline))),
        "material": 0,
    }
    document["meshes"] = [{"primitives": [primitive]}]
    return glb.to_bytes(document, body)


def _smooth(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """A Catmull-Rom curve through the points, except for the foot's sharp edge."""
    padded = np.concatenate([points[:1], points, points[-1:]])
    t = np.arange(RINGS_PER_SPAN)[:, None] / RINGS_PER_SPAN
    curve = []
    for a, b, c, d in zip(padded, padded[1:], padded[2:], padded[3:], strict=False):
        bent = b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)))
        curve.append(np.maximum(bent, 0))
    return np.concatenate([*curve, points[-1:]])


def _turn(outline: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Positions and outward normals [rings * segments, 3] of the outline turned about y."""
    slope = np.gradient(outline, axis=0)
    up, out = -slope[:, 1], slope[:, 0]
    length = np.maximum(np.hypot(up, out), 1e-12)
    angle = 2 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    around = np.stack([np.sin(angle), np.zeros(SEGMENTS), np.cos(angle)], axis=1)
    positions = outline[:, None, 1:] * around + outline[:, None, :1] * [0, 1, 0]
    normals = (out / length)[:, None, None] * around + (up / length)[:, None, None] * np.array([0, 1, 0])
    return positions.reshape(-1, 3).astype(np.float32), normals.reshape(-1, 3).astype(np.float32)


def _triangles(rings: int) -> NDArray[np.uint32]:
    """Two for each cell between neighbouring rings, counter-clockwise from outside; none where a ring is a point."""
    ring, segment = np.mgrid[0 : rings - 1, 0:SEGMENTS]
    here, right = ring * SEGMENTS + segment, ring * SEGMENTS + (segment + 1) % SEGMENTS
    lower = np.stack([here, right, right + SEGMENTS], axis=-1)
    upper = np.stack([here, right + SEGMENTS, here + SEGMENTS], axis=-1)
    keep = np.ones((rings - 1, 2), bool)
    keep[0, 0] = keep[-1, 1] = False
    cells = np.stack([lower, upper], axis=2)[np.broadcast_to(keep[:, None], (rings - 1, SEGMENTS, 2))]
    triangles: NDArray[np.uint32] = cells.ravel().astype(np.uint32)
    return triangles


def _colors(height: NDArray[np.float64]) -> NDArray[np.uint8]:
    """[rings, 4] by height: clay foot, blue glaze, two ochre bands."""
    band = (np.abs(height - 0.3) < 0.025) | (np.abs(height - 0.6) < 0.02)
    rgb = np.where(band[:, None], _BAND, np.where((height < 0.1)[:, None], _CLAY, _GLAZE))
    return np.concatenate([rgb, np.full((len(height), 1), 255)], axis=1).astype(np.uint8)
