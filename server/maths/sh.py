"""Real spherical harmonics: orthonormal, no Condon-Shortley phase, index l(l+1)+m, coefficients of radiance.

Y_1-1 = +0.488603 y, Y_10 = +0.488603 z, Y_11 = +0.488603 x. The Lambert transfer carries 1/pi: a white surface under a
uniform sky of radiance 1 shades to 1.
"""

from __future__ import annotations

from functools import lru_cache
from math import factorial, pi, sqrt

import numpy as np
from numpy.typing import NDArray

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Rec. 709 luminance of linear RGB."""

LAMBERT_BANDS = np.array([1.0, 2 / 3, 1 / 4, 0.0, -1 / 24, 0.0])
"""Clamped cosine / pi per band (Ramamoorthi & Hanrahan 2001, eq. 8)."""

_DIRECTIONAL = 16 * pi / 17
"""Scale of Y(d) that gives a directional light irradiance 1 at order 2 (Sloan 2008)."""


def band_of(coefficients: int) -> NDArray[np.int64]:
    """Band l of each coefficient index 0 .. coefficients - 1."""
    band: NDArray[np.int64] = np.sqrt(np.arange(coefficients)).astype(np.int64)
    return band


def sh_basis(directions: NDArray[np.float64], bands: int) -> NDArray[np.float64]:
    """Basis functions at unit `directions` [..., 3] -> [..., bands^2] (Sloan 2013, Legendre recurrence)."""
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    values = np.empty((*x.shape, bands * bands))
    cosine, sine, diagonal = np.ones_like(x), np.zeros_like(x), 1.0
    for m in range(bands):
        before, here = np.zeros_like(x), np.full_like(x, diagonal)
        for l in range(m, bands):
            scale = sqrt((2 * l + 1) / (4 * pi) * factorial(l - m) / factorial(l + m)) * (sqrt(2) if m else 1)
            values[..., l * (l + 1) + m] = scale * here * cosine
            if m:
                values[..., l * (l + 1) - m] = scale * here * sine
            before, here = here, ((2 * l + 1) * z * here - (l + m) * before) / (l - m + 1)
        diagonal *= 2 * m + 1
        cosine, sine = cosine * x - sine * y, cosine * y + sine * x
    return values


def lambert_transfer(normals: NDArray[np.float64], bands: int) -> NDArray[np.float64]:
    """Transfer of an unoccluded Lambertian surface of albedo 1 with unit `normals` [..., 3] -> [..., bands^2]."""
    transfer: NDArray[np.float64] = sh_basis(normals, bands) * LAMBERT_BANDS[band_of(bands * bands)]
    return transfer


GOLDEN_TURN = (3 - sqrt(5)) / 2
"""Share of a full turn by which successive points of a spherical Fibonacci lattice advance."""


BUNDLE = 8
"""Directions of a work-item (include/lanes.clh)."""


def spherical_fibonacci(count: int, advance: float = GOLDEN_TURN) -> NDArray[np.float64]:
    """`count` unit directions [count, 3] of nearly equal solid angle 4 pi / count; `advance` in full turns."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    azimuth = index * (2 * pi * advance)
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], -1)


