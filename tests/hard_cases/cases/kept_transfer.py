"""Transfer that is kept at places of the world: one surface could be taken for another, or be kept when it is gone.

A closed hollow box is seen from inside, where no sky is, and from outside, where nothing hides it: openness is 0 and 1
at every sample, however few are traced in a frame.
"""

from __future__ import annotations

from collections.abc import Callable
from unittest.mock import patch

import numpy as np

from protocol.frames import CameraModel
from server.opencl.engine import Engine
from server.transfer import transfer_cache
from server.transfer.radiance_transfer import TURNS, direction_sets, transfer_radiance
from server.transfer.transfer_cache import CHECKS, ORDERS, PARTS, TransferCache
from server.volume.volume import Volume
from tests.hard_cases.catalogue import Family, Floats, Found, Trial
from tests.scenes.analytic import look_at
from tests.scenes.solids import Scene, box, fill_volume, hit, normal_at, signed_distances, upload_surface
from tests.scenes.volumes import fill

KEPT = Family("kept transfer", checkable=False)  # hundreds of frames: days in a simulator
VOXEL_M, ROOM_M = 0.01, 1000.0
LOW, HIGH, WALL_M = 0.3, 0.7, 0.03
WIDE = CameraModel(width=32, height=24, fx=8.0, fy=8.0, cx=15.5, cy=11.5)
"""At 20 cm its samples are 2.5 cm apart, so that a cell is as thick as the wall and more."""
RAYS = direction_sets(33, 2)
INSIDE: tuple[Floats, Floats] = (np.array([0.5, 0.45, 0.5]), np.array([0.75, 0.5, 0.52]))
OUTSIDE: tuple[Floats, Floats] = (np.array([0.9, 0.52, 0.5]), np.array([0.3, 0.5, 0.48]))
"""Eyes and what they look at: the same wall."""
LEAK = 0.02
_CORNERS = (
    "rays between voxels' corners; nothing else comes into the box, and nothing hides the sky from outside of it."
)


def _slabs() -> list[Scene]:
    """The floor, and the other five walls."""
    walls: list[Scene] = []
    for axis in (1, 0, 2):
        for low, high in ((LOW, LOW + WALL_M), (HIGH - WALL_M, HIGH)):
            corners = np.full((2, 3), [[LOW], [HIGH]])
            corners[:, axis] = low, high
            walls.append([box(*corners)])
    return [walls[0], [wall for of in walls[1:] for wall in of]]


FLOOR, OTHERS = _slabs()
CLOSED = [*FLOOR, *OTHERS]


class _Seen:
    """Frames of one camera with a cache."""

    def __init__(self, engine: Engine, scene: Scene) -> None:
        self.volume: Volume = fill_volume(engine, scene, VOXEL_M)
        self._engine, self._cache = engine, TransferCache(engine)
        self._frames = 0

    def change(self, scene: Scene) -> None:
        """The scan becomes that of another scene, in the same volume."""
        signed_m = signed_distances(scene, self.volume)
        depth_m = self.volume.truncation_m
        fill(self._engine, self.volume, np.clip(signed_m / depth_m, -1, 1), signed_m > -depth_m)

    def look(
        self, scene: Scene, eye: Floats, target: Floats, off_m: Floats | None = None, *, is_given_up: bool = False
    ) -> Floats:
        """[n] openness of the samples that see `scene`, none of a frame that is given up before anything is traced.
        off_m [rows, cols]: how far off the surface they lie."""
        pose = look_at(eye, target)
        row, col = np.indices((WIDE.height, WIDE.width)).astype(float)
        rays = np.stack([(col - WIDE.cx) / WIDE.fx, (row - WIDE.cy) / WIDE.fy, np.ones_like(row)], -1) @ pose[:3, :3].T
        rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).reshape(-1, 3)
        t = hit(scene, np.broadcast_to(eye, rays.shape), rays)
        points = eye + np.where(np.isfinite(t), t, 0)[:, None] * rays
        normals = normal_at(scene, points - 1e-5 * rays)
        valid = np.isfinite(t) & (np.abs(np.linalg.norm(normals, axis=-1) - 1) < 1e-3)
        if off_m is not None:
            points = points + off_m.reshape(-1, 1) * normals
        shape = (WIDE.height, WIDE.width)
        surface = upload_surface(
            self._engine, points.reshape(*shape, 3), normals.reshape(*shape, 3), valid.reshape(shape)
        )
        self._frames += 1
        kept = self._cache.find(WIDE, self.volume, surface, pose, 1, RAYS, ROOM_M, with_hits=False)
        if is_given_up:
            return np.zeros(0)
        turn = self._frames % TURNS
        traced = transfer_radiance(self._engine, WIDE, self.volume, surface, 1, RAYS, ROOM_M, turn=turn, found=kept)
        self._cache.store()
        return self._engine.download(traced.openness).ravel()[valid].astype(np.float64)


