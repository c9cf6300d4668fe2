"""The running estimate from pools whose light and albedos are known: direction, colour, albedo, memory, honesty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from server.light.cell_transfer import PoolGrid
from server.light.light_estimation import ASSUMED_ALBEDO, LightEstimate
from server.light.light_model import LightModel
from server.light.lobe_estimator import LobeEstimator
from server.maths.light_change import Shot
from server.maths.lobes import cell_directions, cells_to_sh
from server.maths.sh import LUMINANCE, spherical_fibonacci
from server.opencl.engine import Engine
from server.transfer.indirect import Indirect, mean_sent
from server.transfer.radiance_transfer import direction_sets
from tests.scenes.analytic import Floats
from tests.scenes.light_pools import CONSTANT, GRID, TINT, Run, View, direction, halves, sun
from tests.scenes.lights import degrees_between
from tests.scenes.pool_samples import Samples


def error_deg(found: Floats, light: Floats) -> float:
    """Between the directions of [n, 3] coefficients and of cells."""
    return degrees_between(direction(found), direction(cells_to_sh(4) @ light))


# ---- one grey ----------------------------------------------------------------------------------------------------


def test_a_coloured_light_is_found(engine: Engine) -> None:
    view, light = View.of(), sun()
    estimate = Run(engine, 4).add(view, view.under(light))
    true = cells_to_sh(4) @ light
    assert error_deg(estimate.sh, light) < 0.1  # seen: 0.01, of noise of a percent
    np.testing.assert_allclose(estimate.sh[:4], true[:4], atol=0.01 * np.abs(true).max())
    assert estimate.valid
    assert estimate.std is not None
    assert (estimate.std[1:4] < 0.5 * np.abs(true[1:4]).max()).all()  # a third of it for the unknown albedo
    assert np.isfinite(estimate.condition)


@pytest.mark.parametrize("model", [LightModel(), CONSTANT])
def test_one_wall_alone_does_not_fix_the_direction(engine: Engine, model: LightModel) -> None:
    view = View.of(np.array([[0.0, -1.0, 0.0]]))
    estimate = Run(engine, 4, model).add(view, view.under(sun()))
    assert not estimate.valid
    assert np.isfinite(estimate.sh).all()
    assert estimate.std is not None
    assert np.isfinite(estimate.std).all()


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_light_is_nowhere_negative(engine: Engine, noise: float) -> None:
    """Of the cells; their projection to few bands may be."""
    run, view = Run(engine, 4), View.of(hidden=True)
    run.add(view, view.under(sun(width_deg=12.0), noise))
    assert run.light is not None
    assert (run.light.cells >= 0).all()


def test_pools_that_do_not_fit_do_not_turn_the_light(engine: Engine) -> None:
    """A twentieth is five times too bright, as highlights are, all of them on one side."""
    view, light = View.of(), sun()
    pools = view.under(light)
    one_side = np.flatnonzero(view.normals[:, 0] < -0.3)
    chosen = np.random.default_rng(1).choice(one_side, GRID.count // 20, replace=False)
    pools.seen[chosen] *= 5
    errors = {}
    for outliers in (True, False):
        model = LightModel(albedos=False, outliers=outliers)
        errors[outliers] = error_deg(Run(engine, 4, model).add(view, pools).sh, light)
    assert errors[True] < 1.0  # seen: 0.66
    assert errors[False] > 5.0
    assert error_deg(Run(engine, 4).add(view, pools).sh, light) < 0.2  # seen: 0.05 at most


# ---- albedos -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dark", "bright"), [(0.05, 0.8), (0.3, 0.6)])
def test_black_and_white_surfaces_do_not_turn_the_light(engine: Engine, dark: float, bright: float) -> None:
    """Two thirds of what faces one way are black. (Of three quarters, it stays at one albedo.)"""
    light, (view, black) = sun(), halves(0, 0.65, dark, bright)
    pools = view.under(light)
    run, constant = Run(engine, 4), Run(engine, 4, CONSTANT)
    assert error_deg(run.add(view, pools).sh, light) < 0.2  # seen: 0.05 at most
    assert error_deg(constant.add(view, pools).sh, light) > 5.0
    found = run.lightness[~black].mean() / run.lightness[black].mean()
    assert found == pytest.approx(bright / dark, rel=0.15)
    assert run.materials >= 2


@pytest.mark.parametrize("levels", [(0.3, 0.6), (0.2, 0.4, 0.8)])
def test_chequered_surface_of_one_colour_is_told_apart_by_lightness(engine: Engine, levels: tuple[float, ...]) -> None:
    """Tiles, of one ochre, on every wall; the light is as if there were none."""
    light, view = sun(), View.of(hidden=True)
    tile = np.random.default_rng(3).integers(0, len(levels), GRID.count)
    view.albedo = np.array(levels)[tile][:, None] * np.array([1.0, 0.7, 0.4])
    pools, run = view.under(light), Run(engine, 4)
    assert error_deg(run.add(view, pools).sh, light) < 0.2  # seen: 0.05 at most
    assert run.materials == len(levels)
    found = np.array([run.lightness[tile == k].mean() for k in range(len(levels))])
    np.testing.assert_allclose(found / found[0], np.array(levels) / levels[0], rtol=0.05)


COLORS = np.array([[0.8, 0.35, 0.3], [0.3, 0.6, 0.3], [0.3, 0.35, 0.8], [0.6, 0.6, 0.6]])


def painted_walls(seed: int = 0) -> View:
    """Four walls, floor and ceiling, and round things in front of them; walls red, green and blue, all else grey."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    view = View.of(np.concatenate([np.repeat(axes, 60, axis=0), spherical_fibonacci(200)]), seed, hidden=True)
    wall = (view.normals @ axes[[0, 2, 3]].T > 0.999).astype(float)
    which = np.where(wall.any(axis=1), wall.argmax(axis=1), 3)
    view.albedo = COLORS[which]
    return view


