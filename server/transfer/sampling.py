"""Sampling of radiance transfer (thesis ch. 6): the accelerations, each a switch, and the presets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pyopencl.array import Array

from protocol.frames import CameraModel
from server.opencl.engine import Engine
from server.transfer.auxiliary_views import VIEWS
from server.transfer.image_space import ImageSpaceTransfer
from server.transfer.radiance_transfer import TURNS, Directions, Transfer, direction_sets, transfer_radiance
from server.transfer.real_depth_views import RealDepthViews
from server.transfer.visibility_cache import VisibilityCaches
from server.transfer.visibility_state import VisibilityState
from server.volume.raycast import Surface
from server.volume.volume import Volume

_MOST_DIRECTIONS = 1024
Upsampling = Literal["bilateral", "bicubic"]


@dataclass(frozen=True)
class Sampling:
    """The accelerations of thesis ch. 6 that a session uses."""

    stride: int
    """A1: spacing of the transfer's samples in pixels, for the light and for shading."""
    interleave: int = 1
    """A3, A4: number of subsets of the directions. A frame traces one; the others come from earlier frames."""
    rays_per_frame: bool = False
    """Whether `rays` counts the directions of one frame, so that a sample has `interleave` times as many."""
    adaptive: bool = False
    """A2: shading is sampled at every pixel where virtual objects make it change from pixel to pixel."""
    upsampling: Upsampling = "bilateral"
    """A5: interpolation of shading from samples to pixels; the thesis uses bicubic."""
    visibility_state: bool = False
    """A6: no rays where the volume is known to be open; useful with short rays."""
    turning: bool = True
    """Frames cycle through direction sets after each round of the subsets, so that their errors differ: a light from
    several frames is more accurate, but the shading of a still view flickers slightly."""
    image_space: bool = False
    """A7, A8: visibility is looked up in depth views instead of traced; A3, A4 and A6 do not apply."""
    views: int = VIEWS
    """Number of depth views besides the camera's own."""

    def __post_init__(self) -> None:
        if self.image_space and (self.interleave > 1 or self.visibility_state):
            raise ValueError("image-space visibility has no rays to interleave or to leave out")

    def directions(self, rays: int) -> int:
        """Directions of one sample, for a session with this `rays` setting."""
        return max(rays, min(rays * self.interleave, _MOST_DIRECTIONS)) if self.rays_per_frame else rays


PRESETS = {
    "rm": Sampling(stride=1),
    "reg4": Sampling(stride=4),
    "reg8": Sampling(stride=8),
    "art1": Sampling(stride=1, interleave=4, turning=False),
    "art4": Sampling(stride=4, interleave=4, rays_per_frame=True, adaptive=True),
    "art8": Sampling(stride=8, interleave=4, rays_per_frame=True, adaptive=True),
    "gr15": Sampling(stride=1, image_space=True),
    "gr15fast": Sampling(stride=4, image_space=True, views=384),
}
"""Thesis 6.1.3.1 and 6.2.3; RM is its GR12, ART4 its GR14. The number is the spacing in pixels. ART traces a fourth of
its directions in each frame. In the thesis a frame traces a fourth of RM's; here it traces as many as RM, so a sample
has four times as many: still several times faster, with a light nearer to RM's. Where transfer is kept at places of the
world, a sample has as many directions, traced at once.

GR15FAST's views are 10 degrees apart, GR15's 6: of 384 views transfer is 2 % farther from 810 traced rays than of 1024
(256: 6 %), and the moving lights of E1 are off by 4.5 degrees instead of 4.3. Drawing the views of a
volume that grows is most of its transfer's time."""


class TransferSampler:
    """Radiance transfer of one session, with its caches from earlier frames."""

    def __init__(
        self,
        engine: Engine,
        camera: CameraModel,
        sampling: Sampling,
        rays: int,
        bands: int,
        *,
        has_places: bool = False,
    ) -> None:
        """`rays`: directions of a sample in all subsets, or in one, see `Sampling.rays_per_frame`.

        `has_places`: transfer is kept at places of the world (transfer_cache.py), unless there is a visibility state. A
        place is traced rarely, and then along all its directions: nothing is left to interleave.
        """
        self._engine = engine
        self._camera = camera
        self.sampling = sampling
        self.is_kept = has_places and not sampling.visibility_state
        """Whether samples of earlier frames are told to `transfer`."""
        self.rays: Directions = direction_sets(sampling.directions(rays), bands, sampling.interleave)
        self._caches = VisibilityCaches(engine, sampling.interleave) if self._interleave > 1 else None
        self._state: VisibilityState | None = None
        self._frame = -1
        self._image_space = ImageSpaceTransfer(engine, self.rays, sampling.views) if sampling.image_space else None

    @property
    def depth_views(self) -> RealDepthViews | None:
        """The depth views of the last transfer; None if it traced rays."""
        return self._image_space.depth_views if self._image_space else None

    @property
    def _interleave(self) -> int:
        """Frames that trace the directions of a sample between them."""
        return 1 if self.is_kept else self.sampling.interleave

    @property
    def period(self) -> int:
        """Number of frames after which a still view gets the same samples again."""
        return (TURNS if self.sampling.turning else 1) * self._interleave

    def pass_frame(self) -> None:
        """Advance the sequence of direction sets for a frame without transfer."""
        self._frame += 1

    def transfer(
        self,
        volume: Volume,
        surface: Surface,
        volume_from_camera: NDArray[np.float64],
        up: NDArray[np.float64],
        ray_length_m: float,
        found: Array | None = None,
    ) -> Transfer:
        """Transfer of the real world without virtual objects; rays of at most `ray_length_m`; `up` unit, world axes.

        found: of transfer_cache.py, samples that keep their values; if and only if `is_kept`.
        """
        engine, camera, sampling = self._engine, self._camera, self.sampling
        self._frame += 1
        turn = (
            self._frame // self._interleave if sampling.turning else 0
        )  # subsets of the same set are the most evenly spread
        if self._image_space:
            return self._image_space.transfer(
                camera, volume_from_camera, volume, surface, sampling.stride, ray_length_m, turn=turn, found=found
            )
        if self._caches:
            self._caches.begin_frame(camera, volume_from_camera, sampling.stride, self.rays.count, ray_length_m)
        if sampling.visibility_state:
            self._state = self._state or VisibilityState(engine, volume, camera, up)
            self._state.validate(volume_from_camera, ray_length_m)
        result = transfer_radiance(
            engine,
            camera,
            volume,
            surface,
            sampling.stride,
            self.rays,
            ray_length_m,
            self._caches,
            self._state,
            turn,
            found=found,
        )
        if self._state:
            self._state.learn(surface, camera, sampling.stride, result.openness)
        return result
