"""Interleaved visibility and its caches (thesis 6.1.1) against the float64 twin, and against tracing everything."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.rigid import inverse_rigid
from server.opencl.engine import Engine
from server.transfer.radiance_transfer import direction_sets, first_set, transfer_radiance
from server.transfer.visibility_cache import VisibilityCaches
from server.volume.raycast import LABEL_DYNAMIC, LABEL_STATIC, Surface
from server.volume.volume import Volume
from tests.reference import visibility_cache as twin
from tests.reference.radiance_transfer import direction_set
from tests.scenes.analytic import look_at
from tests.scenes.solids import SCENES, download4, fill_volume, floor, upload_surface
from tests.scenes.volumes import fill, seen_surface

VOXEL_M = 0.01
CAMERA = CameraModel(width=93, height=62, fx=80.0, fy=80.0, cx=47.5, cy=31.5)
STRIDE = 4
COUNT = 81
ROOM_M = 1000.0

Floats = NDArray[np.float64]


def pose(step: float) -> Floats:
    """Volume space (y up) around the ball: `step` metres to the right."""
    matrix: Floats = look_at((0.35 + step, 0.75, 0.08), (0.5 + step, 0.2, 0.5))
    return matrix


@dataclass
class Watcher:
    """A camera whose frames share their visibility."""

    engine: Engine
    volume: Volume
    interleave: int
    stride: int = STRIDE
    turn: int = 0
    """Of the direction sets."""
    caches: VisibilityCaches = field(init=False)
    surface: Surface = field(init=False)

    def __post_init__(self) -> None:
        self.caches = VisibilityCaches(self.engine, self.interleave)

    def see(self, view: Floats, labels: Any = LABEL_STATIC, ray_length_m: float = ROOM_M) -> dict[str, Any]:
        """The transfer of one frame, and what its layer holds."""
        self.surface = seen_surface(self.engine, self.volume, CAMERA, view, labels)
        return self.look_at(self.surface, view, ray_length_m)

    def look_at(self, surface: Surface, view: Floats, ray_length_m: float = ROOM_M) -> dict[str, Any]:
        self.caches.begin_frame(CAMERA, view, self.stride, COUNT, ray_length_m)
        rays = direction_sets(COUNT, 4, self.interleave)
        found = transfer_radiance(
            self.engine, CAMERA, self.volume, surface, self.stride, rays, ray_length_m, self.caches, turn=self.turn
        )
        get = self.engine.download
        assert found.sets is not None
        _, _, traced, blocked = self.caches.buffers()
        points, normals = (self.caches.surface.array(name) for name in ("points", "normals"))
        phase, known, newest = (self.caches.parameters()[name] for name in ("phase", "layers", "newest"))
        layer = (int(newest) + 1) % self.interleave  # type: ignore[call-overload]
        assert layer == phase
        bits = np.unpackbits(get(blocked)[layer].view(np.uint8), axis=-1, bitorder="little")  # type: ignore[arg-type]
        marks = get(traced)[layer]  # type: ignore[arg-type]
        subsets = np.unpackbits((marks & 255).astype(np.uint8)[..., None], axis=-1, bitorder="little")
        free = np.unpackbits(get(found.free_mask).view(np.uint8), axis=-1, bitorder="little")
        return {
            "phase": phase,
            "known": known,
            "view": view,
            "transfer": get(found.coefficients).astype(float),
            "openness": get(found.openness).astype(float),
            "sets": get(found.sets),
            "free": free[..., :COUNT].astype(bool),
            "points": download4(self.engine, points)[layer].astype(float),  # type: ignore[arg-type]
            "normals": download4(self.engine, normals)[layer].astype(float),  # type: ignore[arg-type]
            "traced": subsets[..., : self.interleave].astype(bool),
            "set": marks >> 8,
            "blocked": bits[..., :COUNT].astype(bool),
        }


def layer_of(frame: dict[str, Any]) -> twin.Layer:
    keys = ("points", "normals", "traced", "set", "blocked")
    return twin.Layer(inverse_rigid(frame["view"]), *(frame[key] for key in keys))


@pytest.mark.parametrize("interleave", [2, 4, 8])
def test_still_view_traces_a_part_and_knows_all(engine: Engine, interleave: int) -> None:
    """From the first frame on the result is that of all directions; from the second a frame traces one subset."""
    watcher = Watcher(engine, fill_volume(engine, SCENES["ball above a floor"], VOXEL_M), interleave)
    first = watcher.see(pose(0))
    here = first["openness"] >= 0
    assert here.mean() > 0.5
    assert (first["openness"][here] < 0.95).any()
    assert first["traced"][here].all()
    for number in range(1, interleave + 3):
        frame = watcher.see(pose(0))
        np.testing.assert_array_equal(frame["free"], first["free"])
        np.testing.assert_array_equal(frame["transfer"], first["transfer"])
        only = np.arange(interleave) == number % interleave
        np.testing.assert_array_equal(frame["traced"][here], np.tile(only, (here.sum(), 1)))
        assert not frame["traced"][~here].any()


def test_all_at_once_is_what_is_traced_without_subsets(engine: Engine) -> None:
    """The same directions in one set: interleaving changes what is traced when, not what is found."""
    volume = fill_volume(engine, SCENES["ball above a floor"], VOXEL_M)
    watcher = Watcher(engine, volume, 4)
    frames = [watcher.see(pose(0)) for _ in range(5)]
    rays = direction_sets(COUNT, 4, 4)
    alone = VisibilityCaches(engine, 4)
    alone.begin_frame(CAMERA, pose(0), STRIDE, COUNT, ROOM_M)
    for caches in (alone, None):  # without caches, as where transfer is kept at places of the world
        whole = transfer_radiance(engine, CAMERA, volume, watcher.surface, STRIDE, rays, ROOM_M, caches)
        np.testing.assert_array_equal(frames[-1]["transfer"], engine.download(whole.coefficients))
        assert whole.interleave == (4 if caches else 1)


@pytest.mark.parametrize("stride", [1, 4])
def test_moving_view_takes_what_the_twin_takes(engine: Engine, stride: int) -> None:
    interleave = 4
    watcher = Watcher(engine, fill_volume(engine, SCENES["ball above a floor"], VOXEL_M), interleave, stride)
    frames: list[dict[str, Any]] = []
    reused = 0.0
    for number in range(7):
        watcher.turn = number
        frame = watcher.see(pose(0.012 * number))
        if number:
            here = frame["openness"] >= 0
            wanted = np.tile(np.arange(interleave) != number % interleave, (here.sum(), 1))
            layers = [layer_of(f) for f in frames[::-1][: interleave - 1]]
            points, normals = frame["points"][here][:, :3], frame["normals"][here][:, :3]
            found, sets, blocked = twin.find_cached(layers, CAMERA, stride, points, normals, VOXEL_M, wanted)
            own = first_set(number) + np.asarray(direction_set(*np.nonzero(here)))
            agree = (frame["traced"][here] == ~found).all(1)
            agree &= (frame["sets"][here] == np.where(found, sets, own[:, None])).all(1)
            # float32: a sample may fall to either of two cells, or on either side of a limit
            assert agree.mean() > 0.999  # seen: 0.9998
            taken = found[:, np.arange(COUNT) % interleave]
            above = above_of(frame["sets"][here], normals)
            free = above & ~np.where(taken, blocked, frame["blocked"][here])
            assert (free[agree] != frame["free"][here][agree]).mean() < 1e-4
            reused = found[wanted].mean()
            assert 0.5 < reused < 1.0
        frames.append(frame)
    assert reused > 0.8


def above_of(sets: NDArray[np.uint8], normals: Floats) -> NDArray[np.bool_]:
    """[n, count] which directions of subsets of `sets` [n, k] lie above the surfaces."""
    k = sets.shape[1]
    directions = direction_sets(COUNT, 4, k).directions.astype(float)
    chosen = directions[sets[:, np.arange(COUNT) % k], np.arange(COUNT), :3]
    above: NDArray[np.bool_] = np.einsum("njc,nc->nj", chosen, normals) > 0
    return above


def test_uncovered_and_moved_surface_is_traced_anew(engine: Engine) -> None:
    """A block of the picture comes 10 cm nearer: no visibility of what was there before is taken for it."""
    volume = fill_volume(engine, (floor(),), VOXEL_M)
    watcher = Watcher(engine, volume, 4)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    points = np.stack([0.2 + u * 0.005, 0 * u + 0.1, 0.2 + v * 0.005], -1)
    normals = np.broadcast_to([0.0, 1.0, 0.0], points.shape)
    view = np.eye(4)
    view[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # looks down
    view[:3, 3] = points[0, 0] + np.array([47.5 * 0.005, 0.4, 31.5 * 0.005])
    everywhere = np.ones(u.shape, bool)
    for _ in range(5):
        frame = watcher.look_at(upload_surface(engine, points, normals, everywhere), view)
    assert (frame["traced"].sum(-1) == 1).all()
    moved = (u >= 48) & (v >= 32)
    points[moved, 1] += 0.1
    frame = watcher.look_at(upload_surface(engine, points, normals, everywhere), view)
    new = moved[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
    assert frame["traced"][new].all()
    assert (frame["traced"][~new].sum(-1) == 1).all()
    np.testing.assert_array_equal(frame["traced"][~new][:, 5 % 4], True)


def test_moving_things_leave_nothing(engine: Engine) -> None:
    """Labels other than static: traced in full, and not taken from in later frames."""
    watcher = Watcher(engine, fill_volume(engine, SCENES["ball above a floor"], VOXEL_M), 4)
    labels = np.full((CAMERA.height, CAMERA.width), LABEL_STATIC, np.uint8)
    labels[:, 48:] = LABEL_DYNAMIC
    for _ in range(3):
        frame = watcher.see(pose(0), labels)
    here, moving = frame["openness"] >= 0, labels[2::4, 2::4] == LABEL_DYNAMIC
    assert frame["traced"][here & moving].all()
    assert (frame["traced"][here & ~moving].sum(-1) == 1).all()
    frame = watcher.see(pose(0))
    assert frame["traced"][here & moving].all()


def test_a_change_is_followed_within_k_frames(engine: Engine) -> None:
    scene = SCENES["ball above a floor"]
    volume = fill_volume(engine, scene, VOXEL_M)
    watcher = Watcher(engine, volume, 4)
    before = watcher.see(pose(0))
    surface = upload_surface(
        engine,
        download4(engine, watcher.surface.positions)[..., :3].astype(float),
        download4(engine, watcher.surface.normals)[..., :3].astype(float),
        download4(engine, watcher.surface.positions)[..., 3] > 0,
    )
    z, y, x = (8 * n for n in volume.bricks[::-1])
    fill(engine, volume, np.ones((z, y, x)), np.ones((z, y, x)))  # nothing is left that could block
    for _ in range(4):
        frame = watcher.look_at(surface, pose(0))
    here = frame["openness"] >= 0
    assert (before["openness"][here] < 0.9).any()
    np.testing.assert_array_equal(frame["openness"][here], 1.0)


def test_another_reach_forgets(engine: Engine) -> None:
    watcher = Watcher(engine, fill_volume(engine, SCENES["ball above a floor"], VOXEL_M), 4)
    for _ in range(2):
        watcher.see(pose(0))
    frame = watcher.see(pose(0), ray_length_m=0.1)
    assert frame["traced"][frame["openness"] >= 0].all()
    watcher.caches.forget()
    frame = watcher.see(pose(0), ray_length_m=0.1)
    assert frame["traced"][frame["openness"] >= 0].all()


@pytest.mark.parametrize("interleave", [2, 4, 8])
@pytest.mark.parametrize("count", [81, 324])
def test_subsets_are_even(interleave: int, count: int) -> None:
    """Greatest angle from anywhere to the nearest direction, in units of that of points on a square grid."""
    directions = direction_sets(count, 2, interleave).directions[..., :3].astype(float)
    random = np.random.default_rng(3).normal(size=(3000, 3))
    random /= np.linalg.norm(random, axis=1, keepdims=True)

    def unevenness(points: Floats) -> float:
        farthest = np.arccos(np.clip((random @ points.T).max(1), -1, 1)).max()
        return float(farthest / np.sqrt(2 * np.pi / len(points)))

    assert max(unevenness(one) for one in directions[:64:7]) < 1.5
    assert max(unevenness(one[i::interleave]) for one in directions[:64:7] for i in range(interleave)) < 1.5
    assert unevenness(directions[:16].reshape(-1, 3)) < 1.6