def hue(sh: Floats) -> Floats:
    """[k, 3] of coefficients [k, 3]: their channels' share in the direction of the luminance, over all."""
    along = sh @ LUMINANCE
    strength = along @ sh
    return np.asarray(strength / strength.sum())


def test_coloured_surfaces_leave_a_white_light_white(engine: Engine) -> None:
    """But for the mean colour of all surfaces, which none can tell from the light's."""
    light, view = sun(color=np.ones(3)), painted_walls()
    pools = view.under(light)
    found, constant = (Run(engine, 4, model).add(view, pools).sh for model in (None, CONSTANT))
    assert error_deg(found, light) < 3.0 < error_deg(constant, light)
    apart = [np.abs(hue(sh[1:4]) - sh[0] / sh[0].sum()).max() for sh in (found, constant)]
    assert apart[0] < 0.01 < apart[1]


def test_coloured_light_on_white_surfaces_stays_coloured(engine: Engine) -> None:
    """A warm light from one side, a blue one from the other, none of them strong enough to be a surface's colour."""
    warm, blue = (
        sun((0.8, -0.5, 0.2), 35.0, np.array([1.0, 0.9, 0.8])),
        sun((-0.7, -0.5, 0.4), 35.0, np.array([0.8, 0.9, 1.0])),
    )
    light, view = 0.5 * (warm + blue), View.of()
    found = Run(engine, 4).add(view, view.under(light)).sh
    true = cells_to_sh(4) @ light
    np.testing.assert_allclose(found[:4], true[:4], atol=0.02 * true[0].max())
    assert error_deg(found, light) < 0.1  # seen: 0.013
    redder = [sh[3, 0] - sh[3, 2] for sh in (found, true)]
    assert redder[0] == pytest.approx(redder[1], rel=0.3)


# ---- indirect light ----------------------------------------------------------------------------------------------


def corners(albedo: float, seed: int = 0) -> View:
    """Surface that sees a third to all of its sky, past two things that hide the rest."""
    rng, view = np.random.default_rng(seed), View.of(seed=seed)
    for _ in range(2):
        blocker = spherical_fibonacci(300)[rng.integers(0, 300, GRID.count)] @ cell_directions().T
        view.transfer = np.where(blocker > rng.uniform(-0.2, 0.8, (GRID.count, 1)), 0, view.transfer)
    view.albedo[:] = albedo
    return view


@pytest.mark.parametrize("albedo", [0.3, 0.7])
def test_light_that_surfaces_send_tells_the_mean_albedo(engine: Engine, albedo: float) -> None:
    """Where it is most of the light: what is sent shows times the albedo, and the light is as before."""
    light, view = sun(), corners(albedo)
    hidden = np.maximum(1 - view.transfer.sum(axis=1), 0)[:, None]
    view.sent = hidden * np.random.default_rng(5).uniform(0, 2, (GRID.count, 1)) * TINT
    pools, run = view.under(light), Run(engine, 4)
    estimate = run.add(view, pools)
    assert run.mean_albedo == pytest.approx(albedo, abs=0.1)
    assert error_deg(estimate.sh, light) < 0.3  # seen: 0.08
    # The albedo is known to 0.1. Seen: 0.027.
    np.testing.assert_allclose(estimate.sh[0], (cells_to_sh(4) @ light)[0], rtol=0.1)
    left_out = Run(engine, 4).add(view, replace(pools, sent=np.zeros_like(pools.sent)))
    assert error_deg(left_out.sh, light) > 4.0


