"""Float64 twin of cl_kernels/frame_difference.cl: what a picture differs by from a mean, tile by tile."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def is_known(values: Floats) -> NDArray[np.bool_]:
    """All of colour [h, w, 3]; of depth [h, w] what is neither 0 nor 65535."""
    return np.ones(values.shape, bool) if values.ndim > 2 else (values > 0) & (values < 65535)


def mean_of(pictures: list[Floats]) -> Floats:
    """The mean as it runs: the n-th picture moves it by 1/n of what it differs by."""
    mean = np.zeros(pictures[0].shape)
    for number, picture in enumerate(pictures, 1):
        news, known = is_known(picture), is_known(mean) if number > 1 else np.zeros(mean.shape, bool)
        mean = np.where(news & known, mean + (picture - mean) / number, np.where(news, picture, mean))
    return mean


def differences(picture: Floats, mean: Floats, tile: int = 8) -> Floats:
    """[tiles, 4] sum of what is known to both and differs, of its squares, their number, and what is known to one."""
    now, before = is_known(picture), is_known(mean)
    rows = []
    for y in range(0, picture.shape[0], tile):
        for x in range(0, picture.shape[1], tile):
            part = np.s_[y : y + tile, x : x + tile]
            both = now[part] & before[part]
            off = (picture[part] - mean[part])[both]
            rows.append([off.sum(), (off**2).sum(), both.sum(), (now[part] ^ before[part]).sum()])
    return np.array(rows, np.float64)