def in_bundles(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """[n, 3] the same, in an order in which BUNDLE that follow each other point about the same way.

    Rays that are traced together then take about the same path.
    """
    return np.asarray(directions[_bundled(directions, np.arange(len(directions)))])


def _bundled(directions: NDArray[np.float64], chosen: NDArray[np.int64]) -> NDArray[np.int64]:
    """`chosen`, halved along the axis along which they are spread the most, and so on."""
    if len(chosen) <= BUNDLE:
        return chosen
    parts = directions[chosen]
    chosen = chosen[np.argsort(parts[:, np.ptp(parts, axis=0).argmax()], kind="stable")]
    half = -(-len(chosen) // (2 * BUNDLE)) * BUNDLE
    return np.concatenate([_bundled(directions, chosen[:half]), _bundled(directions, chosen[half:])])


def rotate_sh(coefficients: NDArray[np.float64], rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients [n, ...] of the function turned by `rotation` [3, 3]: g(d) = f(rotation^T d).

    Each band is turned through its values at more directions than it has coefficients, which determines it exactly.
    """
    bands = round(sqrt(len(coefficients)))
    probes = spherical_fibonacci(4 * bands * bands + 8)
    turned, fixed = sh_basis(probes @ rotation, bands), sh_basis(probes, bands)
    result = np.empty_like(coefficients)
    for l in range(bands):
        band = slice(l * l, (l + 1) * (l + 1))
        result[band] = np.linalg.lstsq(fixed[:, band], turned[:, band] @ coefficients[band], rcond=None)[0]
    return result


def sh_rotation(rotation: NDArray[np.float64], bands: int) -> NDArray[np.float64]:
    """Matrix [bands^2, bands^2] by which `rotate_sh` turns coefficients. Remembered: worlds turn rarely."""
    return _sh_rotation(np.ascontiguousarray(rotation, np.float64).tobytes(), bands)


@lru_cache(maxsize=32)
def _sh_rotation(rotation: bytes, bands: int) -> NDArray[np.float64]:
    matrix = rotate_sh(np.eye(bands * bands), np.frombuffer(rotation).reshape(3, 3))
    matrix.flags.writeable = False
    return matrix


def luminance_sh(coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Luminance [n] of RGB coefficients [n, 3]."""
    return np.asarray(coefficients @ LUMINANCE)


def dominant_direction(coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit vector towards the light from l = 1 of the luminance of [n, 3]; zeros where there is none (thesis P4)."""
    luminance = luminance_sh(coefficients)
    vector = np.array([luminance[3], luminance[1], luminance[2]])
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-12 else np.zeros(3)


def dominant_intensity(coefficients: NDArray[np.float64]) -> float:
    """Luminance of a directional light along the dominant direction, irradiance 1 per unit on a facing white surface.

    Least squared error of the *irradiance* with a free ambient term, order 2: 867 / (316 pi) sum A_l^2 L_i Ld_i over
    i >= 1, Ld = (16 pi / 17) Y(d) (after Sloan 2008). Negative results mean no directional light: 0.
    """
    direction = dominant_direction(coefficients)
    if not direction.any():
        return 0.0
    count = min(9, len(coefficients))
    directional = _DIRECTIONAL * sh_basis(direction, 3)[1:count]
    weights = LAMBERT_BANDS[band_of(count)][1:] ** 2
    return max(0.0, float(867 / (316 * pi) * np.sum(weights * luminance_sh(coefficients)[1:count] * directional)))


def webxr_from_world(up: NDArray[np.float64], view: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation [3, 3] into axes with unit `up` as +y and the camera's `view` direction as near to -z as it goes."""
    back = -(view - np.dot(view, up) * up)
    if np.linalg.norm(back) < 1e-6:  # looking along up: any horizontal axis will do
        back = np.eye(3)[int(np.argmin(np.abs(up)))]
        back = back - np.dot(back, up) * up
    back = back / np.linalg.norm(back)
    return np.stack([np.cross(up, back), up, back])


def webxr_floats(coefficients: NDArray[np.float64], rotation: NDArray[np.float64]) -> tuple[float, ...]:
    """The 27 floats of the WebXR Lighting Estimation layout of [n >= 4, 3], zeros for bands not estimated."""
    nine = np.zeros((9, 3))
    kept = coefficients[:9]
    nine[: len(kept)] = kept
    return tuple((sh_rotation(rotation, 3) @ nine).ravel().tolist())


def project_panorama(panorama: NDArray[np.float64], bands: int, directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """SH [bands^2, 3] of a lat-long panorama [h, w, 3] of radiance whose pixels look along `directions` [h, w, 3].

    Top row towards the first pole; a pixel's solid angle is (2 pi / w) times the difference of its rows' cosines.
    """
    height, width = panorama.shape[:2]
    rows = np.cos(np.linspace(0, pi, height + 1))
    solid_angle = (rows[:-1] - rows[1:]) * (2 * pi / width)
    result = np.zeros((bands * bands, 3))
    for row in range(height):
        result += solid_angle[row] * sh_basis(directions[row], bands).T @ panorama[row]
    return result
