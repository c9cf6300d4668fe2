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
from server.transfer.radiance_transfer import Cells, Transfer, direction_sets, traced_transfer
from server.transfer.transfer_cache import TransferCache, places_for
from server.volume.volume import Volume
from tests.reference.transfer_cache import Table, cell_of
from tests.scenes.analytic import Floats
from tests.scenes.lights import random_directions
from tests.scenes.solids import SCENES, fill_volume, upload_surface

ROWS, COLS, STRIDE = 13, 19, 1
CAMERA = CameraModel(width=COLS, height=ROWS, fx=40.0, fy=40.0, cx=9.0, cy=6.0)
SPACING = STRIDE / CAMERA.fx
RAYS = direction_sets(33, 2)
WORDS = 18 + 2 + 4 + 9
"""Of an entry: with 33 directions in the mask, 2 x 2 coefficients, every fourth direction's surface."""
REACH_M = 10.0
CLEAR = 1e-3
"""Margin of samples from borders of cells, over which float32 cannot carry them."""
FACES = random_directions(12, 3)


class Frames:
    """Frames of samples with values of their own, for the kernels and for the twin."""

    def __init__(self, engine: Engine, places: int, period: int) -> None:
        self.volume: Volume = fill_volume(engine, SCENES["floor under a wall"], 0.05)
        self.cache = TransferCache(engine)
        self.twin = Table(places, period, transfer_cache.LONGEST)
        self.random = np.random.default_rng(7)
        self._engine = engine
        self._now = 0
        self._near = self.random.uniform(0.3, 1.1, (90, 3))

    def samples(self, eye: Floats, places: int) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Points [n, 3] near a few places of surface, so that frames meet cells again, and their normals."""
        count = ROWS * COLS
        points, normals = np.empty((count, 3)), np.empty((count, 3))
        for i in range(count):
            while True:
                which = self.random.integers(len(self._near))
                points[i] = (self._near[which] + self.random.normal(0, 0.002 if i % 7 else 0.03, 3)).astype(np.float32)
                tilted = FACES[which % len(FACES)] + self.random.normal(0, 0.1 if i % 5 else 0.6, 3)
                normals[i] = (tilted / np.linalg.norm(tilted)).astype(np.float32)
                if cell_of(points[i], normals[i], eye, SPACING, places).margin > CLEAR:
                    break
        return points, normals, self.random.random(count) > 0.05

    def step(self, eye: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64], Cells, NDArray[np.int64]]:
        """One frame. Returns the places found by kernel and twin, and the places of all samples after it, likewise.

        All arrays of samples that were found are compared with what the twin's entries were filled from.
        """
        self._now += 1
        points, normals, valid = self.samples(eye, self.twin.places)
        shape = (ROWS, COLS)
        surface = upload_surface(
            self._engine, points.reshape(*shape, 3), normals.reshape(*shape, 3), valid.reshape(shape)
        )
        pose = np.eye(4)
        pose[:3, 3] = eye
        found = self.cache.find(CAMERA, self.volume, surface, pose, STRIDE, RAYS, REACH_M)
        by_kernel = self._engine.download(found).astype(np.int64).ravel().copy()
        by_twin = self.twin.find(points, normals, valid, eye, SPACING, self._now)
        values = self.random.integers(1, 200, ROWS * COLS).astype(float)
        np.testing.assert_array_equal(by_kernel, by_twin)
        self._fill(by_kernel < 0, values)
        for array in self._arrays():
            of_sample = self._engine.download(array).view(array.dtype).reshape(ROWS * COLS, -1)
            if of_sample.dtype.names:
                of_sample = of_sample.view(np.float32).reshape(ROWS * COLS, -1)
            for i in np.flatnonzero(by_kernel >= 0):
                assert (of_sample[i] == self.twin.entries[int(by_kernel[i])].value).all()
        cells = self.cache.store()
        after = self.twin.store(points, normals, valid, eye, SPACING, self._now, by_twin, values)
        return by_kernel, by_twin, cells, after

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


@pytest.mark.parametrize(("most_places", "period"), [(1 << 20, 16), (256, 16), (64, 3)])
def test_samples_are_found_and_kept_as_by_the_twin(
    engine: Engine, monkeypatch: pytest.MonkeyPatch, most_places: int, period: int
) -> None:
    """A wide table, one that is too small, and one whose cells soon are too old, and then last longer."""
    monkeypatch.setattr(transfer_cache, "MOST_BYTES", most_places * 4 * WORDS)
    monkeypatch.setattr(transfer_cache, "PERIOD", period)
    monkeypatch.setattr(transfer_cache, "LONGEST", 3 * period)
    frames = Frames(engine, places_for(ROWS * COLS, WORDS), period)
    shares = []
    for eye in (
        np.zeros(3),
        np.zeros(3),
        np.array([0.02, -0.01, 0.0]),
        np.array([0.5, 0.5, -0.6]),
        *[np.zeros(3)] * 20,
    ):
        found, _, cells, after = frames.step(eye)
        np.testing.assert_array_equal(engine.download(cells.places).ravel(), after)
        assert (engine.download(cells.claims) == 0xFFFFFFFF).all()
        shares.append((found >= 0).mean())
    assert shares[0] == 0
    assert shares[1] > (0.3 if most_places > 64 else 0.05)
    lasting = {entry.lasts for entry in frames.twin.entries.values()}
    assert lasting >= {period} if period > 3 else lasting == {period, 2 * period, 3 * period}
    assert max(shares) < 0.97  # some are invalid, and some face another way than their cell


def test_another_way_of_sampling_begins_anew(engine: Engine) -> None:
    frames = Frames(engine, places_for(ROWS * COLS, WORDS), transfer_cache.PERIOD)
    frames.step(np.zeros(3))
    found, _, _, _ = frames.step(np.zeros(3))
    assert (found >= 0).any()
    points, normals, valid = frames.samples(np.zeros(3), frames.twin.places)
    surface = upload_surface(
        engine, points.reshape(ROWS, COLS, 3), normals.reshape(ROWS, COLS, 3), valid.reshape(ROWS, COLS)
    )
    found = frames.cache.find(CAMERA, frames.volume, surface, np.eye(4), STRIDE, RAYS, 0.5 * REACH_M)
    assert (engine.download(found) == -1).all()


def test_the_table_has_four_places_a_sample_up_to_its_bound() -> None:
    assert places_for(19200, 58) == 1 << 17
    assert places_for(1 << 17, 58) == 1 << 19
    assert places_for(640 * 480, 58) == 1 << 20
    assert places_for(640 * 480, 64) == 1 << 20  # 256 MB
    assert places_for(640 * 480, 65) == 1 << 19
    assert places_for(1, 58) == 4
