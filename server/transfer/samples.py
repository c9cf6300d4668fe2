"""The radiance transfer of one frame at its samples, and the indirect light there (thesis 5.1.2, 7.3.3)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel
from protocol.messages import LeftOut
from server.opencl.engine import Engine
from server.transfer.indirect import Indirect, MeanSent, gather_hits, observe_indirect
from server.transfer.kept_bounds import KeptBounds, kept_left_out
from server.transfer.radiance_transfer import Directions, Transfer
from server.transfer.real_depth_views import RealDepthViews
from server.transfer.sampling import Sampling, TransferSampler
from server.transfer.transfer_cache import CHECKS, ORDERS, PARTS, PERIOD_OF_VIEWS, TransferCache
from server.volume.raycast import Surface
from server.volume.volume import Volume

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TransferSamples:
    """Transfer and indirect light of one frame."""

    transfer: Transfer | None
    """None: nothing needs it."""
    indirect: Indirect | None
    """None: not modelled."""


NO_SAMPLES = TransferSamples(None, None)


class SampledTransfer:
    """Radiance transfer of one session, with the indirect light at the samples."""

    def __init__(
        self, engine: Engine, camera: CameraModel, sampling: Sampling, rays: int, bands: int, *, is_cached: bool = False
    ) -> None:
        """`is_cached`: transfer of earlier frames is used at the places where it was found (transfer_cache.py), unless
        there is a visibility state."""
        self._engine = engine
        self._camera = camera
        self._bands = bands
        self._cache = TransferCache(engine) if is_cached else None
        self._sampler = self._sampler_for(sampling, rays)
        self._mean_sent = MeanSent()
        self._has_found = self._has_begun = False

    def use(self, sampling: Sampling, rays: int) -> None:
        """Change the sampling. Visibility of earlier frames is forgotten."""
        self._sampler = self._sampler_for(sampling, rays)
        if self._cache:
            self._cache.forget()

    def _sampler_for(self, sampling: Sampling, rays: int) -> TransferSampler:
        has_places = self._cache is not None
        return TransferSampler(self._engine, self._camera, sampling, rays, self._bands, has_places=has_places)

    @property
    def sampling(self) -> Sampling:
        """The current sampling."""
        return self._sampler.sampling

    @property
    def rays(self) -> Directions:
        """Directions that visibility is tested along."""
        return self._sampler.rays

    @property
    def depth_views(self) -> RealDepthViews | None:
        """The depth views of the last transfer; None if it traced rays."""
        return self._sampler.depth_views

    @property
    def period(self) -> int:
        """Number of frames after which a still view gets the same samples again."""
        return self._sampler.period

    def skip_frame(self) -> None:
        """Advance the sequence of direction sets for a frame without transfer."""
        self._sampler.pass_frame()
        self._has_found = False

    def left_out(self, bounds: KeptBounds) -> tuple[LeftOut, ...]:
        """What of the last frame's transfer may have been found instead of traced. bounds: of what is drawn with it."""
        if not self._has_found or self._cache is None:
            return ()
        if self._sampler.sampling.image_space:
            looks = f"looked up again after {PERIOD_OF_VIEWS + ORDERS} frames at most"
        else:
            looks = f"all its rays are traced again in {CHECKS * PARTS} frames, to see whether they changed"
        reason = f"kept at the same place of the world; in view, {looks}"
        bound = bounds.known if self._cache.has_looked_again or not bounds.known else None
        known = kept_left_out("transfer_of_known_places", reason, bound)
        share = self._cache.share_waiting()
        if share == 0.0:
            return (known,)
        waits = f"{share:.1%} of the samples wait for their turn: new ones take the values of one beside them"
        return known, kept_left_out("transfer_of_new_places", waits, bounds.lent)

    def sample(
        self,
        volume: Volume,
        surface: Surface,
        volume_from_camera: Floats,
        up: Floats,
        ray_length_m: float,
        *,
        with_indirect: bool,
        is_kept: bool = False,
        renews: bool = False,
    ) -> TransferSamples:
        """Transfer of the real world without virtual objects (eq. 5.2). up: [3] unit, world axes. is_kept: frames to
        come are drawn with it, so that all samples are traced; renews: what was kept is found anew, too. No sample
        waits for its turn in a session's first frame, most of whose time is the light's anyway: virtual things would
        stand in a wrong light until the seventh. With samples at all pixels, those beside them are near enough, and all
        would take a second."""
        engine, camera, rays = self._engine, self._camera, self._sampler.rays
        cache, found = self._cache if self._sampler.is_kept and not is_kept else None, None
        self._has_found = cache is not None
        if cache:
            is_traced = not self._sampler.sampling.image_space
            stride, is_first = self._sampler.sampling.stride, not self._has_begun
            view = camera, volume, surface, volume_from_camera, stride
            found = cache.find(
                *view,
                rays,
                ray_length_m,
                is_traced=is_traced,
                with_hits=with_indirect,
                traces_all=is_first and stride > 1,
                renews=renews,
            )
        self._has_begun = True
        transfer = self._sampler.transfer(volume, surface, volume_from_camera, up, ray_length_m, found)
        hits = None
        if with_indirect:
            hits = gather_hits(engine, camera, volume, surface, transfer, rays, ray_length_m, found=found)
        if cache:  # after it all samples have their values
            transfer = replace(transfer, cells=cache.store())
        sent = (
            None if hits is None else observe_indirect(engine, transfer, rays, hits, self._mean_sent, is_kept=is_kept)
        )
        return TransferSamples(transfer, sent)
