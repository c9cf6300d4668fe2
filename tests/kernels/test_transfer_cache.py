"""What is kept of transfer from frame to frame, against the float64 twin: which samples are found, and with what."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyopencl.array as cl_array
import pytest
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.engine import Engine
from server.transfer import transfer_cache
from server.transfer.indirect import room_for_hits, room_for_met
from server.transfer.radiance_transfer import Transfer, direction_sets, traced_transfer
from server.transfer.transfer_cache import ORDERS, TransferCache, places_for
from server.volume.volume import Volume
from tests.reference.transfer_cache import LENT, Samples, Table, cell_of
from tests.scenes.analytic import Floats
from tests.scenes.lights import random_directions
from tests.scenes.solids import SCENES, fill_volume, upload_surface

ROWS, COLS, STRIDE = 13, 19, 1
CAMERA = CameraModel(width=COLS, height=ROWS, fx=40.0, fy=40.0, cx=9.0, cy=6.0)
SPACING = STRIDE / CAMERA.fx
RAYS = direction_sets(33, 2)
WORDS = 20 + 2 + 4 + 9
"""Of an entry: with 33 directions in the mask, 2 x 2 coefficients, every fourth direction's surface."""
REACH_M = 10.0
AS_KEPT, ANEW, OF_ANOTHER = 0, 1, 2
"""As in ways.clh."""
NEVER = 1 << 30
CLEAR = 1e-3
"""Margin of samples from borders of cells, over which float32 cannot carry them."""
FACES = random_directions(12, 3)


