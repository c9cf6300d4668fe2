"""Bounds of what is left out: the inequalities that they rest on, and the rules."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from server.culling import rules as o
from server.culling.influence_bound import NOWHERE, UNKNOWN, InfluenceBound
from server.culling.reason import ALLOWANCE
from server.culling.scene_facts import Brightness, SceneFacts, most_radiance, most_shading
from server.input.measure import linear_values
from server.maths.microfacets import HEAD_ON, most_reflected, reflected_share
from server.maths.sh import lambert_transfer, sh_basis, spherical_fibonacci
from server.shading.composite import srgb_codes

LEVELS = np.linspace(0.0, 1.0, 1001)
DARK = Brightness(picture=0.0, arriving=1e-5, shading=1e-5, object_sent=1e-6, real_sent=0.0)
LIT = Brightness(picture=0.9, arriving=2.0, shading=1.0, object_sent=0.4, real_sent=0.9)
FACTS = SceneFacts(objects_in_view=1, indirect=True, brightness=LIT, influence=UNKNOWN)


def test_codes_are_srgb() -> None:
    assert np.abs([o.codes(float(x)) for x in LEVELS] - srgb_codes(LEVELS).astype(float)).max() <= 0.5 + 1e-9


@pytest.mark.parametrize("change", [1e-5, 1e-3, 0.01, 0.2, 0.9])
def test_no_radiance_changes_by_more_codes_than_said(change: float) -> None:
    f = np.array([o.codes(float(x)) for x in LEVELS])
    added = np.array([o.codes(float(x) + change) for x in LEVELS]) - f
    times = np.array([[o.codes(float(x) * (1 + sign * change)) for x in LEVELS] for sign in (1, -1)]) - f
    assert added.max() <= o.codes(change) + 1e-9
    assert np.abs(times).max() <= o.codes_of_share(change) + 1e-9
    assert np.abs(times).max() >= 0.99 * o.codes_of_share(change)  # it is no greater than need be


def test_shares_and_codes_are_each_others_inverse() -> None:
    assert o.codes_of_share(o.share_of_codes(ALLOWANCE)) == pytest.approx(ALLOWANCE)


def test_no_direction_or_normal_exceeds_what_bands_allow() -> None:
    random, around = np.random.default_rng(2), spherical_fibonacci(4000)
    for bands in (2, 3, 4, 5):
        sh = random.normal(size=(bands * bands, 3))
        assert (np.abs(sh_basis(around, bands) @ sh).max(axis=0) <= most_radiance(sh)).all()
        assert (np.abs(lambert_transfer(around, bands) @ sh).max(axis=0) <= most_shading(sh) + 1e-12).all()
    even = np.eye(16)[:, :1] * np.ones(3)
    assert most_radiance(even) == pytest.approx(0.5 / math.sqrt(math.pi))  # sharp where it can be


def test_gloss_is_bounded_by_its_materials() -> None:
    """A smooth dielectric reflects most at grazing angles; a rough one little; a texture may say anything."""
    smooth, rough = (np.array([[r, 0.0, -1, -1]], np.float32) for r in (0.1, 1.0))
    assert most_reflected(smooth, 0.5) > 0.7
    assert most_reflected(rough, 0.5) < 0.03  # seen: 0.016
    assert most_reflected(np.array([[1.0, 0.0, -1, 0]], np.float32), 0.5) == 1.0
    both = np.concatenate([rough, smooth, rough])
    assert most_reflected(both, 0.5) == most_reflected(smooth, 0.5)
    assert pytest.approx(((1.5 - 1) / (1.5 + 1)) ** 2) == HEAD_ON  # glTF's dielectric, of index 1.5 (Fresnel)
    a, b = reflected_share(np.full(9, 0.3), np.linspace(0, 1, 9))
    assert ((a + b) <= 1.05).all()
    assert most_reflected(np.array([[0.3, 1.0, -1, -1]], np.float32), 1.0) == 1.0  # metal keeps all diffuse light


@pytest.mark.parametrize("rule", [o.unlit, o.matt, o.no_influence, o.dark_things, o.nothing_bounces])
def test_what_is_not_known_is_not_left_out(rule: object) -> None:
    facts = SceneFacts(objects_in_view=1, indirect=True, glossy=True)
    assert rule(facts) is None  # type: ignore[operator]


def test_nothing_is_lit_in_the_dark() -> None:
    dark = replace(FACTS, brightness=DARK, glossy=True)
    assert o.unlit(FACTS) is None
    assert o.unlit(dark).error_bound == pytest.approx(o.codes(1e-5))  # type: ignore[union-attr]
    assert o.matt(dark).error_bound == pytest.approx(o.codes(1e-5))  # type: ignore[union-attr]
    bright = replace(dark, gain=1000.0)
    assert o.unlit(bright) is None


def test_reach_bounds_the_picture() -> None:
    near = replace(FACTS, influence=InfluenceBound(0.004, 0.001, 0.5))
    found = o.no_influence(near)
    assert found is not None
    assert found.error_bound == pytest.approx(o.codes_of_share(0.006))
    assert o.no_influence(replace(FACTS, influence=InfluenceBound(0.01, 0.01, 0.5))) is None
    assert o.no_influence(replace(FACTS, influence=NOWHERE)).error_bound == 0.0  # type: ignore[union-attr]
    black = replace(near, brightness=DARK, influence=InfluenceBound(0.9, 0.9, 0.5))
    assert o.no_influence(black).error_bound == 0.0  # type: ignore[union-attr]


def test_bounced_light_is_bounded_by_what_it_bounces_off() -> None:
    assert o.nothing_bounces(replace(FACTS, influence=InfluenceBound(math.inf, 0.5, 0.1))) is None
    open_floor = o.nothing_bounces(replace(FACTS, influence=InfluenceBound(math.inf, 0.5, 0.002)))
    assert open_floor is not None
    assert open_floor.error_bound == pytest.approx(o.codes_of_share(0.003))
    much = o.codes_of_share(0.006)
    assert ALLOWANCE - o.ELSEWHERE < much < ALLOWANCE
    assert (
        o.nothing_bounces(replace(FACTS, influence=InfluenceBound(math.inf, 0.5, 0.004))) is None
    )  # parts of the picture come first


def test_what_is_spared_elsewhere_is_shared_out() -> None:
    """Among what is left as it is, and light that bounces off it; no byte of a picture shows less than half a code."""
    both = o.faint_pixel_share() + o.faint_sample_share()
    assert o.codes_of_share(both) == pytest.approx(o.ELSEWHERE)
    assert o.faint_shadows(FACTS).error_bound == o.ELSEWHERE
    codes = np.arange(256)
    radiance = linear_values("srgb8").astype(float)
    for share in (1 - 0.99 * both, 1 + 0.99 * both):
        assert (srgb_codes(share * radiance) == codes).all()


def test_no_more_returns_than_real_surface_sends_and_can_lose_or_gain() -> None:
    assert replace(FACTS, influence=InfluenceBound(0.1, 0.05, 0.2)).returned == pytest.approx(0.1 * LIT.real_sent)
    assert replace(FACTS, influence=InfluenceBound(math.inf, 0.5, 0.2)).returned == pytest.approx(1.5 * LIT.real_sent)
    assert FACTS.returned == math.inf
    assert replace(FACTS, brightness=DARK).returned == 0.0


def test_black_things_send_nothing() -> None:
    black = replace(FACTS, brightness=replace(LIT, object_sent=0.0))
    assert o.dark_things(black).error_bound == 0.0  # type: ignore[union-attr]
    out_of_view = replace(FACTS, objects_in_view=0, influence=InfluenceBound(1.0, 0.001, 0.0))
    assert o.dark_things(out_of_view) is not None
    assert o.dark_things(replace(out_of_view, objects_in_view=1)) is None  # they may be seen by one another
