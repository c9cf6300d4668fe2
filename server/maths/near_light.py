"""Point emitters beside a light from afar: are there any, where, how strong, how sure.

Model: y = B x + sum_k g(q_k) i_k + noise, with B x, x >= 0, what comes from outside (lobes of the sky, and the
surround: what shines in from beyond what was reconstructed), i_k >= 0 the intensity of an emitter at q_k and
g(q) = V max(n.w, 0) / (pi d^2) what samples see of it.

An emitter is believed where samples of places that the fit has not seen agree: model errors are alike within a place,
so no count of samples would tell a lamp from them.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from server.maths.emitters import Emitter, Scene, Shares, blocks_of, share_slopes
from server.maths.robust_squares import (
    Blocks,
    Bools,
    Fit,
    Floats,
    centered,
    fit,
    gain_at_unseen_places,
    gains,
    normal_equations,
    solve,
)
from server.maths.sh import LUMINANCE

Result = TypeVar("Result")
Steps = Generator[int, None, Result]
"""Work in pieces, between which other work may be done; each yield says what the next takes: STEP, LONG_STEP."""
STEP, LONG_STEP = 1, 4
"""About five milliseconds of processor time, and twenty."""

LEAST_MISFIT = 0.02
"""Median error of the light from outside, in proportion, below which it explains all there is."""
LEAST_PLACES = 24
"""Fewer are too few to leave some out: a table top of one metre has ten, a room sixty and more."""
LEAST_GAIN = 0.6
"""Of the variance that light from outside leaves unexplained at unseen places: what an emitter must explain."""
LEAST_SHARE = 0.03
"""Of all light that the samples receive: what is less is not told from errors."""
MOST_EMITTERS = 2
_AT_ONCE = 256  # candidates a step
_STARTS = 3
_COARSE = 2  # steps by whose end the best start is known
_APART_M = 0.4
_STEPS_M = (0.12, 0.06, 0.03, 0.015)
_MOVES = 3  # with each step, at most
_POLISH = 3
_EDGE_M = 0.1  # how far an emitter is moved to see which samples lie at the edge of a shadow
_FOLDS = 5
_LEAST_SEEN = 0.02  # of the samples must see a candidate
_STENCIL = np.stack(np.meshgrid(*[np.arange(-1.0, 2.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
_MIDDLE = 13


@dataclass(frozen=True)
class Found:
    """The result of a search."""

    emitters: tuple[Emitter, ...]
    """The strongest first."""
    outside: Floats
    """[columns] luminance of each source outside."""
    misfit: float
    """Of the samples' luminance under all of it: see `misfit`."""

    def predicted(self, outside: Floats, shares: Floats) -> Floats:
        """[n] luminance that other samples would show: `outside` as in Scene, shares [emitters, n] of the emitters."""
        intensities = np.array([emitter.intensity @ LUMINANCE for emitter in self.emitters])
        return np.asarray(outside @ self.outside + intensities @ shares.reshape(-1, len(outside)))