@pytest.mark.parametrize("albedo", [0.3, 0.7])
def test_light_that_surfaces_send_each_other_is_explained(engine: Engine, albedo: float) -> None:
    """In a room of this albedo it is a part of the light: the mean albedo is drawn to the assumed one, yet not all the
    way."""
    light, view = sun(), corners(albedo)
    hidden = np.maximum(1 - view.transfer.sum(axis=1), 0)[:, None]
    met = np.random.default_rng(9).integers(0, GRID.count, (GRID.count, 3))
    for _ in range(20):
        view.sent = hidden * (view.albedo * (view.transfer @ light + view.sent))[met].mean(axis=1)
    pools, run = view.under(light), Run(engine, 4)
    estimate = run.add(view, pools)
    assert error_deg(estimate.sh, light) < 0.3  # seen: 0.08
    share = (run.mean_albedo - ASSUMED_ALBEDO) / (albedo - ASSUMED_ALBEDO)
    assert 0.25 < share < 1.1


# ---- from frame to frame -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", [LightModel(), CONSTANT])
def test_a_light_that_jumps_is_followed_within_three_frames(engine: Engine, model: LightModel) -> None:
    before, after, run = sun(), sun((-0.8, -0.3, -0.1)), Run(engine, 4, model)
    for seed in range(10):
        view = View.of(seed=seed)
        run.add(view, view.under(before, seed=seed))
    for seed in range(3):
        view = View.of(seed=20 + seed)
        estimate = run.add(view, view.under(after, seed=seed))
    assert error_deg(estimate.sh, after) < 0.1  # seen: 0.02


def steady_errors(engine: Engine, model: LightModel, frames: int = 12) -> Floats:
    """Degrees, frame by frame, of a light whose pictures have much noise."""
    light, run, errors = sun(), Run(engine, 4, model), []
    for seed in range(frames):
        view = View.of(seed=seed)
        errors.append(error_deg(run.add(view, view.under(light, 0.5, seed)).sh, light))
    return np.array(errors)


def test_frames_are_averaged_while_the_light_is_steady(engine: Engine) -> None:
    alone = steady_errors(engine, LightModel(albedos=False, memory=False))
    together = steady_errors(engine, CONSTANT)
    assert together[0] == alone[0]
    assert together[4:].mean() < 0.7 * alone[4:].mean()


@pytest.mark.parametrize("model", [LightModel(), CONSTANT])
@pytest.mark.parametrize("noise", [0.01, 0.1])
def test_a_light_that_moves_slowly_does_not_lag(engine: Engine, model: LightModel, noise: float) -> None:
    """2 degrees a frame: a memory that is right for a steady light is 7 degrees behind. In clear pictures each frame
    shows the change; in noisy ones it takes some until the memory that would have foretold them is known."""
    run, errors = Run(engine, 4, model), []
    for step in range(16):
        angle = np.deg2rad(2.0 * step)
        light = sun((np.cos(angle), -0.5, np.sin(angle)))
        view = View.of(seed=step)
        errors.append(error_deg(run.add(view, view.under(light, noise, step)).sh, light))
    assert max(errors[-3:]) < 3.0
    assert max(errors) < (2.0 if noise < 0.1 else 6.0)


def test_pictures_cut_into_more_pools_begin_anew(engine: Engine) -> None:
    """As after a change of preset: nothing is taken from a window that is too small. Fewer fit into it."""
    run, view, few, light = Run(engine, 4), View.of(), PoolGrid(4, 20, 25), sun()
    small = run._window_for(few)
    run.add(view, view.under(light))
    window = run._window
    assert window is not small
    assert run._window_for(few) is window
    assert run._kept.frames
    assert run._window_for(PoolGrid(2, GRID.rows + 1, GRID.cols)) is not window
    assert not run._kept.frames


def test_a_frame_that_sees_nothing_leaves_the_estimate(engine: Engine) -> None:
    """Nothing usable, and nothing but black; before the first light, and after."""
    samples = Samples.random(96, 96, direction_sets(33, 2))
    black, none = (replace(samples, observed=samples.observed * keep) for keep in ([0, 0, 0, 1], [0, 0, 0, 0]))
    run = LobeEstimator(engine, 4)

    def update(of: Samples) -> LightEstimate:
        surface, camera, transfer, observed, hits = of.upload(engine)
        depth = engine.workspace.upload("d", np.ones((camera.height, camera.width), np.float32))
        indirect = Indirect(hits, mean_sent(engine, hits))
        return run.update(surface, camera, transfer, of.rays, observed, indirect, 0.01, Shot(np.eye(4)), depth)

    for nothing in (none, black):
        estimate = update(nothing)
        assert not estimate.valid
        assert estimate.std is None
        assert not estimate.sh.any()
    known = update(samples)
    assert known.sh[0].min() > 0
    for nothing in (none, black):
        np.testing.assert_array_equal(update(nothing).sh, known.sh)
    assert run.estimate() is known
    assert np.isfinite(update(samples).sh).all()
