"""The planner on toy effects, and what the real table of effects runs for each kind of scene."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from server.culling.influence_bound import NOWHERE
from server.culling.reason import ALLOWANCE, CullReason
from server.culling.rules import ELSEWHERE
from server.culling.scene_facts import Brightness, SceneFacts
from server.effects.plan import Effect, PlanError, execute, make_plan
from server.effects.table import EFFECTS, effects_of
from server.rendering import GIVEN as EFFECTS_GIVEN
from server.shading.tone_mapping import Averages

Toy = Effect[frozenset[str]]


def unless(called_for: str, bound: float = 0.0) -> Callable[[frozenset[str]], CullReason | None]:
    """Left out where the facts do not hold `called_for`."""
    return lambda facts: None if called_for in facts else CullReason(f"no {called_for}", bound)


def render(camera: str) -> str:
    return f"render({camera})"


def shade(render: str, light: str) -> str:
    return f"shade({render}, {light})"


def glow(camera: str) -> str:
    return f"glow({camera})"


def picture(camera: str, shade: str = "-", glow: str = "-") -> str:
    return f"picture({camera}, {shade}, {glow})"


TOYS: tuple[Toy, ...] = (
    Effect(picture, writes="picture"),
    Effect(glow, writes="glow", omitted=unless("lamp", 3.0)),
    Effect(shade, writes="shade", omitted=unless("object")),
    Effect(render, writes="render", omitted=unless("object")),
)
GIVEN = {"camera": "c", "light": "l"}


def names(order: list[Any]) -> list[str]:
    return [effect.name for effect in order]


@pytest.mark.parametrize(
    ("facts", "run", "left_out", "result"),
    [
        ("", ["picture"], {"shade", "glow"}, "picture(c, -, -)"),
        ("lamp", ["glow", "picture"], {"shade"}, "picture(c, -, glow(c))"),
        ("object", ["render", "shade", "picture"], {"glow"}, "picture(c, shade(render(c), l), -)"),
        ("object lamp", ["render", "shade", "glow", "picture"], set(), "picture(c, shade(render(c), l), glow(c))"),
    ],
)
def test_only_what_is_called_for_runs(facts: str, run: list[str], left_out: set[str], result: str) -> None:
    order, plan = make_plan(TOYS, "picture", GIVEN, frozenset(facts.split()))
    assert names(order) == run == list(plan.run)
    assert {item.effect for item in plan.left_out} == left_out
    assert execute(order, GIVEN, "picture") == result


def test_reasons_and_bounds_are_said() -> None:
    _, plan = make_plan(TOYS, "picture", GIVEN, frozenset({"object"}))
    (item,) = plan.left_out
    assert (item.effect, item.reason, item.error_bound) == ("glow", "no lamp", 3.0)


def test_what_nothing_reads_is_culled_without_a_reason() -> None:
    _, plan = make_plan(TOYS, "render", GIVEN, frozenset({"object", "lamp"}))
    assert plan.run == ("render",)
    assert plan.left_out == ()


def test_given_resources_are_not_made() -> None:
    order, _ = make_plan(TOYS, "picture", {**GIVEN, "shade": "ready"}, frozenset({"object"}))
    assert names(order) == ["picture"]
    assert execute(order, {**GIVEN, "shade": "ready"}, "picture") == "picture(c, ready, -)"


def test_shared_effect_runs_once() -> None:
    calls = []

    def base(camera: str) -> str:
        calls.append("base")
        return camera

    def left(base: str) -> str:
        return base

    def right(base: str) -> str:
        return base

    def both(left: str, right: str) -> str:
        return left + right

    toys: list[Toy] = [Effect(f, writes=f.__name__) for f in (both, left, right, base)]
    order, _ = make_plan(toys, "both", GIVEN, frozenset())
    assert names(order) == ["base", "left", "right", "both"]
    assert execute(order, GIVEN, "both") == "cc"
    assert calls == ["base"]


def test_cycle_is_named() -> None:
    def chicken(egg: str) -> str:
        return egg

    def egg(chicken: str) -> str:
        return chicken

    with pytest.raises(PlanError, match="chicken -> egg -> chicken"):
        make_plan([Effect(chicken, writes="chicken"), Effect(egg, writes="egg")], "chicken", (), frozenset())


def test_missing_writer_is_named() -> None:
    with pytest.raises(PlanError, match="nothing writes 'light', wanted by 'shade'"):
        make_plan(TOYS, "picture", {"camera"}, frozenset({"object"}))
    with pytest.raises(PlanError, match="nothing writes 'sound', wanted by 'the caller'"):
        make_plan(TOYS, "sound", GIVEN, frozenset())


def test_needed_effect_must_not_be_left_out() -> None:
    with pytest.raises(PlanError, match="nothing writes 'render', wanted by 'shade'"):
        make_plan(
            [TOYS[2], Effect(render, writes="render", omitted=unless("never"))], "shade", GIVEN, frozenset({"object"})
        )


def test_two_writers_are_refused() -> None:
    with pytest.raises(PlanError, match="two effects write"):
        make_plan([*TOYS, Effect(glow, writes="shade")], "picture", GIVEN, frozenset())


# ---- what may be left out as needless ----------------------------------------------------------------------------


def hidden(bound: float, reason: str = "hardly seen") -> Callable[[frozenset[str]], CullReason | None]:
    """Needless, whatever the facts are."""
    return lambda _facts: CullReason(reason, bound)


def test_needless_effects_run_where_everything_is_asked_for() -> None:
    toys = [TOYS[0], Effect(glow, "glow", needless=hidden(0.4)), *TOYS[2:]]
    facts = frozenset({"object"})
    order, plan = make_plan(toys, "picture", GIVEN, facts)
    assert names(order) == ["render", "shade", "picture"]
    assert [(item.effect, item.error_bound) for item in plan.left_out] == [("glow", 0.4)]
    order, plan = make_plan(toys, "picture", GIVEN, facts, everything=True)
    assert names(order) == ["render", "shade", "glow", "picture"]
    assert plan.left_out == ()


def test_what_was_asked_for_is_left_out_of_everything_too() -> None:
    toys = [TOYS[0], Effect(glow, "glow", omitted=hidden(255.0), needless=hidden(0.1)), *TOYS[2:]]
    for everything, bound in ((False, 0.1), (True, 255.0)):
        _, plan = make_plan(toys, "picture", GIVEN, frozenset({"object"}), everything=everything)
        assert [(item.effect, item.error_bound) for item in plan.left_out] == [("glow", bound)]


@pytest.mark.parametrize(
    ("bounds", "reasons", "left_out"),
    [
        ((0.4, 0.4), "ab", {"glow", "shade"}),
        ((0.6, 0.6), "ab", {"shade"}),  # the first to be asked for
        ((1.1, 0.6), "ab", {"glow"}),
        ((0.6, 0.6), "aa", {"glow", "shade"}),  # one omission, of both
        ((1.1, 1.1), "aa", set()),
    ],
)
def test_omissions_share_one_allowance(bounds: tuple[float, float], reasons: str, left_out: set[str]) -> None:
    toys = [
        Effect(picture, "picture"),
        Effect(shade, "shade", needless=hidden(bounds[0], reasons[0])),
        Effect(glow, "glow", needless=hidden(bounds[1], reasons[1])),
        Effect(render, "render"),
    ]
    _, plan = make_plan(toys, "picture", GIVEN, frozenset())
    assert {item.effect for item in plan.left_out} == left_out
    assert sum({item.reason: item.error_bound or 0.0 for item in plan.left_out}.values()) <= ALLOWANCE


# ---- the real table ----------------------------------------------------------------------------------------------

KNOWN = Averages(picture=0.2, shading=0.5, samples=9)
DRAWN = {"rasterize", "cover", "composite"}
SHADED = DRAWN | {"prepare_rays", "add_objects", "shade_virtual"}
BOUNDED = Brightness(picture=0.9, arriving=2.0, shading=1.0, object_sent=0.8, real_sent=0.9)
ASKED = {
    "refine_virtual": "does not refine",
    "refine_real": "does not refine",
    "light_objects": "no indirect",
    "light_samples": "no indirect",
    "bounce_real": "no indirect",
}
SOFT = dict.fromkeys(("direct_virtual", "direct_real", "shadow_map", "light_samples"), "soft")
TRACED = {"look_around": "traces rays"}
LIT = ("shade_virtual", "reflect", "match_average", "direct_virtual", "refine_virtual")
OF_REAL = ("shadow_real", "bounce_real", "direct_real", "refine_real", "find_reach")
SPARED = {"shadow_everywhere": "hardly change the rest"}


@pytest.mark.parametrize(
    ("facts", "run", "reasons"),
    [
        (
            SceneFacts(objects=0, objects_in_view=0, has_light=True, reach=NOWHERE),
            {"composite"},
            dict.fromkeys(("rasterize", "cover", *LIT, *OF_REAL), "there is no virtual object"),
        ),
        (
            SceneFacts(objects=2, objects_in_view=0, has_light=True),
            {
                "prepare_rays",
                "shadow_real",
                "find_reach",
                "composite",
            },  # what is out of view may still cast a shadow into it
            {**ASKED, **SOFT, **TRACED, **SPARED, "light_samples": "no indirect"}
            | dict.fromkeys(("rasterize", "cover", *LIT), "in view"),
        ),
        (
            SceneFacts(objects=2, objects_in_view=0, has_light=True, reach=NOWHERE, brightness=BOUNDED),
            {"composite"},
            dict.fromkeys(("rasterize", "cover", *LIT), "in view") | dict.fromkeys(OF_REAL, "hardly change"),
        ),
        (
            SceneFacts(objects=1, objects_in_view=1, has_light=False),
            DRAWN,
            dict.fromkeys((*LIT, *OF_REAL), "no light") | {"reflect": "glossy"},
        ),
        (
            SceneFacts(objects=1, objects_in_view=1, has_light=True),
            SHADED | {"shadow_real", "find_reach"},
            {**SOFT, **ASKED, **SPARED, **TRACED, "reflect": "glossy", "match_average": "own scale"},
        ),
        (
            SceneFacts(objects=1, objects_in_view=1, has_light=True, averages=Averages(0.0, 1.0, 9)),
            SHADED | {"shadow_real", "find_reach"},
            {**SOFT, **ASKED, **SPARED, **TRACED, "reflect": "glossy", "match_average": "empty or black"},
        ),
        (
            SceneFacts(
                objects=1,
                objects_in_view=1,
                has_light=True,
                adaptive=True,
                indirect=True,
                sharp_lights=1,
                averages=KNOWN,
                brightness=BOUNDED,
                reach=NOWHERE,
            ),
            SHADED | {"light_objects", "refine_virtual", "match_average", "shadow_map", "direct_virtual"},
            {**TRACED, "reflect": "glossy"} | dict.fromkeys(OF_REAL, "hardly change"),
        ),
        (
            SceneFacts(
                objects=1,
                objects_in_view=1,
                has_light=True,
                adaptive=True,
                indirect=True,
                image_space=True,
                glossy=True,
                sharp_lights=1,
                averages=KNOWN,
            ),
            {effect.name for effect in effects_of("picture")} - SPARED.keys(),
            SPARED,
        ),
    ],
)
def test_effects_of_a_scene(facts: SceneFacts, run: set[str], reasons: dict[str, str]) -> None:
    order, plan = make_plan(EFFECTS, "picture", EFFECTS_GIVEN, facts)
    assert set(plan.run) == run
    assert plan.run[-1] == "composite"
    made = set(EFFECTS_GIVEN)
    for effect in order:  # everything an effect reads is there before it
        assert set(effect.reads) - effect.optional <= made
        made.add(effect.writes)
    assert {item.effect: item.reason for item in plan.left_out}.keys() == reasons.keys()
    for item in plan.left_out:
        assert reasons[item.effect] in item.reason
        is_asked = any(w in item.reason for w in ("asked", "no light", "black"))
        assert item.error_bound == (255.0 if is_asked else ELSEWHERE if item.effect in SPARED else 0.0)


def test_a_layer_calls_for_what_a_picture_does() -> None:
    facts = SceneFacts(objects=1, objects_in_view=1, has_light=True)
    (_, of_picture), (_, of_layer) = (make_plan(EFFECTS, end, EFFECTS_GIVEN, facts) for end in ("picture", "layer"))
    assert of_picture.run[-1] == "composite"
    assert of_layer.run[-1] == "compose_layer"
    assert of_picture.run[:-1] == of_layer.run[:-1]
    assert of_picture.left_out == of_layer.left_out


def test_what_rest_may_change_leaves_nothing_to_spare() -> None:
    facts = SceneFacts(objects=1, objects_in_view=1, has_light=True)
    for bound, everywhere in ((1.0, True), (1.0 - ELSEWHERE, False)):
        stages = {"estimate_light": CullReason("nothing has changed", bound)}
        _, plan = make_plan(EFFECTS, "picture", EFFECTS_GIVEN, facts, stages=stages)
        assert ("shadow_everywhere" in plan.run) == everywhere
