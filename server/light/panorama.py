"""A lat-long panorama of the surroundings as the light (S2): Csongei's photometric model, a static baseline.

Axes of a panorama: right-handed, +y up, -z along its middle column. The top row looks up, and columns run to the right
as a photograph's do: from behind (+z) over the left (-x), the front (-z) and the right (+x) to behind again. These are
the axes of the 27 WebXR floats, if the middle column is what the first camera looks along.
"""

from __future__ import annotations

from math import pi
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from server.maths.sh import project_panorama

_MOST_COLUMNS = 1024
_MOST_BYTES = 512 * 1024 * 1024

Floats = NDArray[np.float64]


class PanoramaError(ValueError):
    """The file is not a usable panorama; one line."""


def read_panorama(path: Path) -> Floats:
    """[h, w, 3] linear RGB radiance, at most 1024 columns wide. Raises PanoramaError.

    Whatever OpenCV reads: Radiance .hdr above all; 8- and 16-bit pictures are decoded from sRGB, which clips lamps.
    """
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise PanoramaError(f"{path}: {error.strerror or error}") from error
    picture = _decode(data) if 0 < data.size <= _MOST_BYTES else None
    if picture is None:
        raise PanoramaError(f"{path}: not a picture that OpenCV reads (expected a lat-long Radiance .hdr)")
    height, width = picture.shape[:2]
    if abs(width - 2 * height) > 0.02 * width:
        raise PanoramaError(f"{path}: {width}x{height} is not a lat-long panorama, which is twice as wide as high")
    radiance = _linear(picture)
    if not np.isfinite(radiance).all() or radiance.min() < 0:
        raise PanoramaError(f"{path}: radiance must be finite and not negative")
    if not radiance.any():
        raise PanoramaError(f"{path}: is black")
    if width > _MOST_COLUMNS:
        size = (_MOST_COLUMNS, _MOST_COLUMNS // 2)
        radiance = np.asarray(cv2.resize(radiance, size, interpolation=cv2.INTER_AREA), np.float64)
    return radiance


def panorama_sh(panorama: Floats, bands: int) -> Floats:
    """SH [bands^2, 3] of radiance [h, w, 3], in the panorama's own axes."""
    return project_panorama(panorama, bands, panorama_directions(*panorama.shape[:2]))


def panorama_directions(height: int, width: int) -> Floats:
    """[h, w, 3] unit directions of the pixels' centres in the panorama's own axes."""
    polar = pi * (np.arange(height) + 0.5)[:, None] / height
    turn = 2 * pi * (np.arange(width) + 0.5)[None] / width - pi  # to the right, from the middle column
    x, y, z = np.sin(polar) * np.sin(turn), np.cos(polar) + 0 * turn, -np.sin(polar) * np.cos(turn)
    return np.stack([x, y, z], axis=-1)


def _decode(data: NDArray[np.uint8]) -> NDArray[np.generic] | None:
    try:
        picture = cv2.imdecode(data, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR)
    except cv2.error:
        return None
    return None if picture is None else np.asarray(picture)[..., ::-1]


def _linear(picture: NDArray[np.generic]) -> Floats:
    """Float pictures are linear; whole numbers are sRGB codes (IEC 61966-2-1)."""
    if np.issubdtype(picture.dtype, np.floating):
        return picture.astype(np.float64)
    code = picture.astype(np.float64) / (255 if picture.dtype == np.uint8 else 65535)
    return np.asarray(np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4))
