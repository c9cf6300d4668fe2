"""A box of a room in closed form: floor and two walls were scanned, a lamp hangs on the ceiling that was not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from server.light.shell.bright_surface import BrightSurface
from server.light.shell.evidence import Evidence, evidence_of
from server.light.shell.objective import step
from server.light.shell.patches import RAYS, Patches, hemisphere_weights, ray_directions
from server.light.shell.picture import Seen
from server.light.shell.shell import Shell, closed_sides
from server.light.shell.sources import Sources, distant_sources, near_sources
from server.light.shell.switches import Switches
from server.light.shell.transport import Transport
from server.light.shell.unknowns import Unknowns
from server.light.shell.view import View
from tests.scenes.analytic import Floats
from tests.scenes.shells import shell_of

SIZE_M = np.array([4.0, 3.6, 2.4])
CAMERA = np.array([3.0, 2.6, 1.5])
UP = np.array([0.0, 0.0, 1.0])
AWAY = View(CAMERA, np.eye(3), (0.0, 0.0), (0.0, 0.0))
"""A camera there that has nothing in its frame."""
SPACING_M = 0.2
KNOWN = np.array([0.22, 0.2, 0.18])
"""Radiance that the scanned surfaces send."""
NO_EMITTERS = BrightSurface().seen_by()
ALBEDOS = {0: (0.6, 0.3, 0.2), 1: (0.55, 0.55, 0.5), 2: (0.3, 0.4, 0.6)}
"""Of the wall x = 0, the wall y = 0 and the floor: red, white and blue."""


OPEN = [(0.6, 0.5, 0.6), (0.9, 0.1, 0.4), (0.3, 0.3, 0.9)]
"""Directions of light that comes in at the sides that are not scanned."""


@dataclass(frozen=True)
class Lamp:
    """A square on the ceiling."""

    center: tuple[float, float]
    side_m: float
    radiance: tuple[float, float, float]


@dataclass
class ShellRoom:
    """A room ready to be solved."""

    patches: Patches
    transport: Transport
    shell: Shell
    unknowns: Unknowns

    @property
    def evidence(self) -> Evidence:
        """What its patches show."""
        return evidence_of(self.patches, self.patches.used, Switches())

    @property
    def near(self) -> Sources:
        """The shell's cells."""
        return near_sources(self.transport, self.shell, self.patches, self.evidence.rows)

    def distant(self, *, with_indirect: bool = True) -> Sources:
        """Lobes, and the cells of sides that were scanned."""
        rows, area_m2 = self.patches.used, self.patches.area_m2
        closed = closed_sides(self.patches.positions[rows], self.patches.normals[rows], self.shell.axes, area_m2)
        up = self.shell.axes[2]
        return distant_sources(self.transport, closed, up, self.evidence.rows, with_indirect=with_indirect)

    def solve(self, steps: int) -> None:
        """Take steps towards the light of the shell."""
        evidence, near = self.evidence, self.near
        for _ in range(steps):
            step(self.unknowns, evidence, near)


def sent(
    points: Floats, directions: Floats, lamp: Lamp | None, ambient: Floats, known: Floats = KNOWN
) -> tuple[Floats, Floats]:
    """Radiance [n, m, 3] that arrives at `points` [n, 3] along `directions` [n, m, 3], and the arrivals [n, m, 4].

    ambient: [3], or [n, m, 3] from beyond the open sides. known: [3] that the scanned ones send.
    """
    with np.errstate(divide="ignore"):
        far = np.where(directions > 0, SIZE_M - points[:, None], -points[:, None]) / directions
    far = np.where(np.isfinite(far) & (far > 1e-9), far, np.inf)
    axis, distance = far.argmin(-1), far.min(-1)
    along = np.take_along_axis(directions, axis[..., None], -1)[..., 0]
    is_scanned = along < 0  # the faces x = 0, y = 0 and z = 0
    ends = points[:, None] + distance[..., None] * directions
    radiance = np.where(is_scanned[..., None], known, ambient)
    if lamp is not None:
        on_ceiling = (axis == 2) & (along > 0)
        inside = np.all(np.abs(ends[..., :2] - lamp.center) < lamp.side_m / 2, axis=-1)
        radiance = np.where((on_ceiling & inside)[..., None], lamp.radiance, radiance)
    arrivals = np.zeros((*distance.shape, 4))
    arrivals[is_scanned, :3], arrivals[is_scanned, 3] = known, distance[is_scanned]
    return radiance, arrivals


