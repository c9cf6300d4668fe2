"""The colour of a room's light: the minimum of equation (2), and which casts are taken for the light's."""

from __future__ import annotations

import numpy as np
import pytest

from server.light.shell import weights
from server.light.shell.evidence import DARKEST, LOG_CHROMA, log_chroma, materials_of
from tests.reference.room_objective import chroma_objective
from tests.scenes.analytic import Floats
from tests.scenes.shell_room import Lamp, make_room

AMBIENT = (0.3, 0.3, 0.3)


def test_the_chroma_is_a_minimum(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the twin of equation (2), with a stain on the floor and a lamp of another colour than the rest."""
    monkeypatch.setattr(weights, "HUBER", np.inf)
    room = make_room(Lamp((3.0, 0.9), 0.7, (20.0, 15.0, 9.0)), AMBIENT)
    stained = np.linalg.norm(room.patches.positions[:, :2] - [1.0, 1.2], axis=1) < 0.3
    room.patches.logarithms[stained] += [0.06, 0.0, -0.08]
    room.solve(60)
    data, near, unknowns = room.evidence, room.near, room.unknowns
    known_logs = log_chroma(np.log(np.maximum(near.known, DARKEST)))
    known = np.where(near.known.max(axis=1) > 0, np.exp(known_logs[:, 0]), 0.0)
    arriving = near.shares @ np.exp(unknowns.z) + known
    parts = near.shares * np.exp(unknowns.z) / arriving[:, None]
    seen = data.chroma - (known / arriving)[:, None] * known_logs[:, 1:]
    nodes, shares_of_materials = materials_of(seen - parts @ unknowns.chroma)
    albedos = np.log(1 / (1 + np.exp(-(shares_of_materials @ unknowns.materials[nodes]))))
    albedos += unknowns.offsets[data.rows]
    least, most = np.quantile(albedos, [0.91, 0.99])
    brightest = (albedos >= least) & (albedos <= most)

    def value(chroma: Floats) -> float:
        return chroma_objective(chroma, parts, seen, data.surfaces, data.regions, brightest)

    best, random = value(unknowns.chroma), np.random.default_rng(2)
    for size in (0.3, 0.1, 0.03):
        for _ in range(3):
            assert value(unknowns.chroma + size * random.normal(size=unknowns.chroma.shape)) > best
    for cell in np.argsort(-parts.sum(axis=0))[:6]:
        moves = [sign * 0.05 * np.outer(np.eye(len(unknowns.chroma))[cell], (1.0, 0.0)) for sign in (-1, 1)]
        lower, higher = (value(unknowns.chroma + move) for move in moves)
        slope, bend = (higher - lower) / 0.1, (higher + lower - 2 * best) / 0.05**2
        # Seen: .007. What a region has beyond its surface's sets the width of its prior before that has shrunk it.
        assert abs(slope / bend) < 0.01


def test_a_cast_is_the_lights_sooner_if_it_is_like_a_black_bodys(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nothing is known to be white, a room and its light share a cast: of a green one the light takes less."""
    monkeypatch.setattr(weights, "WHITE_CHROMA_SPREAD", 10.0)
    across = np.array([weights.TINT_AXIS[1], -weights.TINT_AXIS[0]])
    taken = []
    for axis in (-weights.TINT_AXIS, -across):
        color = np.exp(np.linalg.inv(LOG_CHROMA) @ [0.0, *(0.3 * axis)])
        room = make_room(None, tuple(color))
        room.solve(30)
        parts = room.near.shares @ np.exp(room.unknowns.z)
        found = (room.near.shares * np.exp(room.unknowns.z) / parts[:, None]) @ room.unknowns.chroma
        taken.append(float(found.mean(axis=0) @ axis) / 0.3)
    assert taken[0] > 2 * taken[1], taken
    assert taken[1] > 0, taken
