"""Pools whose light and albedos are known, and an estimator that is given them in place of pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from server.light.cell_transfer import PoolGrid, Pools
from server.light.light_estimation import ASSUMED_ALBEDO, LightEstimate
from server.light.light_model import LightModel
from server.light.lobe_estimator import LobeEstimator
from server.maths.light_change import Shot
from server.maths.lobes import CELL_SR, cell_directions
from server.maths.sh import LUMINANCE, spherical_fibonacci
from tests.scenes.analytic import Floats

GRID = PoolGrid(2, 40, 50)
TINT = np.array([1.0, 0.8, 0.6])
SUN = (0.4, -0.7, 0.5)
ALL_AROUND = spherical_fibonacci(500)
CONSTANT = LightModel(albedos=False)


def sun(towards: tuple[float, ...] | Floats = SUN, width_deg: float = 30.0, color: Floats = TINT) -> Floats:
    """[CELLS, 3] of a dim sky and a soft light of one tint."""
    to = np.array(towards) / np.linalg.norm(towards)
    apart = np.arccos(np.clip(cell_directions() @ to, -1, 1))
    return (0.2 + 3 * np.exp(-0.5 * (apart / np.deg2rad(width_deg)) ** 2))[:, None] * color


@dataclass
class View:
    """The pools of one frame, on the host."""

    normals: Floats
    """[n, 3]."""
    transfer: Floats
    """[n, CELLS]."""
    albedo: Floats
    """[n, 3]."""
    sent: Floats
    """[n, 3]."""

    @classmethod
    def of(cls, normals: Floats = ALL_AROUND, seed: int = 0, hidden: bool = False) -> View:
        """Grey surface with some of `normals` [k, 3] in a random order; `hidden`: half of it sees half of its sky."""
        rng = np.random.default_rng(seed)
        chosen = normals[rng.integers(0, len(normals), GRID.count)]
        transfer = np.maximum(chosen @ cell_directions().T, 0) * CELL_SR / np.pi
        if hidden:
            blocker = spherical_fibonacci(300)[rng.integers(0, 300, GRID.count)] @ cell_directions().T > 0
            transfer = np.where(blocker & (rng.random(GRID.count) < 0.5)[:, None], 0, transfer)
        return cls(chosen, transfer, np.full((GRID.count, 3), ASSUMED_ALBEDO), np.zeros((GRID.count, 3)))

    def under(self, light: Floats, noise: float = 0.01, seed: int = 0) -> Pools:
        """What is seen of it; noise relative to it, and a tenth of that to the mean of all."""
        seen = self.albedo * (self.transfer @ light + self.sent)
        scale = noise * (seen + 0.1 * seen.mean())
        seen = seen + scale * np.random.default_rng(seed).normal(size=seen.shape)
        return Pools(
            grid=GRID,
            seen=np.maximum(seen, 0.0),
            sent=self.sent,
            unseen=np.zeros(GRID.count),
            weights=np.ones(GRID.count),
            positions=2.0 * self.normals,  # the inside of a ball: the same surface in every frame
            normals=self.normals,
            open=self.transfer.sum(axis=1),
            beyond=np.zeros(3),
        )


class Run(LobeEstimator):
    """An estimator that is given pools instead of pictures."""

    def add(self, view: View, pools: Pools) -> LightEstimate:
        window, slot = self._window_for(GRID), self._kept.free_slot()
        for array in (window.raw, window.values):
            array[slot].set(view.transfer.astype(np.float32))
        return self.fold(slot, pools, Shot(np.eye(4)))

    @property
    def lightness(self) -> Floats:
        """Relative albedo of the pools in use, frame by frame."""
        assert self._last is not None
        return self._last[1].lightness

    @property
    def mean_albedo(self) -> float:
        assert self._solution is not None
        return self._solution.mean_albedo


def direction(sh: Floats) -> Floats:
    """Of the luminance."""
    return (sh @ LUMINANCE)[[3, 1, 2]]


def halves(seed: int, share: float, dark: float, bright: float) -> tuple[View, Floats]:
    """Half black, half white: `share` of what faces +x is black, and as much of the rest white; and what is black."""
    view = View.of(seed=seed, hidden=True)
    black = (view.normals[:, 0] > 0) ^ (np.random.default_rng(7 + seed).random(GRID.count) > share)
    view.albedo = np.where(black, dark, bright)[:, None] * np.ones(3)
    return view, black
