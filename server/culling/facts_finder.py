"""Finds the facts about each frame of a session (scene_facts.py) that are cheap to find before anything is drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from server.culling.influence_bound import NOWHERE, UNKNOWN, FewSamples, InfluenceBound, MostSent, bound_influence
from server.culling.reason import ALLOWANCE
from server.culling.rules import share_of_codes
from server.culling.scene_facts import SPREAD, Brightness, SceneFacts, most_albedo, most_radiance, most_shading
from server.frame_context import FrameContext
from server.maths.direct_lights import SplitLight
from server.maths.microfacets import most_reflected
from server.objects.rasterize import Placed, boxes_in_view
from server.scene.colors import linear_from_srgb
from server.shading.reflect import is_glossy
from server.shading.shadow_map import most_irradiance
from server.shading.traced_scene import DeviceLight
from server.transfer.samples import TransferSamples

Floats = NDArray[np.float64]

ROUNDING = 1.01
"""Factor by which rounding may raise the volume's colours, which have few bits."""


class FactsFinder:
    """Remembers the brightest picture of a session, and whether the influence of its objects was visible."""

    def __init__(self, *, everything: bool) -> None:
        """`everything`: nothing is culled by a bound, so no bounds are computed."""
        self._everything = everything
        self._brightest = 0.0  # of the pictures so far, in units of the first
        self._few_samples = FewSamples()

    def find(
        self,
        context: FrameContext,
        objects: Sequence[Placed],
        samples: TransferSamples,
        light: DeviceLight,
        sh: Floats,
        split: SplitLight,
        shown: NDArray[np.uint8],
        gain: float,
        *,
        has_indirect: bool,
    ) -> SceneFacts:
        """Facts about a frame. sh: [places, bands^2, 3] of the whole `light`, in the first picture's units; `split`: in
        discs; shown: [h, w, 3] sRGB. has_indirect: surfaces light one another."""
        exposure = context.exposure
        picture_most = _most_shown(shown)
        self._brightest = max(self._brightest, picture_most / exposure)
        whole = exposure * sh
        rest = exposure * split.rest if light.discs else whole

        real = np.full(3, ROUNDING * exposure * self._brightest) if has_indirect else np.zeros(3)
        around = np.maximum(real, light.unseen)
        arriving = np.maximum(np.max([most_radiance(seen) for seen in whole], axis=0), around)
        shading = (
            np.max([most_shading(seen) for seen in rest], axis=0) + most_irradiance(light, objects) + SPREAD * around
        )
        sent = shading * most_albedo(objects) if has_indirect else np.zeros(3)

        boxes = boxes_in_view(context.camera, context.camera_from_volume, objects)
        in_view = [thing for (thing, _), box in zip(objects, boxes, strict=True) if box is not None]
        materials = [thing.tables.materials for thing in in_view]
        is_lit = bool(objects) and bool(arriving.any() or sent.any())
        return SceneFacts(
            objects_in_view=len(in_view),
            adaptive=context.sampling.adaptive,
            indirect=has_indirect,
            glossy=any(is_glossy(table) for table in materials),
            reflected=max((most_reflected(table, albedo=1.0) for table in materials), default=0.0),
            gain=gain,
            brightness=Brightness(
                picture=picture_most,
                arriving=float(arriving.max()),
                shading=float(shading.max()),
                object_sent=float(sent.max()),
                real_sent=float(real.max()),
            ),
            influence=self._influence(context, objects, samples, light, MostSent(sent, real)) if is_lit else NOWHERE,
        )

    def _influence(
        self,
        context: FrameContext,
        objects: Sequence[Placed],
        samples: TransferSamples,
        light: DeviceLight,
        most: MostSent,
    ) -> InfluenceBound:
        """Bound on the influence of the objects on real surface in view."""
        if self._everything or samples.transfer is None:
            return UNKNOWN
        return bound_influence(
            context.engine,
            context.camera,
            context.surface,
            samples.transfer,
            context.volume,
            context.rays,
            context.ray_length_m,
            light,
            samples.indirect,
            objects,
            most,
            share_of_codes(ALLOWANCE),
            context.sampling.upsampling,
            self._few_samples,
        )


def _most_shown(shown: NDArray[np.uint8]) -> float:
    """The greatest linear radiance that rounds to a code of the picture."""
    if not shown.any():
        return 0.0
    return float(linear_from_srgb(np.array(min(float(shown.max(initial=0)) + 0.5, 255.0) / 255.0)))
