"""Gathers the facts of one session's frames (scene_facts.py): what is cheap to know before anything is drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from server.culling.influence_bound import UNKNOWN, InfluenceBound, MostSent, bound_influence
from server.culling.reason import ALLOWANCE
from server.culling.rules import share_of_codes
from server.culling.scene_facts import SceneFacts, gather_facts
from server.effects.functions import View
from server.geometry.geometry import GeometryFrame
from server.maths.direct_lights import split_light
from server.maths.rigid import inverse_rigid
from server.objects.rasterize import Placed, boxes_in_view
from server.scene.colors import linear_from_srgb
from server.shading.tone_mapping import Averages
from server.shading.traced_scene import DeviceLight
from server.transfer.indirect import Indirect
from server.transfer.radiance_transfer import Directions, Transfer
from server.volume.volume import Volume

ROUNDING = 1.01
"""By which the volume's colours may exceed what was put in: they have few bits."""


class FactsFinder:
    """One session's."""

    def __init__(self, *, everything: bool) -> None:
        """`everything`: what would be left out as needless is not asked for."""
        self._everything = everything
        self._brightest = 0.0  # of the pictures so far, in units of the first

    def find(
        self,
        view: View,
        geometry: GeometryFrame,
        volume: Volume,
        rays: Directions,
        transfer: Transfer | None,
        indirect: Indirect | None,
        objects: Sequence[Placed],
        light: DeviceLight,
        sh: NDArray[np.float64],
        shown: NDArray[np.uint8],
        averages: Averages | None,
    ) -> SceneFacts:
        """Facts of a frame. sh: [bands^2, 3] of all of `light`, in the first picture's units; shown: [h, w, 3] sRGB."""
        picture_most = float(linear_from_srgb(np.array(min(float(shown.max(initial=0)) + 0.5, 255.0) / 255.0)))
        if not shown.any():
            picture_most = 0.0
        self._brightest = max(self._brightest, picture_most / geometry.exposure)

        def measure(most: MostSent) -> InfluenceBound:
            if self._everything or transfer is None:
                return UNKNOWN
            return bound_influence(
                view.engine,
                view.camera,
                geometry.surface,
                transfer,
                volume,
                rays,
                view.reach_m,
                light,
                indirect,
                objects,
                most,
                share_of_codes(ALLOWANCE),
                view.sampling.upsampling,
            )

        return gather_facts(
            objects,
            boxes_in_view(view.camera, inverse_rigid(view.volume_from_camera), objects),
            view.sampling,
            view.smooth_edges,
            light,
            geometry.exposure * sh,
            geometry.exposure * split_light(sh).rest if light.discs else geometry.exposure * sh,
            indirect is not None,
            picture_most,
            ROUNDING * geometry.exposure * self._brightest,
            averages,
            measure,
        )
