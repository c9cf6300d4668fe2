"""Layers: decode the virtual content of a frame and compose it over a camera picture of that frame or a later one.

For a later camera pose the layer is reprojected. Each pixel with depth is a small square of surface. A corner gets the
mean depth of those of its four pixels that belong to one surface; where depth jumps, the surface is cut. The squares
are rasterized for the new pose and give, for each of its pixels, the position in the layer to sample.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.codec import ProtocolError
from protocol.depth_codec import inflate, unfilter_depth, zstd_decompress
from protocol.frames import CameraModel
from protocol.messages import DepthImage, Layer, LayerPatch
from protocol.picture_headers import png_size

NEUTRAL = 128
"""Code of a ratio of 1."""
JUMP = 0.05
"""Neighbours whose depths differ by more than this share belong to two surfaces,"""
ALIKE_PER_M = 0.004
"""unless their inverse depths differ by at most this: then both are so far away that they move alike. It is larger than
the quantisation step of depth."""
NEAREST_M = 0.01
"""Near plane; nearer surfaces are not drawn."""
NOWHERE = np.float32(-1e6)

Codes = NDArray[np.uint8]
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Part:
    """A part of a layer; its first pixel is column x, row y of the camera's picture."""

    x: int
    y: int
    values: Floats
    """[h, w, channels] linear, 0: no change. Virtual content: RGB radiance times coverage, and coverage; ratios: RGB
    ratio minus 1."""
    depth_m: Floats
    """[h, w] along the camera's z; 0: empty pixel."""


@dataclass(frozen=True)
class DecodedLayer:
    """Content of a layer message."""

    virtual: Part | None
    ratio: Part | None
    world_from_camera: NDArray[np.float64]
    """[4, 4] camera pose of the layer."""


def decode_layer(layer: Layer, camera: CameraModel) -> DecodedLayer:
    """Decode a layer of a session with this camera. Raises ProtocolError if it contradicts its header."""
    pose = np.array(layer.world_from_camera, np.float64).reshape(4, 4)
    virtual = ratio = None
    if layer.virtual is not None:
        codes, depth_m = _read(layer.virtual, 4, camera, layer.depth_scale_m)
        coverage = np.float32(1 / 255) * codes[..., 3:]
        values: Floats = np.concatenate([coverage * _LINEAR[codes[..., :3]], coverage], axis=-1)
        virtual = Part(layer.virtual.x, layer.virtual.y, values, depth_m)
    if layer.ratio is not None:
        codes, depth_m = _read(layer.ratio, 3, camera, layer.depth_scale_m)
        change = (codes.astype(np.float32) / np.float32(NEUTRAL)) ** 2 - np.float32(1)
        ratio = Part(layer.ratio.x, layer.ratio.y, change, depth_m)
    return DecodedLayer(virtual, ratio, pose)


def put_over(
    layer: DecodedLayer, picture: Codes, camera: CameraModel, world_from_camera: NDArray[np.float64] | None = None
) -> Codes:
    """Compose a layer over `picture` [h, w, 3] sRGB of a camera at `world_from_camera`; empty pixels stay unchanged.

    In linear radiance: coverage * virtual + (1 - coverage) * ratio * picture (thesis 7.2.1). `world_from_camera`:
    rigid; None: the pose of the layer. `picture` must be without distortion (`shown_picture`).
    """
    moved = None
    if world_from_camera is not None and not np.array_equal(world_from_camera, layer.world_from_camera):
        moved = np.linalg.inv(world_from_camera) @ layer.world_from_camera
    change = _seen(layer.ratio, 3, camera, moved)
    virtual = _seen(layer.virtual, 4, camera, moved)
    is_changed = change.any(axis=-1) | virtual.any(axis=-1)
    own, coverage = virtual[is_changed][:, :3], virtual[is_changed][:, 3:]
    linear = own + (1 - coverage) * (1 + change[is_changed]) * _LINEAR[picture[is_changed]]
    result = picture.copy()
    result[is_changed] = _srgb_codes(linear)
    return result


