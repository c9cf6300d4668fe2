"""A box of a room in closed form, lit by a wall: two other walls and the half of the floor away from the light were
scanned, and shown as exact pictures would."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from server.light.shell.patches import Patches, hemisphere_weights, ray_directions
from server.light.shell.picture import Seen
from server.light.shell.shell import Shell
from server.light.shell.transport import Transport
from tests.scenes.analytic import Floats
from tests.scenes.shell_room import CAMERA, NO_EMITTERS, SIZE_M, SPACING_M, UP
from tests.scenes.shells import shell_of

LIGHT, REST = 4.0, 0.35
"""Radiance of the wall x = SIZE_M[0], and of the other walls and the ceiling."""
WALL, FLOOR = np.array([0.6, 0.6, 0.57]), np.array([0.45, 0.3, 0.2])
"""Albedos."""
GRID_M = 0.05
"""Spacing of the points at which the floor's light is worked out."""
SCANNED_M = 1.6
"""Floor up to here along x was scanned."""


def floor_radiance(points: Floats) -> Floats:
    """[n, 3] what the floor sends at `points` [n, 3]: what arrives there from walls and ceiling, by its albedo."""
    weights = hemisphere_weights(np.array([UP]))[0]
    rays = ray_directions()[weights > 0]
    axis, _, toward = _ends(points, np.broadcast_to(rays, (len(points), *rays.shape)))
    arriving = np.where((axis == 0) & toward, LIGHT, REST) @ weights[weights > 0]
    return np.asarray(arriving[:, None] * FLOOR)


def _floor_nearby(points: Floats) -> Floats:
    """[n, 3] floor_radiance, of a grid's point at most 4 cm away."""
    count = np.ceil(SIZE_M[:2] / GRID_M).astype(int)
    middles = np.stack(np.meshgrid(*((np.arange(n) + 0.5) * GRID_M for n in count), indexing="ij"), axis=-1).reshape(
        -1, 2
    )
    sent = floor_radiance(np.pad(middles, ((0, 0), (0, 1)))).reshape(*count, 3)
    row, column = np.clip(points[:, :2] / GRID_M, 0, count - 1).astype(int).T
    return np.asarray(sent[row, column])


def half_floor_room() -> tuple[Patches, Transport, Shell]:
    """The room ready to be solved."""
    at, facing, albedo = _scanned()
    axis, ends, toward = _ends(at, np.broadcast_to(ray_directions(), (len(at), *ray_directions().shape)))
    is_floor, is_light = (axis == 2) & ~toward, (axis == 0) & toward
    radiance = np.where(is_light[..., None], LIGHT, np.full((*axis.shape, 3), REST))
    radiance[is_floor] = _floor_nearby(ends[is_floor])
    is_scanned = ~toward & ((axis < 2) | (ends[..., 0] < SCANNED_M))
    arrivals = np.zeros((*axis.shape, 4))
    arrivals[is_scanned, :3] = radiance[is_scanned]
    arrivals[is_scanned, 3] = np.linalg.norm(ends - at[:, None], axis=-1)[is_scanned]
    shown = np.log(albedo * np.einsum("nm,nmr->nr", hemisphere_weights(facing), radiance))
    patches = Patches()
    patches.add(Seen(at, facing, shown, np.zeros(len(at)), np.zeros(len(at))))
    rows = patches.seen
    order = np.array([np.abs(at - position).sum(1).argmin() for position in patches.positions[rows]])
    patches.traced_normals[rows], patches.arrivals[rows] = patches.normals[rows], arrivals[order]
    patches.traced_in[rows] = 1
    shell = shell_of(at, facing, np.stack([CAMERA, SIZE_M - 0.5]), UP, patches.area_m2)
    transport = Transport()
    transport.update(patches, NO_EMITTERS, rows, shell)
    return patches, transport, shell


def _scanned() -> tuple[Floats, Floats, Floats]:
    """[n, 3] places, normals and albedos of what was scanned."""
    places, normals, albedos = [], [], []
    for axis, color in ((0, WALL), (1, WALL), (2, FLOOR)):
        first, second = (other for other in range(3) if other != axis)
        u, v = np.meshgrid(*(np.arange(SPACING_M / 2, SIZE_M[other], SPACING_M) for other in (first, second)))
        at = np.full((u.size, 3), 1e-4)
        at[:, first], at[:, second] = u.ravel(), v.ravel()
        at = at[at[:, 0] < (SCANNED_M if axis == 2 else np.inf)]
        places.append(at)
        normals.append(np.tile(np.eye(3)[axis], (len(at), 1)))
        albedos.append(np.tile(color, (len(at), 1)))
    return np.concatenate(places), np.concatenate(normals), np.concatenate(albedos)


def _ends(points: Floats, directions: Floats) -> tuple[NDArray[np.int64], Floats, NDArray[np.bool_]]:
    """[n, m] the axis across which rays from `points` [n, 3] along `directions` [n, m, 3] leave the room, [n, m, 3]
    where, and [n, m] whether at its far end."""
    with np.errstate(divide="ignore"):
        far = np.where(directions > 0, SIZE_M - points[:, None], -points[:, None]) / directions
    far = np.where(np.isfinite(far) & (far > 1e-9), far, np.inf)
    axis = far.argmin(-1)
    ends = points[:, None] + far.min(-1)[..., None] * directions
    return axis, ends, np.take_along_axis(directions, axis[..., None], -1)[..., 0] > 0