class Frames:
    """Frames of samples with values of their own, for the kernels and for the twin."""

    def __init__(self, engine: Engine, monkeypatch: pytest.MonkeyPatch, places: int, period: int) -> None:
        monkeypatch.setattr(transfer_cache, "CHECKS", NEVER)  # their values are no rays'
        self.volume: Volume = fill_volume(engine, SCENES["floor under a wall"], 0.05)
        self.cache = TransferCache(engine)
        self.twin = Table(places, period)
        self.random = np.random.default_rng(7)
        self._engine = engine
        self.now = 0
        self._near = self.random.uniform(0.3, 1.1, (90, 3))

    def samples(self, eye: Floats) -> Samples:
        """Points near a few places of surface, most often of that of their part of the picture, so that frames meet
        cells again and samples have others of their surface beside them; and their normals."""
        count = ROWS * COLS
        points, normals = np.empty((count, 3)), np.empty((count, 3))
        for i in range(count):
            while True:
                block = i // COLS // 5 * 4 + i % COLS // 5
                which = block if self.random.random() < 0.6 else self.random.integers(len(self._near))
                points[i] = (self._near[which] + self.random.normal(0, 0.002 if i % 7 else 0.03, 3)).astype(np.float32)
                tilted = FACES[which % len(FACES)] + self.random.normal(0, 0.1 if i % 5 else 0.6, 3)
                normals[i] = (tilted / np.linalg.norm(tilted)).astype(np.float32)
                if cell_of(points[i], normals[i], eye, SPACING, self.twin.places).margin > CLEAR:
                    break
        return Samples(points, normals, self.random.random(count) > 0.05, COLS, eye, SPACING)

    def find(self, samples: Samples, reach_m: float = REACH_M, *, renews: bool = False) -> NDArray[np.int64]:
        """[n] as TransferCache.find returns it."""
        shape = (ROWS, COLS)
        points, normals = samples.points.reshape(*shape, 3), samples.normals.reshape(*shape, 3)
        surface = upload_surface(self._engine, points, normals, samples.valid.reshape(shape))
        pose = np.eye(4)
        pose[:3, 3] = samples.eye
        kept = self.cache.find(CAMERA, self.volume, surface, pose, STRIDE, RAYS, reach_m, renews=renews)
        return self._engine.download(kept).astype(np.int64).ravel().copy()

    def step(self, eye: Floats) -> tuple[Samples, NDArray[np.int64]]:
        """One frame, and how its samples came to their values, by the kernels as by the twin.

        All arrays of samples that are not traced are compared with what the twin's entries were filled from; so are,
        in the end, those of samples that take the values of others, and the places of all.
        """
        self.now += 1
        samples = self.samples(eye)
        kept = self.find(samples)
        np.testing.assert_array_equal(kept, self.twin.choose(samples, self.now, self.most))
        values = self.random.integers(1, 200, ROWS * COLS).astype(float)
        is_kept, is_lent = (kept >= 0) & (kept < LENT), kept >= LENT
        values[is_kept] = [self.twin.entries[int(place)].value for place in kept[is_kept]]
        self._fill(kept < 0, values)
        self._check(is_kept, values)
        cells = self.cache.store()
        values[is_lent] = values[kept[is_lent] - LENT]
        self._check(is_kept | is_lent, values)
        after = self.twin.store(samples, self.now, kept, values)
        np.testing.assert_array_equal(self._engine.download(cells.places).ravel(), after)
        ways = np.select([is_kept, is_lent], [AS_KEPT, OF_ANOTHER], ANEW)
        np.testing.assert_array_equal(self._engine.download(cells.ways).ravel(), ways)
        assert (self._engine.download(cells.claims) == 0xFFFFFFFF).all()
        waits = is_lent.sum() + self.waiting_entries(kept)
        assert self.cache.share_waiting() == waits / (ROWS * COLS)
        return samples, kept

    def give_up(self, eye: Floats) -> None:
        """A frame in which nothing is stored."""
        self.now += 1
        samples = self.samples(eye)
        np.testing.assert_array_equal(self.find(samples), self.twin.choose(samples, self.now, self.most))

    @property
    def most(self) -> int:
        """Samples that a frame traces."""
        return int(transfer_cache.MOST_TRACED * ROWS * COLS)

    def waiting_entries(self, kept: NDArray[np.int64]) -> int:
        """How many cells were too old in the last frame, and were not traced."""
        found = {int(place) for place in kept if 0 <= place < LENT}
        entries = [self.twin.entries[place] for place in found]
        return sum(self.now - entry.traced >= self.twin.period for entry in entries)

    def _check(self, chosen: NDArray[np.bool_], values: Floats) -> None:
        for array in self._arrays():
            of_sample = self._engine.download(array).view(array.dtype).reshape(ROWS * COLS, -1)
            if of_sample.dtype.names:
                of_sample = of_sample.view(np.float32).reshape(ROWS * COLS, -1)
            assert (of_sample[chosen] == values[chosen, None]).all()

    def _arrays(self) -> list[cl_array.Array]:
        transfer: Transfer = traced_transfer(self._engine, CAMERA, STRIDE, RAYS)
        assert transfer.sets is not None
        return [
            transfer.coefficients,
            transfer.openness,
            transfer.flatness,
            transfer.free_mask,
            transfer.sets,
            room_for_hits(self._engine, transfer),
            room_for_met(self._engine, transfer, RAYS),
        ]

    def _fill(self, chosen: NDArray[np.bool_], values: Floats) -> None:
        """What tracing would write: each sample's value in all its arrays."""
        for array in self._arrays():
            host: Any = self._engine.download(array)
            flat = host.view(np.float32) if host.dtype.names else host
            flat.reshape(ROWS * COLS, -1)[chosen] = values[chosen, None]
            array.set(host, self._engine.queue)


