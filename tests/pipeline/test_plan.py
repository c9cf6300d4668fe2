"""The planner on toy effects, and what the real table of effects runs for each kind of scene."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from server.effects import EFFECTS, SceneFacts
from server.pipeline import _GIVEN
from server.plan import Effect, Omission, PlanError, execute, make_plan
from server.stages.tone_mapping import Averages

Toy = Effect[frozenset[str]]


def unless(called_for: str, bound: float = 0.0) -> Callable[[frozenset[str]], Omission | None]:
    """Left out where the facts do not hold `called_for`."""
    return lambda facts: None if called_for in facts else Omission(f"no {called_for}", bound)


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


KNOWN = Averages(picture=0.2, shading=0.5, samples=9)

# ---- the real table ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("facts", "run", "reasons"),
    [
        (
            SceneFacts(objects=0, objects_in_view=0, has_light=True),
            {"composite"},
            {
                "rasterize": "no virtual object",
                "cover": "no virtual object",
                "reflect": "no virtual object",
                "match_average": "no virtual object",
                "direct_virtual": "no virtual object",
                "direct_real": "no virtual object",
                "shade_virtual": "no virtual object",
                "shadow_real": "no virtual object",
                "refine_virtual": "no virtual object",
                "refine_real": "no virtual object",
            },
        ),
        (
            SceneFacts(objects=2, objects_in_view=0, has_light=True),
            {"prepare_rays", "shadow_real", "composite"},  # what is out of view may still cast a shadow into it
            {
                "rasterize": "in view",
                "cover": "in view",
                "reflect": "in view",
                "match_average": "in view",
                "direct_virtual": "in view",
                "direct_real": "soft",
                "shadow_map": "soft",
                "light_objects": "left out",
                "shade_virtual": "in view",
                "refine_virtual": "in view",
                "refine_real": "refine",
                "look_around": "traces rays",
            },
        ),
        (
            SceneFacts(objects=1, objects_in_view=1, has_light=False),
            {"rasterize", "cover", "composite"},
            dict.fromkeys(
                (
                    "shade_virtual",
                    "shadow_real",
                    "refine_virtual",
                    "refine_real",
                    "reflect",
                    "match_average",
                    "direct_virtual",
                    "direct_real",
                ),
                "no light",
            ),
        ),
        (
            SceneFacts(objects=1, objects_in_view=1, has_light=True),
            {"rasterize", "cover", "prepare_rays", "add_objects", "shade_virtual", "shadow_real", "composite"},
            {
                "refine_virtual": "does not refine",
                "refine_real": "does not refine",
                "light_objects": "left out",
                "reflect": "glossy",
                "direct_virtual": "soft",
                "direct_real": "soft",
                "shadow_map": "soft",
                "look_around": "traces rays",
                "match_average": "own scale",
            },
        ),
        (
            SceneFacts(objects=1, objects_in_view=1, has_light=True, averages=Averages(0.0, 1.0, 9)),
            {"rasterize", "cover", "prepare_rays", "add_objects", "shade_virtual", "shadow_real", "composite"},
            {
                "refine_virtual": "does not refine",
                "refine_real": "does not refine",
                "light_objects": "left out",
                "reflect": "glossy",
                "direct_virtual": "soft",
                "direct_real": "soft",
                "shadow_map": "soft",
                "look_around": "traces rays",
                "match_average": "empty or black",
            },
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
            {
                "rasterize",
                "cover",
                "shadow_map",
                "direct_virtual",
                "direct_real",
                "look_around",
                "prepare_rays",
                "light_objects",
                "add_objects",
                "reflect",
                "shade_virtual",
                "refine_virtual",
                "shadow_real",
                "refine_real",
                "match_average",
                "composite",
            },
            {},
        ),
    ],
)
def test_effects_of_a_scene(facts: SceneFacts, run: set[str], reasons: dict[str, str]) -> None:
    order, plan = make_plan(EFFECTS, "picture", _GIVEN, facts)
    assert set(plan.run) == run
    assert plan.run[-1] == "composite"
    made = set(_GIVEN)
    for effect in order:  # everything an effect reads is there before it
        assert set(effect.reads) - effect.optional <= made
        made.add(effect.writes)
    assert {item.effect for item in plan.left_out} == set(reasons)
    for item in plan.left_out:
        assert reasons[item.effect] in item.reason
        assert item.error_bound is not None
        assert item.error_bound == (0.0 if any(word in item.reason for word in ("object", "soft", "traces")) else 255.0)
