"""Depth views on the host."""

from __future__ import annotations

import numpy as np

from server.opencl.engine import Engine
from server.transfer.auxiliary_views import AuxiliaryViews
from tests.reference import image_space as twin
from tests.scenes.volumes import vectors


def host_views(engine: Engine, views: AuxiliaryViews) -> twin.Views:
    drawn = len(views.toward)
    axes = vectors(engine.download(views.axes)[:drawn]).astype(np.float64)[..., :3]
    depths = engine.download(views.depths)[:drawn].astype(np.float64)
    return twin.Views(axes, depths, views.center, views.distance_m, views.per_pixel)