@pytest.mark.parametrize("share", [1.0, 1 / 8, 1 / 32])
@pytest.mark.parametrize(("most_places", "period"), [(1 << 20, 16), (256, 16), (64, 3)])
def test_samples_are_found_and_kept_as_by_the_twin(
    engine: Engine, monkeypatch: pytest.MonkeyPatch, most_places: int, period: int, share: float
) -> None:
    """A wide table, one that is too small, and one whose cells soon are too old; with samples that wait for their turn
    and without."""
    monkeypatch.setattr(transfer_cache, "MOST_BYTES", most_places * 4 * WORDS)
    monkeypatch.setattr(transfer_cache, "PERIOD", period)
    monkeypatch.setattr(transfer_cache, "MOST_TRACED", share)
    frames = Frames(engine, monkeypatch, places_for(ROWS * COLS, WORDS), period)
    shares, lent = [], []
    for eye in (
        np.zeros(3),
        np.zeros(3),
        np.array([0.02, -0.01, 0.0]),
        np.array([0.5, 0.5, -0.6]),
        *[np.zeros(3)] * 20,
    ):
        _, kept = frames.step(eye)
        shares.append(((kept >= 0) & (kept < LENT)).mean())
        lent.append((kept >= LENT).mean())
    assert shares[0] == 0
    assert (lent[0] > 0.15) == (share < 1)
    assert shares[1] > (0.3 if most_places > 64 else 0.05) * (1 if share == 1 else 0.3)
    assert max(shares) < 0.97  # some are invalid, and some face another way than their cell


def test_another_way_of_sampling_begins_anew(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = Frames(engine, monkeypatch, places_for(ROWS * COLS, WORDS), transfer_cache.PERIOD)
    frames.step(np.zeros(3))
    samples, kept = frames.step(np.zeros(3))
    assert ((kept >= 0) & (kept < LENT)).any()
    kept = frames.find(samples, 0.5 * REACH_M)
    assert ((kept < 0) | (kept >= LENT)).all()


def test_all_is_traced_in_a_frame_that_renews(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was kept as well: the first sample of each cell will fill it again."""
    frames = Frames(engine, monkeypatch, places_for(ROWS * COLS, WORDS), transfer_cache.PERIOD)
    frames.step(np.zeros(3))
    samples, kept = frames.step(np.zeros(3))
    is_kept = (kept >= 0) & (kept < LENT)
    assert is_kept.mean() > 0.1
    renewed = frames.find(samples, renews=True)
    assert (renewed[samples.valid] < 0).all()
    np.testing.assert_array_equal(renewed[is_kept], -2 - kept[is_kept])


def test_a_frame_that_was_given_up_leaves_no_claims(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each third frame ends before anything is stored."""
    monkeypatch.setattr(transfer_cache, "PERIOD", 3)
    frames = Frames(engine, monkeypatch, places_for(ROWS * COLS, WORDS), 3)
    for _ in range(8):
        frames.step(np.zeros(3))
        _, kept = frames.step(np.zeros(3))
        frames.give_up(np.zeros(3))
    assert ((kept >= 0) & (kept < LENT)).mean() > 0.4


@pytest.mark.parametrize("share", [0.0, 1 / 8])
def test_no_cell_waits_for_ever(engine: Engine, monkeypatch: pytest.MonkeyPatch, share: float) -> None:
    """However few are traced: each cell that is in view again and again is traced ORDERS frames after its time."""
    monkeypatch.setattr(transfer_cache, "MOST_TRACED", share)
    monkeypatch.setattr(transfer_cache, "PERIOD", 3)
    frames = Frames(engine, monkeypatch, places_for(ROWS * COLS, WORDS), 3)
    samples = frames.samples(np.zeros(3))
    monkeypatch.setattr(frames, "samples", lambda _: samples)
    for _ in range(80):
        _, kept = frames.step(np.zeros(3))
        seen = [entry for entry in frames.twin.entries.values() if entry.used == frames.now]
        assert max((frames.now - entry.traced - 3 for entry in seen), default=0) <= ORDERS
    if share > 0:
        assert (kept >= LENT).mean() < 0.02


def test_the_table_has_four_places_a_sample_up_to_its_bound() -> None:
    assert places_for(19200, 58) == 1 << 17
    assert places_for(1 << 17, 58) == 1 << 19
    assert places_for(640 * 480, 58) == 1 << 20
    assert places_for(640 * 480, 64) == 1 << 20  # 256 MB
    assert places_for(640 * 480, 65) == 1 << 19
    assert places_for(1, 58) == 4
