"""Whether rays of kept transfer end otherwise, in volumes of solids whose every ray is known in closed form."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.engine import Engine
from server.transfer import transfer_cache
from server.transfer.indirect import gather_hits, room_for_met
from server.transfer.radiance_transfer import TURNS, direction_sets, room_for_mean_normals, transfer_radiance
from server.transfer.transfer_cache import CHECKS, PARTS, TransferCache
from server.volume.volume import Volume
from tests.scenes.analytic import Floats
from tests.scenes.solids import (
    Scene,
    Solid,
    ball,
    box,
    fill_volume,
    floor,
    hit,
    signed_distances,
    upload_surface,
)
from tests.scenes.volumes import fill

SIDE = 16
VOXEL_M, REACH_M = 0.02, 10.0
CAMERA = CameraModel(width=SIDE, height=SIDE, fx=80.0, fy=80.0, cx=7.5, cy=7.5)
EYE = np.array([0.5, 0.9, 0.5])
RAYS = direction_sets(81, 2)
NOTICED = 8
"""A check notices if one of so many rays has changed."""
UNSURE_M = 2.5 * VOXEL_M
"""How far from its surface a solid may begin or end for rays: a voxel's diagonal, and where they begin."""
BARE: Scene = [floor(0.1)]
CLOSED: Scene = [
    floor(0.1),
    box((0.0, 0.1, 0.0), (1.0, 1.0, 0.06)),
    box((0.0, 0.1, 0.94), (1.0, 1.0, 1.0)),
    box((0.0, 0.1, 0.0), (0.06, 1.0, 1.0)),
    box((0.94, 0.1, 0.0), (1.0, 1.0, 1.0)),
    box((0.0, 0.94, 0.0), (1.0, 1.0, 1.0)),
]
BALL = ball((0.75, 0.35, 0.3), 0.16)
NEVER_OLD = 1 << 20
"""A period that no test reaches."""


@dataclass
class Floor:
    """Samples on a floor, with what their entries' rays were when they were traced."""

    engine: Engine
    scene: Scene
    with_hits: bool = True
    traced: NDArray[np.int64] = field(default_factory=lambda: np.full(SIDE * SIDE, -1))
    """[n] frame in which each was last traced."""
    now: int = 0

    def __post_init__(self) -> None:
        x, z = np.meshgrid(np.linspace(0.2, 0.8, SIDE), np.linspace(0.2, 0.8, SIDE))
        self.points = np.stack([x, np.full_like(x, 0.1), z], -1).reshape(-1, 3)
        self.volume: Volume = fill_volume(self.engine, self.scene, VOXEL_M)
        self.cache = TransferCache(self.engine)
        self.sets = np.zeros(SIDE * SIDE, int)
        self.met: list[dict[int, float]] = [{}] * (SIDE * SIDE)
        """Directions of each sample whose surface is known, and how far away it is."""

    def change(self, scene: Scene) -> None:
        """The scan becomes another's, in the same volume."""
        self.scene = scene
        signed_m, depth_m = signed_distances(scene, self.volume), self.volume.truncation_m
        fill(self.engine, self.volume, np.clip(signed_m / depth_m, -1, 1), signed_m > -depth_m)

    def begin(self) -> None:
        """Until all is kept: two cells may ask for the same place."""
        assert self.look().all()
        assert self.look().mean() < 0.02
        assert not self.look().any()

    def look(self) -> NDArray[np.bool_]:
        """[n] which samples are traced in the next frame. None waits for another."""
        engine, shape = self.engine, (SIDE, SIDE)
        points = self.points.reshape(*shape, 3)
        surface = upload_surface(engine, points, np.broadcast_to([0.0, 1.0, 0.0], points.shape), np.ones(shape, bool))
        pose = np.eye(4)
        pose[:3, 3] = EYE
        self.now += 1
        view = CAMERA, self.volume, surface
        kept = self.cache.find(*view, pose, 1, RAYS, REACH_M, with_hits=self.with_hits)
        found = transfer_radiance(engine, *view, 1, RAYS, REACH_M, turn=self.now % TURNS, found=kept)
        if self.with_hits:
            gather_hits(engine, *view, found, RAYS, REACH_M, found=kept)
        is_traced = engine.download(kept).ravel() < 0
        normals = engine.download(room_for_mean_normals(engine, found)).view(np.float32).reshape(-1, 4)
        np.testing.assert_allclose(normals[is_traced, :3], np.broadcast_to([0, 1, 0], (is_traced.sum(), 3)), atol=1e-6)
        assert found.sets is not None
        sets, met = engine.download(found.sets).ravel(), engine.download(room_for_met(engine, found, RAYS))
        for i in np.flatnonzero(is_traced):
            self.sets[i], self.traced[i] = sets[i], self.now
            if self.with_hits:
                self.met[i] = unpacked(met.reshape(SIDE * SIDE, -1)[i])
        self.cache.store()
        return np.asarray(is_traced)

    def ends_m(self, i: int, scene: Scene) -> Floats:
        """[directions] where the rays of a sample's entry meet solids: infinite where they are free, NaN where they do
        not rise."""
        directions = RAYS.directions[self.sets[i], :, :3].astype(float)
        origins = np.broadcast_to(self.points[i] + VOXEL_M * np.array([0.0, 1.0, 0.0]), directions.shape)
        return np.where(directions[:, 1] > 0, hit(scene, origins, directions), np.nan)

    def noticed(self, solid: Solid, by_m: float) -> NDArray[np.bool_]:
        """[n] whether so many rays of a part meet the solid, grown, that a check notices it."""
        ends_m = np.array([self.ends_m(i, [solid.grown(by_m)]) for i in range(SIDE * SIDE)])
        parts = [ends_m[:, part::PARTS] for part in range(PARTS)]
        return np.any([enough(np.isfinite(part).sum(axis=1), (~np.isnan(part)).sum(axis=1)) for part in parts], axis=0)

    def noticed_before_others(self, solid: Solid, by_m: float) -> NDArray[np.bool_]:
        """The same for the directions whose surface is known."""
        meets = [np.isfinite(self.ends_m(i, [solid.grown(by_m)])[list(met)]) for i, met in enumerate(self.met)]
        return np.array([enough(each.sum(), len(each)) for each in meets])