def result_of(steps: Steps[Result]) -> Result:
    """All steps at once."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: Result = end.value
            return result


def misfit(values: Floats, predicted: Floats) -> float:
    """Median of the error in proportion to the light; what is darker than the mean counts less."""
    return float(np.median(np.abs(values - predicted) / (values + values.mean() + 1e-12)))


def find_emitters(
    scene: Scene, shares: Shares, candidates: Floats, most: int = MOST_EMITTERS, least_misfit: float = LEAST_MISFIT
) -> Steps[Found]:
    """Emitters that the light from outside does not explain. candidates: [n, 3] where to look.

    Where light from outside alone leaves less than `least_misfit`, or samples show few places, none is looked for.
    """
    if not (scene.values > 0).any():
        return Found((), np.zeros(scene.outside.shape[1]), 0.0)
    search = _Search(scene, shares)
    nothing = search.result([], [])
    if search.places() < LEAST_PLACES or nothing.misfit < least_misfit:
        return nothing
    yield STEP
    found: list[Floats] = []
    strengths: list[float] = []
    while len(found) < most:
        columns = search.columns(found)
        position = yield from search.best_place(columns, candidates)
        gain = search.gain(columns, position) if position is not None else 0.0
        yield STEP
        if position is None or gain < LEAST_GAIN:
            break
        found.append(position)
        strengths.append(gain)
        for k in range(len(found) if len(found) > 1 else 0):  # each once more beside the others
            others = search.columns(found[:k] + found[k + 1 :])
            found[k] = yield from search.refined(others, found[k])
    return search.result(found, strengths)


class _Search:
    """What all steps look at."""

    def __init__(self, scene: Scene, shares: Shares) -> None:
        numbers = blocks_of(scene.positions, scene.normals)
        self._order = np.argsort(numbers, kind="stable")
        self._blocks: Blocks = numbers[self._order]
        ordered = (scene.positions, scene.normals, scene.values, scene.outside)
        self._scene = Scene(*(values[self._order] for values in ordered))
        self._shares = shares
        self.values = self._scene.values @ LUMINANCE
        self.base = fit(self._scene.outside, self.values)

    def places(self) -> int:
        """How many places the samples show."""
        return int(self._blocks[-1]) + 1

    def columns(self, emitters: list[Floats]) -> Floats:
        """[n, columns + emitters]: the light from outside, and that of emitters [3] each."""
        if not emitters:
            return self._scene.outside
        return np.column_stack([self._scene.outside, self._seen(np.array(emitters)).T])

    def best_place(self, columns: Floats, candidates: Floats) -> Steps[Floats | None]:
        """[3] where one more emitter explains most, of several starts; None where the samples see no candidate."""
        base = fit(columns, self.values, start=self.base)
        strengths = np.zeros(len(candidates))
        for first in range(0, len(candidates), _AT_ONCE):
            yield LONG_STEP
            some = slice(first, first + _AT_ONCE)
            seen = self._seen(candidates[some])
            enough = (seen > 0).mean(axis=1) > _LEAST_SEEN
            strengths[some] = np.where(enough, gains(columns, self.values, base, seen), 0.0)
        scale = base.predicted + float(base.predicted.mean()) + 1e-12
        best, place = np.inf, None
        for start in _starts(candidates, strengths):
            yield LONG_STEP
            tried = yield from self._moved(columns, candidates[start], _STEPS_M[:_COARSE], base)
            found = fit(self._and(columns, tried), self.values, None, self._blocks, base)
            error = float(np.sum(np.abs(self.values - found.predicted) / scale))
            if error < best:
                best, place = error, tried
        if place is None:
            return None
        return (yield from self.refined(columns, place, _STEPS_M[_COARSE - 1 :]))

    def refined(self, columns: Floats, start: Floats, steps_m: tuple[float, ...] = _STEPS_M) -> Steps[Floats]:
        """[3] where it explains most within places, by stencils of falling size and Gauss-Newton steps."""
        position = yield from self._moved(columns, start, steps_m, self.base)
        for _ in range(_POLISH):
            position = position + self._newton_step(columns, position)
            yield STEP
        return position

    def _moved(self, columns: Floats, start: Floats, steps_m: tuple[float, ...], base: Fit) -> Steps[Floats]:
        """[3] the best of a stencil, and of one around that, with each of falling steps: its shadows move with it."""
        position, count, whole = start, columns.shape[1], base
        for step in steps_m:
            more = np.column_stack([columns, self._seen(position[None])[0]])
            clear = ~self._shadow_edges(position)
            whole = fit(more, self.values, clear, self._blocks, whole)
            both = centered(np.column_stack([columns, self.values]), whole.weights, self._blocks)
            without = Fit(whole.x[:count], whole.weights, whole.predicted)
            for _ in range(_MOVES):
                around = position + step * _STENCIL
                seen = centered(self._seen(around).T, whole.weights, self._blocks).T
                moved = int(gains(both[:, :count], both[:, count], without, seen).argmax())
                yield STEP
                if moved == _MIDDLE:
                    break
                position = around[moved]
        return position

    def _newton_step(self, columns: Floats, position: Floats) -> Floats:
        """[3] Gauss-Newton step of the position, with all columns in use; its shadows stay where they are."""
        more = self._and(columns, position)
        found = fit(more, self.values, ~self._shadow_edges(position), self._blocks, self.base)
        slope = self._slope(more[:, -1], float(found.x[-1]), position)
        own = centered(np.column_stack([slope, more[:, found.x > 0]]), found.weights, self._blocks)
        root = np.sqrt(found.weights)
        step = np.linalg.lstsq(own * root[:, None], root * (self.values - found.predicted), rcond=1e-9)[0][:3]
        length = float(np.linalg.norm(step))
        return np.asarray(step * min(1.0, _STEPS_M[-1] / max(length, 1e-12)))

    def _slope(self, seen: Floats, intensity: float, position: Floats) -> Floats:
        """[n, 3] derivative of what an emitter sends to the samples, those in its shadow left alone."""
        slope = share_slopes(self._scene.positions, self._scene.normals, position)
        return intensity * slope * (seen > 0)[:, None]

    def gain(self, columns: Floats, position: Floats) -> float:
        """What an emitter explains at places that the fit has not seen; 0 where it is too weak to matter."""
        column = self._seen(position[None])[0]
        found = fit(np.column_stack([columns, column]), self.values, ~self._shadow_edges(position), None, self.base)
        if found.x[-1] * column.sum() <= LEAST_SHARE * self.values.sum():
            return 0.0
        return gain_at_unseen_places(columns, column, self.values, found, self._blocks, _FOLDS)

    def result(self, positions: list[Floats], strengths: list[float]) -> Found:
        """Colours, solved together with the light from outside, and covariances."""
        if not positions:
            return Found((), self.base.x, misfit(self.values, self.base.predicted))
        columns, first = self.columns(positions), self._scene.outside.shape[1]
        edges = np.any([self._shadow_edges(position) for position in positions], axis=0)
        luminance = fit(columns, self.values, ~edges)
        within = fit(columns, self.values, ~edges, self._blocks)
        colors = np.stack(
            [
                solve(*normal_equations(np.column_stack([columns, channel]), luminance.weights), luminance.x > 0)[0]
                for channel in self._scene.values.T
            ],
            axis=1,
        )
        result = []
        for k, (position, gain) in enumerate(zip(positions, strengths, strict=True), first):
            variance = float(self._covariance(columns, luminance, k, position)[3, 3])
            deviation = colors[k] * np.sqrt(variance) / max(float(luminance.x[k]), 1e-12)
            covariance = self._covariance(columns, within, k, position, self._blocks)
            share = float(columns[:, k].sum() * luminance.x[k] / self.values.sum())
            result.append(Emitter(position, colors[k], covariance[:3, :3], deviation, gain, share))
        return Found(tuple(result), luminance.x[:first], misfit(self.values, luminance.predicted))

    def _seen(self, emitters: Floats) -> Floats:
        return np.asarray(self._shares(emitters)[:, self._order], np.float64)

    def _and(self, columns: Floats, position: Floats) -> Floats:
        return np.column_stack([columns, self._seen(position[None])[0]])

    def _shadow_edges(self, position: Floats) -> Bools:
        """[n] samples that some places beside `position` light and others do not."""
        around = position + _EDGE_M * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
        lit = self._seen(around) > 0
        return np.asarray(lit.any(axis=0) & ~lit.all(axis=0))

    def _covariance(
        self, columns: Floats, found: Fit, index: int, position: Floats, blocks: Blocks | None = None
    ) -> Floats:
        """[4, 4] of an emitter's position and luminous intensity, from the joint normal equations of all columns in
        use, within `blocks` where the fit was. Errors are alike within a place, so each place's score counts once (a
        cluster-robust covariance).
        """
        others = (found.x > 0) & (np.arange(len(found.x)) != index)
        slope = self._slope(columns[:, index], float(found.x[index]), position)
        jacobian = np.column_stack([slope, columns[:, index], columns[:, others]])
        if blocks is not None:
            jacobian = centered(jacobian, found.weights, blocks)
        weighted = jacobian * found.weights[:, None]
        errors = (self.values - found.predicted)[:, None]
        scores = np.add.reduceat(weighted * errors, np.flatnonzero(np.diff(self._blocks, prepend=-1)), axis=0)
        inverse = np.linalg.pinv(weighted.T @ jacobian, rcond=1e-12, hermitian=True)
        spread = len(scores) / max(len(scores) - jacobian.shape[1], 1)  # what the fit has taken from the scores
        return np.asarray((inverse @ (scores.T @ scores) @ inverse)[:4, :4] * spread)


def _starts(candidates: Floats, strengths: Floats) -> list[int]:
    """The best candidates that are not beside a better one."""
    chosen: list[int] = []
    for index in np.argsort(-strengths, kind="stable"):
        away = [float(np.linalg.norm(candidates[index] - candidates[other])) for other in chosen]
        if strengths[index] > 0 and min(away, default=np.inf) > _APART_M:
            chosen.append(int(index))
        if len(chosen) == _STARTS:
            break
    return chosen
