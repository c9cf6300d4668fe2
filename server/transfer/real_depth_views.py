"""Depth views of real surfaces for visibility look-ups (thesis 6.2.1, 7.3.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.transfer.auxiliary_views import AuxiliaryViews
from server.volume.raycast import Surface

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RealDepthViews:
    """Depth views of real surfaces for shading."""

    views: AuxiliaryViews
    view_of: NDArray[np.int32]
    """[SETS, count] the view whose axis is nearest to each direction."""
    camera: CameraModel
    camera_from_volume: Floats
    surface: Surface
    """The surface that the camera sees."""
    depths: cl_array.Array
    """[h, w] float32: of `surface`, see `camera_depths` of image_space.py."""
    near_m: float
    """Up to this distance the camera's picture is used, which is finer than the views."""
    ratio: float
    """Ratio of the distances of neighbouring samples in the camera's picture."""
    threshold: float
    """chi of eq. 6.3."""
