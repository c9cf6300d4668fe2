"""Float64 twin of cl_kernels/composite.cl, layer.cl and of include/upsample.clh."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.special import ndtr

from tests.reference.sh import open_transfer

Floats = NDArray[np.float64]
UNTOUCHED = 1e-5
SAME_SURFACE = 0.005
CLIPPED, DEVIATION = 0.985, 0.4


@dataclass(frozen=True)
class Samples:
    """Values [rows, cols, 4] (w > 0 valid); sample i lies at pixel stride // 2 + i stride."""

    stride: int
    values: Floats


@dataclass(frozen=True)
class Buffer:
    """Positions and normals [h, w, 4] (w = 1 where there is surface), and linear colours [h, w, 3]."""

    positions: Floats
    normals: Floats
    colors: Floats


def srgb_codes(linear: Floats) -> NDArray[np.uint8]:
    """Nearest sRGB codes (IEC 61966-2-1) of linear radiance, clipped to [0, 1]."""
    x = np.clip(linear, 0, 1)
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
    return np.floor(255 * encoded + 0.5).astype(np.uint8)


def cells_of(count: int, stride: int) -> NDArray[np.int_]:
    """[count] the sample before each of a row of pixels; -1 before the first's."""
    return (np.arange(count) - stride // 2) // stride


def upsample(samples: Samples, surface: Buffer, x: int, y: int, tolerance_m: float) -> Floats:
    """[4] joint-bilateral mean of the samples around a pixel: a box four samples wide, times closeness
    to the pixel's tangent plane, times agreement of the normals; w = 0 where none fits.
    """
    (down, v), (right, u) = (
        _around(at, samples.stride, count) for at, count in zip((y, x), samples.values.shape[:2], strict=True)
    )
    around = samples.values[down, right]
    first, stride = samples.stride // 2, samples.stride
    pixels = tuple(slice(first + part.start * stride, first + part.stop * stride, stride) for part in (down, right))
    position, normal = surface.positions[y, x, :3], surface.normals[y, x, :3]
    off_plane = (surface.positions[pixels][..., :3] - position) @ normal / tolerance_m
    facing = np.maximum(surface.normals[pixels][..., :3] @ normal, 0)
    box = np.outer(np.clip(2.5 - np.abs(v), 0, 1), np.clip(2.5 - np.abs(u), 0, 1))
    weights = np.where(around[..., 3] > 0, box * facing**4 / (1 + off_plane**4), 0)
    total = weights.sum()
    return np.array([*np.einsum("rc,rck->k", weights, around[..., :3]) / total, 1]) if total > 1e-4 else np.zeros(4)


def _around(pixel: int, stride: int, count: int) -> tuple[slice, Floats]:
    """Of a row of samples those near a pixel, at most 6, and how far behind it each is, in samples."""
    at = (pixel - stride // 2) / stride
    near = slice(max(int(np.floor(at)) - 2, 0), min(int(np.floor(at)) + 4, count))
    return near, np.arange(near.start, near.stop) - at


_cubic = BSpline.basis_element(np.arange(-2, 3), extrapolate=False)


def upsample_bicubic(samples: Samples, x: int, y: int) -> Floats:
    """[4] cubic B-spline mean of the valid ones of the 4 x 4 samples around a pixel; w = 0 without any."""
    u, v = ((c - samples.stride // 2) / samples.stride for c in (x, y))
    across, down = (
        np.nan_to_num(_cubic(np.arange(n) - at)) for n, at in zip(samples.values.shape[1::-1], (u, v), strict=True)
    )
    weights = np.outer(down, across) * (samples.values[..., 3] > 0)
    total = float(weights.sum())
    return (
        np.array([*(np.einsum("rc,rck->k", weights, samples.values[..., :3]) / total), 1])
        if total > 1e-4
        else np.zeros(4)
    )


def restored(radiance: Floats, x: int, y: int, log_white: Floats) -> Floats:
    """[3] radiance of pixel (x, y) of [h, w, 4]: of clipped channels the mean logarithm, see restored.clh."""
    seen = radiance[y, x, :3]
    clipped = seen >= CLIPPED
    relative = np.log(np.maximum(seen, 1e-4)) - log_white
    brightness = relative[~clipped].mean() if (~clipped).any() else 0.0
    around = radiance[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3].reshape(-1, 4)
    share = (around[around[:, 3] >= 0, :3] >= CLIPPED).mean(axis=0)
    middle = np.maximum(brightness + log_white, -8 * DEVIATION)
    bound = -middle / DEVIATION
    density = np.exp(-(bound**2) / 2) / np.sqrt(2 * np.pi)
    above = middle + DEVIATION * density / ndtr(-bound)  # mean of a normal distribution's part above 0
    return np.where(clipped, np.maximum(seen, np.exp(share * above)), seen)


@dataclass(frozen=True)
class Mixed:
    """What each pixel shows: real surface times `factor`, which is 1 where it is left as it is, and virtual over it."""

    factor: Floats
    """[h, w, 3]."""
    is_touched: NDArray[np.bool_]
    """[h, w] whether real surface is multiplied."""
    own: Floats
    """[h, w, 3] mean radiance of the virtual surface that is seen in it."""
    part: Floats
    """[h, w] of the pixel that it covers."""
    virtual_z: Floats
    """[h, w] camera depth of that of it which covers most, 0 where none is seen."""
    real_z: Floats
    """[h, w] 0 where there is no real surface."""


def pixel_windows(fine: NDArray[Any], f: int) -> NDArray[Any]:
    """[h, w, f + 1, f + 1] the subpixels of each pixel, from border to border. fine: [f h, f w], pixel (x, y) has its
    middle at (f x, f y). Beyond the border of the picture, that on it stands."""
    windows = sliding_window_view(np.pad(fine, f // 2, mode="edge"), (f + 1, f + 1))
    return windows[::f, ::f][: fine.shape[0] // f, : fine.shape[1] // f]


def part_weights(f: int) -> Floats:
    """[f + 1, f + 1] shares of a pixel: subpixels on the border count half for each of two."""
    along = np.array([0.5, *np.ones(f - 1), 0.5]) / f
    return np.outer(along, along)


def covered(fine: NDArray[Any], f: int) -> Floats:
    """[h, w] share of each pixel that `fine` [f h, f w] covers, where it is above 0."""
    return np.asarray((pixel_windows(fine > 0, f) * part_weights(f)).sum((-2, -1)))


def mix(
    radiance: Floats,
    real: Buffer,
    camera_from_volume: Floats,
    tolerance_m: float,
    light: Floats,
    virtual: Buffer | None = None,
    occluded: Samples | None = None,
    ratio: Samples | None = None,
    refined_occluded: Samples | None = None,
    refined_ratio: Samples | None = None,
    bicubic: bool = False,
    inverse_depths: Floats | None = None,
    log_white: Floats | None = None,
) -> Mixed:
    """What is mixed at each pixel: the nearer of virtual and real surface, real ones times `ratio`.

    radiance [h, w, 4]; light [n, 3]. A virtual surface at most `tolerance_m` behind a real one is in front.
    inverse_depths [f h, f w] of the nearest object at subpixels (pixel_windows), 0 for none; else the middle counts.
    log_white [3]: see `restored`; None: clipped channels are taken as they are.
    """
    height, width = radiance.shape[:2]
    fine = np.zeros((height, width)) if inverse_depths is None else inverse_depths
    windows = pixel_windows(fine, fine.shape[0] // height)

    def value_at(samples: Samples, refined: Samples | None, surface: Buffer, x: int, y: int) -> Floats:
        if refined is not None and refined.values[y, x, 3] > 0:
            return upsample(refined, surface, x, y, tolerance_m)
        return upsample_bicubic(samples, x, y) if bicubic else upsample(samples, surface, x, y, tolerance_m)

    def depth(point: Floats) -> float:
        return float(camera_from_volume[2, :3] @ point[:3] + camera_from_volume[2, 3])

    def sources(x: int, y: int) -> dict[tuple[int, int], float]:
        """The pixels whose virtual surface is seen in a pixel, each with the part of it that it covers."""
        assert virtual is not None
        real_z = depth(real.positions[y, x]) if real.positions[y, x, 3] > 0 else np.inf
        if inverse_depths is None:
            is_front = virtual.positions[y, x, 3] > 0 and real_z - depth(virtual.positions[y, x]) > -tolerance_m
            return {(x, y): 1.0} if is_front else {}
        parts = windows[y, x]
        is_seen = (parts > 0) & (real_z + tolerance_m > 1 / np.maximum(parts, 1e-9))
        steps = [(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, -1), (-1, 1), (1, 1)]
        near = [(x + a, y + b) for a, b in steps if 0 <= x + a < width and 0 <= y + b < height]
        depths = {(u, v): depth(virtual.positions[v, u]) for u, v in near if virtual.positions[v, u, 3] > 0}
        found: dict[tuple[int, int], float] = {}
        for part, weight in zip(parts[is_seen], part_weights(len(parts) - 1)[is_seen], strict=True) if depths else ():
            apart = {pixel: abs(part * z - 1) for pixel, z in depths.items()}
            is_own = apart.get((x, y), np.inf) < SAME_SURFACE
            pixel = (x, y) if is_own else min(depths, key=lambda pixel: abs(part - 1 / depths[pixel]))
            found[pixel] = found.get(pixel, 0.0) + weight
        return found

    def virtual_color(u: int, v: int) -> Floats:
        assert virtual is not None
        assert occluded is not None
        taken = value_at(occluded, refined_occluded, virtual, u, v)[:3]
        bands = round(len(light) ** 0.5)
        shading = np.maximum(open_transfer(virtual.normals[v, u, :3], bands) @ light - taken, 0)
        return np.asarray(virtual.colors[v, u] * shading)

    size = (height, width)
    mixed = Mixed(np.ones((*size, 3)), np.zeros(size, bool), np.zeros((*size, 3)), *(np.zeros(size) for _ in range(3)))
    for y, x in np.ndindex(*size):
        here = real.positions[y, x]
        mixed.real_z[y, x] = depth(here) if here[3] > 0 else 0.0
        if ratio is not None and here[3] > 0 and radiance[y, x, 3] >= 0:
            factor = value_at(ratio, refined_ratio, real, x, y)
            if factor[3] > 0 and np.abs(factor[:3] - 1).max() > UNTOUCHED:
                mixed.factor[y, x], mixed.is_touched[y, x] = factor[:3], True
                seen = radiance[y, x, :3]
                if log_white is not None:
                    dimmed = np.minimum(factor[:3] * restored(radiance, x, y, log_white) / np.maximum(seen, CLIPPED), 1)
                    mixed.factor[y, x] = np.where(seen >= CLIPPED, dimmed, factor[:3])
        if virtual is not None and occluded is not None:
            found = sources(x, y)
            if found:
                share = sum(found.values())
                mixed.own[y, x] = sum(part / share * virtual_color(*pixel) for pixel, part in found.items())
                mixed.part[y, x] = 1.0 if radiance[y, x, 3] < 0 else share
                u, v = max(found, key=lambda pixel: found[pixel])
                mixed.virtual_z[y, x] = depth(virtual.positions[v, u])
    return mixed


def composite(shown: NDArray[np.uint8], radiance: Floats, *others: Any, **named: Any) -> NDArray[np.uint8]:
    """The picture [h, w, 3] of what `mix` mixes, untouched pixels as shown."""
    mixed = mix(radiance, *others, **named)
    color = radiance[..., :3] * mixed.factor
    color += mixed.part[..., None] * (mixed.own - color)
    is_changed = mixed.is_touched | (mixed.part > 0)
    return np.where(is_changed[..., None], srgb_codes(color), shown)


def layer(depth_scale_m: float, mixed: Mixed) -> tuple[NDArray[np.uint8], ...]:
    """Codes of colour and coverage [h, w, 4] and of factors [h, w, 3]; depths [h, w] of virtual and of real surface."""

    def depths(z: Floats) -> NDArray[np.uint16]:
        return np.where(z > 0, np.clip(np.floor(z / depth_scale_m + 0.5), 1, 65535), 0).astype(np.uint16)

    is_seen = mixed.part > 0
    colors = np.where(is_seen[..., None], srgb_codes(mixed.own), 0)
    virtual = np.concatenate([colors, np.floor(255 * mixed.part + 0.5)[..., None]], axis=-1).astype(np.uint8)
    ratio = np.clip(np.floor(128 * np.sqrt(mixed.factor) + 0.5), 0, 255).astype(np.uint8)
    return virtual, ratio, depths(mixed.virtual_z), depths(mixed.real_z)
