"""What the steps of one frame share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.input.measure import Measurement
from server.maths.rigid import inverse_rigid
from server.opencl.engine import Engine
from server.transfer.radiance_transfer import Directions
from server.transfer.sampling import Sampling
from server.volume.raycast import Surface
from server.volume.volume import Volume


@dataclass(frozen=True)
class FrameContext:
    """One frame once its geometry is known. Device arrays are the session's and valid until its next frame."""

    engine: Engine
    camera: CameraModel
    volume: Volume
    volume_from_camera: NDArray[np.float64]
    """[4, 4] rigid."""
    measurement: Measurement
    """The input of this frame, on the device."""
    surface: Surface
    """The hybrid geometry buffer (thesis 4.2.2)."""
    scene_radiance: cl_array.Array
    """[h, w] float4: `measurement.radiance` over `exposure`."""
    exposure: float
    """Exposure of the picture, relative to the session's first picture."""
    sampling: Sampling
    rays: Directions
    """Directions that visibility is tested along."""
    ray_length_m: float
    smooth_edges: bool = True
    """Whether virtual objects may cover parts of pixels."""
    restores_clipped: bool = True
    """Whether shadows fall on the likely radiance of clipped surface; not in the thesis."""
    waits_for_light: bool = True
    """Whether the frame waits for the light that is worked out beside it: the same frames then give the same light on
    any machine. Else it is drawn with the newest there is."""
    follows_light: bool = True
    """Whether all is drawn as the light of this very frame has it; else what was found under nearly the same light is
    used (kept_discs.py, kept_shadows.py)."""

    @property
    def camera_from_volume(self) -> NDArray[np.float64]:
        """[4, 4] rigid."""
        return inverse_rigid(self.volume_from_camera)