def enough(changed: NDArray[np.int64] | int, traced: NDArray[np.int64] | int) -> NDArray[np.bool_]:
    """Whether a check that traced so many rays notices that some have changed."""
    return np.asarray((np.asarray(changed) > 0) & (NOTICED * np.asarray(changed) >= traced))


def unpacked(met: NDArray[np.uint32]) -> dict[int, float]:
    """As met.clh packs them."""
    ends = np.flatnonzero(met == 0xFFFFFFFF)
    return {int(value & 0xFFFF): float(value >> 16) / 1000 for value in met[: ends[0] if len(ends) else len(met)]}


@pytest.fixture(autouse=True)
def nothing_is_old(monkeypatch: pytest.MonkeyPatch) -> None:
    """Samples are traced only because they are new, or because their rays have changed; each has a cell of its own."""
    monkeypatch.setattr(transfer_cache, "PERIOD", NEVER_OLD)
    monkeypatch.setattr(transfer_cache, "MOST_TRACED", 1.0)
    monkeypatch.setattr(transfer_cache, "PLACES_A_SAMPLE", 512)


@pytest.mark.parametrize("scene", [BARE, CLOSED, [*BARE, BALL]], ids=["bare", "closed", "ball"])
def test_in_the_same_volume_rays_end_the_same(engine: Engine, scene: Scene) -> None:
    """To the bit: in three rounds of checks nothing is traced a second time."""
    seen = Floor(engine, scene)
    seen.begin()
    assert not any(seen.look().any() for _ in range(3 * CHECKS * PARTS))


@pytest.mark.parametrize("comes", [True, False], ids=["comes", "goes"])
def test_an_entry_is_traced_again_if_its_rays_change(engine: Engine, comes: bool) -> None:
    """A ball above a floor. Entries of which enough rays meet it are traced once more, within CHECKS PARTS frames;
    those of which too few come near it are not."""
    seen = Floor(engine, BARE if comes else [*BARE, BALL], with_hits=False)
    seen.begin()
    sets = seen.sets.copy()
    hits, nears = seen.noticed(BALL, -UNSURE_M), seen.noticed(BALL, UNSURE_M)
    seen.change([*BARE, BALL] if comes else BARE)
    is_traced = np.array([seen.look() for _ in range(CHECKS * PARTS + 1)])
    assert 0.05 < hits.mean() < nears.mean() < 0.8
    assert is_traced[:, hits].any(axis=0).all()
    assert not is_traced[:, ~nears].any()
    assert is_traced.sum(axis=0).max() == 1
    frames = np.flatnonzero(is_traced.any(axis=1))
    assert len(frames) > CHECKS  # an entry has its turn, and then another part of its rays
    assert (seen.sets != sets).any()
    assert not any(seen.look().any() for _ in range(CHECKS * PARTS))


def test_surface_before_other_surface_is_noticed(engine: Engine) -> None:
    """In a closed room every ray ends at a wall, with and without a ball: of some it is known how far away."""
    seen = Floor(engine, CLOSED)
    seen.begin()
    known = [list(met) for met in seen.met]
    assert min(map(len, known)) > 1
    for i in range(0, SIDE * SIDE, 17):  # told as they are
        np.testing.assert_allclose(seen.ends_m(i, CLOSED)[known[i]], list(seen.met[i].values()), atol=UNSURE_M)
    hits, nears = (seen.noticed_before_others(BALL, by_m) for by_m in (-UNSURE_M, UNSURE_M))
    seen.change([*CLOSED, BALL])
    is_traced = np.array([seen.look() for _ in range(CHECKS + 1)])
    assert 0.05 < hits.mean() < nears.mean() < 0.9
    assert is_traced[:, hits].any(axis=0).all()
    assert not is_traced[:, ~nears].any()


def test_without_known_surface_only_openings_are_noticed(engine: Engine) -> None:
    seen = Floor(engine, CLOSED, with_hits=False)
    seen.begin()
    seen.change([*CLOSED, BALL])
    assert not any(seen.look().any() for _ in range(2 * CHECKS * PARTS))