def shown_picture(color: NDArray[np.uint8] | NDArray[np.uint16], camera: CameraModel) -> Codes:
    """[h, w, 3] a frame's picture for `put_over`: sRGB without lens distortion."""
    if not camera.is_distorted and color.dtype == np.uint8:
        return color.astype(np.uint8, copy=False)
    linear = _LINEAR[color] if color.dtype == np.uint8 else color.astype(np.float32) / np.float32(65535)
    if camera.is_distorted:
        matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        size, lens = (camera.width, camera.height), np.array(camera.distortion)
        maps = cv2.initUndistortRectifyMap(matrix, lens, None, matrix, size, cv2.CV_32FC1)
        remapped = cv2.remap(linear, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        linear = np.asarray(remapped, np.float32)
    return _srgb_codes(linear)


# ---- reading -----------------------------------------------------------------------------------------------------


def _read(patch: LayerPatch, channels: int, camera: CameraModel, depth_scale_m: float) -> tuple[Codes, Floats]:
    """Codes [h, w, channels] and metres [h, w]. Raises ProtocolError."""
    color, depth = patch.color, patch.depth
    size = (color.width, color.height)
    if color.codec != "png" or png_size(color.data) != size or (depth.width, depth.height) != size:
        raise ProtocolError("a layer's part must be a PNG and a depth picture of the size that both declare")
    if patch.x + size[0] > camera.width or patch.y + size[1] > camera.height:
        raise ProtocolError(f"a layer's part reaches beyond the camera's picture of {camera.width}x{camera.height}")
    picture = cv2.imdecode(np.frombuffer(color.data, np.uint8), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.shape != (color.height, color.width, channels):
        raise ProtocolError(f"a layer's part is no PNG of {channels} channels")
    rgb = cv2.cvtColor(picture, cv2.COLOR_BGRA2RGBA if channels == 4 else cv2.COLOR_BGR2RGB)
    return rgb.astype(np.uint8, copy=False), np.float32(depth_scale_m) * _units(depth).astype(np.float32)


def _units(depth: DepthImage) -> NDArray[np.uint16]:
    count = 2 * depth.width * depth.height
    if depth.codec == "raw":
        if len(depth.data) != count:
            raise ProtocolError(f"depth.data has {len(depth.data)} bytes, {depth.width}x{depth.height} needs {count}")
        return np.frombuffer(depth.data, "<u2").reshape(depth.height, depth.width)
    decompress = inflate if depth.codec == "zdelta" else zstd_decompress
    return unfilter_depth(decompress(depth.data, count), depth.width, depth.height)


# ---- reprojection ------------------------------------------------------------------------------------------------


def _seen(part: Part | None, channels: int, camera: CameraModel, moved: NDArray[np.float64] | None) -> Floats:
    """[height, width, channels] values of a part at the pixels of a camera, 0 where it is not visible.

    moved: [4, 4] camera_from_layer_camera; None: the same pose.
    """
    whole: Floats = np.zeros((camera.height, camera.width, channels), np.float32)
    if part is None:
        return whole
    if moved is None:
        height, width = part.depth_m.shape
        whole[part.y : part.y + height, part.x : part.x + width] = part.values
        return whole
    columns, rows = _drawn(*_squares(part, camera, moved), camera)
    found = cv2.remap(part.values, columns - part.x, rows - part.y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.where(columns[..., None] == NOWHERE, np.float32(0), found)


def _squares(part: Part, camera: CameraModel, moved: NDArray[np.float64]) -> tuple[Floats, Floats]:
    """Corners of the squares of all pixels in front of the camera: upper left, upper right, lower left, lower right.

    [n, 4, 3] pixels and depth (metres) in the camera, [n, 4, 2] pixels in the layer's camera.
    """
    depths = _corner_depths(part.depth_m)
    y, x = np.nonzero(part.depth_m)
    dy, dx = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
    z = np.stack([depths[3 - k, y + dy[k], x + dx[k]] for k in range(4)], axis=-1).astype(np.float64)
    places = np.stack([part.x + x[:, None] + dx - 0.5, part.y + y[:, None] + dy - 0.5], axis=-1)
    focal, center = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    points = np.concatenate([(places - center) / focal, np.ones((*z.shape, 1))], axis=-1) * z[..., None]
    points = points @ moved[:3, :3].T + moved[:3, 3]
    is_in_front = (points[..., 2] > NEAREST_M).all(axis=-1)
    points, places = points[is_in_front], places[is_in_front]
    seen = points[..., :2] / points[..., 2:] * focal + center
    return np.concatenate([seen, points[..., 2:]], axis=-1).astype(np.float32), places.astype(np.float32)


def _corner_depths(depth_m: Floats) -> Floats:
    """[4, h + 1, w + 1] depth at each corner for the surface of its upper left, upper right, lower left and lower right
    pixel: the harmonic mean over the pixels of that surface, because 1 / z of a plane is linear in the image."""
    height, width = depth_m.shape
    padded = np.pad(depth_m, 1)
    z = np.stack([padded[k >> 1 : (k >> 1) + height + 1, k & 1 : (k & 1) + width + 1] for k in range(4)])
    near, far = np.minimum(z[:, None], z[None]), np.maximum(z[:, None], z[None])
    is_connected = (near > 0) & (far - near <= near * np.maximum(JUMP, ALIKE_PER_M * far))
    for _ in range(2):  # connections over one and two neighbours reach all four
        is_connected = np.stack([(is_connected[k][:, None] & is_connected).any(axis=0) for k in range(4)])
    inverse = np.divide(1, z, out=np.zeros_like(z), where=z > 0)
    total = np.where(is_connected, inverse[None], 0).sum(axis=1)
    means: Floats = np.divide(is_connected.sum(axis=1), total, out=np.zeros_like(z), where=total > 0)
    return means


def _drawn(corners: Floats, places: Floats, camera: CameraModel) -> tuple[Floats, Floats]:
    """Rasterize squares of `_squares`: columns and rows [height, width] in the layer's picture of the nearest square at
    each pixel; NOWHERE without any."""
    order = np.array([[0, 1, 2], [1, 3, 2]])
    triangles, places = corners[:, order].reshape(-1, 3, 3), places[:, order].reshape(-1, 3, 2)
    low = np.ceil(triangles[..., :2].min(axis=1)).clip(0, None).astype(np.int64)
    most = [camera.width - 1, camera.height - 1]
    size = (np.floor(triangles[..., :2].max(axis=1)).clip(-1, most).astype(np.int64) - low + 1).clip(0, None)
    counts = size.prod(axis=1)
    of = np.repeat(np.arange(len(triangles)), counts)  # one entry for each pixel of each triangle's box
    offset = np.arange(len(of)) - np.repeat(counts.cumsum() - counts, counts)
    x, y = low[of, 0] + offset % size[of, 0], low[of, 1] + offset // size[of, 0]
    weights = _barycentric(triangles, of, x, y)
    is_inside = (weights >= -1e-5).all(axis=-1)
    of, pixels = of[is_inside], (x + y * camera.width)[is_inside]
    weights = weights[is_inside] / triangles[of, :, 2]  # perspective-correct interpolation
    inverse_z = weights.sum(axis=-1)
    nearest_last = np.argsort(inverse_z, kind="stable")
    chosen = np.full(camera.width * camera.height, -1)
    chosen[pixels[nearest_last]] = nearest_last
    seen = np.flatnonzero(chosen >= 0)
    chosen = chosen[seen]
    there = np.full((2, camera.height, camera.width), NOWHERE, np.float32)
    there.reshape(2, -1)[:, seen] = np.einsum("mk,mkc->cm", weights[chosen], places[of[chosen]]) / inverse_z[chosen]
    return there[0], there[1]


def _barycentric(
    triangles: Floats, of: NDArray[np.int64], x: NDArray[np.int64], y: NDArray[np.int64]
) -> NDArray[np.float64]:
    """[n, 3] weights of corners at pixels; all negative for a triangle without area."""
    a, b, c = (triangles[:, k, :2].astype(np.float64) for k in range(3))
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    area = ux * vy - uy * vx
    inverse = np.divide(1, area, out=np.zeros_like(area), where=np.abs(area) > 1e-9)
    px, py = x - a[of, 0], y - a[of, 1]
    second = (px * vy[of] - py * vx[of]) * inverse[of]
    third = (ux[of] * py - uy[of] * px) * inverse[of]
    weights = np.stack([1 - second - third, second, third], axis=-1)
    return np.where(inverse[of, None] != 0, weights, -1.0)


# ---- sRGB (IEC 61966-2-1) ----------------------------------------------------------------------------------------

_CODES = np.arange(256) / 255
_LINEAR = np.where(_CODES <= 0.04045, _CODES / 12.92, ((_CODES + 0.055) / 1.055) ** 2.4).astype(np.float32)
"""[256] linear radiance of each sRGB code."""


def _srgb_codes(linear: Floats) -> Codes:
    """Nearest codes of linear radiance, clipped to [0, 1]."""
    x = np.clip(linear, 0, 1)
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
    return (255 * encoded + 0.5).astype(np.uint8)