def _in_turn(seen: _Seen, frames: int, look: Callable[[_Seen, int, bool], Floats]) -> Found:
    """Every view, from inside and outside in turn."""
    values: list[Floats] = []
    truth: list[Floats] = []
    for number in range(frames):
        is_inside = number % 2 == 0
        openness = look(seen, number, is_inside)
        values.append(openness)
        truth.append(np.full(len(openness), 0.0 if is_inside else 1.0))
    return Found(np.concatenate(values), np.concatenate(truth))


def _wall(seen: _Seen, is_inside: bool, off_m: Floats | None = None) -> Floats:
    eye, target = INSIDE if is_inside else OUTSIDE
    return seen.look(CLOSED, eye, target, off_m)


@KEPT.case("both sides of a thin wall in turn", LEAK, "of the sky", _CORNERS)
def both_sides(trial: Trial) -> Found:
    seen = _Seen(trial.engine, CLOSED)
    return _in_turn(seen, trial.of(24, 120), lambda seen, _, is_inside: _wall(seen, is_inside))


@KEPT.case("a table of sixteen places for hundreds of cells", LEAK, "of the sky", _CORNERS)
def small_table(trial: Trial) -> Found:
    with patch.object(transfer_cache, "places_for", lambda *_: 16):
        return both_sides(trial)


@KEPT.case("a surface that moves by a voxel from frame to frame", LEAK, "of the sky", _CORNERS)
def unsteady_surface(trial: Trial) -> Found:
    random = np.random.default_rng(0)

    def look(seen: _Seen, _: int, is_inside: bool) -> Floats:
        off_m = random.uniform(0, VOXEL_M, (WIDE.height, WIDE.width))
        return _wall(seen, is_inside, off_m)

    return _in_turn(_Seen(trial.engine, CLOSED), trial.of(24, 120), look)


@KEPT.case("from a tenth of a millimetre to 50 m and back", LEAK, "of the sky", _CORNERS)
def far_and_near(trial: Trial) -> Found:
    """The wall from outside, at every distance, and from inside between."""
    steps = np.geomspace(1e-4, 50.0, trial.of(12, 60))
    away_m = np.concatenate([steps, steps[::-1]])

    def look(seen: _Seen, number: int, is_inside: bool) -> Floats:
        if is_inside:
            return _wall(seen, is_inside)
        eye = np.array([HIGH + away_m[number // 2], 0.52, 0.5])
        return seen.look(CLOSED, eye, np.array([0.3, 0.5, 0.48]))

    return _in_turn(_Seen(trial.engine, CLOSED), 2 * len(away_m), look)


def _changed(trial: Trial, before: Scene, after: Scene, frames: int, gives_up: int = 0) -> Floats:
    """Openness of the floor so many frames after the scan has changed. gives_up: each such frame, seen from aside, ends
    before anything is stored; what it asked for must not keep others from it."""
    seen = _Seen(trial.engine, before)
    eye, target = np.array([0.5, 0.55, 0.5]), np.array([0.5, 0.3, 0.52])
    for scene, count in ((before, UNTIL_OLD), (after, frames)):
        seen.change(scene)
        for number in range(1, count):
            is_given_up = gives_up > 0 and number % gives_up == 0
            aside = ASIDE_M if is_given_up else 0.0
            seen.look(FLOOR, eye + aside, target + aside, is_given_up=is_given_up)
        openness = seen.look(FLOOR, eye, target)
    return openness


ASIDE_M = np.array([0.025, 0.0, 0.025])  # as far as samples are apart: they have other numbers
UNTIL_OLD, UNTIL_TRACED = 2 * CHECKS * PARTS, CHECKS * PARTS + ORDERS
"""Frames in which all is kept, and those until all rays of a cell were checked and it was traced anew."""


@KEPT.case(
    "walls taken from around a floor", 0, "of the sky", "open floor, once the last cell was checked and traced anew."
)
def walls_go(trial: Trial) -> Found:
    return Found(_changed(trial, CLOSED, FLOOR, UNTIL_TRACED), 1.0)


@KEPT.case(
    "walls put around a floor", LEAK, "of the sky", "rays between voxels' corners, once the last cell was traced anew."
)
def walls_come(trial: Trial) -> Found:
    return Found(_changed(trial, FLOOR, CLOSED, UNTIL_TRACED), 0.0)


@KEPT.case(
    "walls taken away, each third frame given up", 0, "of the sky", "a cell's turn is given up twice in a row at most."
)
def walls_go_between_failures(trial: Trial) -> Found:
    return Found(_changed(trial, CLOSED, FLOOR, UNTIL_TRACED + CHECKS * PARTS, gives_up=3), 1.0)
