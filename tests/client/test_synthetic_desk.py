"""synthetic:desk: the light that surfaces send to each other conserves power; where its parts stand."""

from __future__ import annotations

import numpy as np

from client.synthetic.lighting.bounced import BOUNCES, bounced
from client.synthetic.lighting.lamps import Lamp, lamplight
from client.synthetic.lighting.lights import DistantLight
from client.synthetic.render import LitSolid
from client.synthetic.scenes import desk
from client.synthetic.solids.charts import atlas
from client.synthetic.solids.shell import Shell
from client.synthetic.source import open_synthetic

ALBEDO = 0.5


def test_all_that_walls_send_arrives_at_walls() -> None:
    """In a closed room of albedo a, each bounce brings a times the mean of what the last one brought."""
    shell = Shell(np.zeros(3), np.array([1.6, 1.2, 1.0]), ())
    grids = atlas([shell.charts], 0.1)
    dark = DistantLight(np.array([0.0, 1.0, 0.0]), np.zeros((16, 3)))
    table = np.zeros((sum(grid.size for grid in grids[0]), 3), np.float32)
    body = LitSolid(shell, lambda points: np.full((len(points), 3), ALBEDO), grids[0], ((grids[0], table),))
    lamp = Lamp(np.array([0.9, 0.7, 0.4]), np.array([1.0, 0.5, 0.25]))
    found = bounced([body], grids, (lamp,), dark)
    area = 2 * (1.6 * 1.2 + 1.6 * 1.0 + 1.2 * 1.0)
    arriving = 4 * lamp.intensity / area  # 4 pi I over the walls and over pi
    expected = arriving * sum(ALBEDO**k for k in range(1, BOUNCES + 1))
    random, sums, total = np.random.default_rng(3), np.zeros(3), 0.0
    for grid in grids[0]:
        points, _ = grid.chart.point(*random.random((2, 4000)))
        wall = float(np.prod(grid.chart.lengths_m))
        sums, total = sums + wall * grid.interpolate(found, points).mean(axis=0), total + wall
    np.testing.assert_allclose(total, area)
    np.testing.assert_allclose(sums / total, expected, rtol=0.03)


def test_the_free_place_is_free_and_lit_by_the_lamp() -> None:
    source = open_synthetic("synthetic:desk?frames=2&size=96x72")
    above = np.array(desk.FREE_M) + np.array([0.0, 0.01, 0.0])
    for body in source.scene.bodies:
        if body.solid.bounds is not None:
            assert not body.solid.contains(above[None] + np.linspace(0, 0.2, 9)[:, None] * [0, 1, 0]).any()
    down = above - np.array([0.0, 0.01, 0.0])
    assert lamplight(source.lamps, source.scene.solids, down[None], np.array([[0.0, 1.0, 0.0]])).min() > 0.05


def test_the_lamp_is_in_view_and_clipped() -> None:
    source = open_synthetic("synthetic:desk?frames=2&size=160x120")
    frame = source[0]
    row, col = np.unravel_index(int(frame.color.min(axis=2).argmax()), frame.color.shape[:2])
    assert frame.color[row, col].min() == 255
    camera = source.camera
    away = np.linalg.inv(source.pose(0)) @ [*desk.BULB_M, 1.0]
    at = away[:2] / away[2] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    assert np.hypot(*(at - [col, row])) < 12