def sky(towards: Floats) -> Callable[[Floats], Floats]:
    """A dim even sky and a soft sun, 25 degrees wide."""
    to = towards / np.linalg.norm(towards)

    def radiance(directions: Floats) -> Floats:
        apart = np.arccos(np.clip(directions @ to, -1, 1))
        level = 0.3 + 3 * np.exp(-0.5 * (apart / np.radians(25)) ** 2)
        return np.asarray(level[..., None] * np.ones(3))

    return radiance


def make_room(
    lamp: Lamp | None,
    ambient: tuple[float, float, float] | Callable[[Floats], Floats],
    albedos: dict[int, tuple[float, float, float]] = ALBEDOS,
    known: Floats = KNOWN,
) -> ShellRoom:
    """The room as exact pictures show it.

    ambient: radiance from all that is not scanned, or a function of directions [..., 3]. known: of what is.
    """
    pictures = _exact_pictures(lamp, ambient, tuple(albedos.items()), tuple(np.asarray(known, float).tolist()))
    at, facing, shown, arrivals = (array.copy() for array in pictures)
    patches = Patches()
    patches.add(Seen(at + 1e-4, facing, shown, np.zeros(len(at)), np.zeros(len(at))))
    rows = patches.seen
    # `add` sorts the patches: bring the rays into its order.
    order = np.array([np.abs(at + 1e-4 - position).sum(1).argmin() for position in patches.positions[rows]])
    patches.traced_normals[rows], patches.arrivals[rows] = patches.normals[rows], arrivals[order]
    patches.traced_in[rows] = 1
    shell = shell_of(at, facing, np.stack([CAMERA, SIZE_M - 1.0]), UP, patches.area_m2)
    transport = Transport()
    transport.update(patches, NO_EMITTERS, rows, shell)
    return ShellRoom(patches, transport, shell, Unknowns())


@lru_cache(maxsize=8)
def _exact_pictures(
    lamp: Lamp | None,
    ambient: tuple[float, float, float] | Callable[[Floats], Floats],
    albedos: tuple[tuple[int, tuple[float, float, float]], ...],
    known: tuple[float, float, float],
) -> tuple[Floats, Floats, Floats, Floats]:
    """Of all patches [n]: positions, normals, log radiance [n, 3], and what arrives along their rays [n, m, 4]."""
    points, normals, colors = [], [], []
    for axis, color in albedos:
        first, second = (a for a in range(3) if a != axis)
        u, v = np.meshgrid(*(np.arange(SPACING_M / 2, SIZE_M[a], SPACING_M) for a in (first, second)))
        at = np.zeros((u.size, 3))
        at[:, first], at[:, second] = u.ravel(), v.ravel()
        points.append(at)
        normals.append(np.tile(np.eye(3)[axis], (u.size, 1)))
        colors.append(np.tile(color, (u.size, 1)))
    at, facing, albedo = np.concatenate(points), np.concatenate(normals), np.concatenate(colors)
    directions = np.broadcast_to(ray_directions(), (len(at), RAYS, 3))
    from_beyond = ambient(directions) if callable(ambient) else np.array(ambient)
    radiance, arrivals = sent(at, directions, lamp, from_beyond, np.array(known))
    return at, facing, np.log(albedo * np.einsum("nm,nmr->nr", hemisphere_weights(facing), radiance)), arrivals
