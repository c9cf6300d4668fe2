"""The true light at places of synthetic scenes, by tracing the scene that their pictures show."""

from __future__ import annotations

import numpy as np

from client.synthetic.lighting.lamps import lamplight
from client.synthetic.render import irradiance
from client.synthetic.source import SyntheticSource
from server.maths.sh import sh_basis, spherical_fibonacci
from tests.scenes.analytic import Floats

DIRECTIONS = 8192


def light_at(source: SyntheticSource, place: Floats) -> Floats:
    """[16, 3] radiance that arrives at `place` [3] in the first frame, from surfaces, the sky and lamps.

    Surfaces must have textures.
    """
    directions, light = spherical_fibonacci(DIRECTIONS), source.light(0)
    bodies = source.lit_bodies(0)
    solids = [body.solid for body in bodies]
    distances = np.stack([solid.intersect(place, directions) for solid in solids])
    nearest = distances.argmin(axis=0)
    radiance = np.where(np.isinf(distances.min(axis=0))[:, None], light.radiance(directions), 0.0)
    for number, body in enumerate(bodies):
        here = (nearest == number) & np.isfinite(distances[number])
        if here.any():
            points = place + distances[number, here, None] * directions[here]
            normals = body.solid.normals(points)
            assert body.texture is not None
            arriving = irradiance(body, points, normals, light) + lamplight(source.lamps, solids, points, normals)
            radiance[here] = body.texture(points) * arriving
    result = 4 * np.pi / DIRECTIONS * sh_basis(directions, 4).T @ radiance
    for lamp in source.lamps:
        away = lamp.position - place
        if min(solid.intersect(place, away[None])[0] for solid in solids) > 1 - 1e-6:
            squared = float(away @ away)
            result += np.outer(sh_basis(away[None] / np.sqrt(squared), 4)[0], lamp.intensity / squared)
    return np.asarray(result)
