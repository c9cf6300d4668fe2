"""The planner on toy effects, and what the real table of effects runs for each kind of scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NewType

import pytest

from server.culling.influence_bound import NOWHERE
from server.culling.reason import ALLOWANCE, CullReason
from server.culling.rules import ELSEWHERE, NO_INDIRECT, NO_LIGHT, NO_OBJECT, NOTHING_TO_MATCH, OWN_SCALE, SOFT, TRACED
from server.culling.scene_facts import Brightness, SceneFacts
from server.effects.plan import Approximation, Effect, EffectTable, PlanError, make_plan
from server.effects.resources import KnownLight, PictureParts, ReturnedRadiance, SharpLight, VirtualObjects
from server.effects.table import EFFECTS
from server.frame_context import FrameContext
from server.shading.tone_mapping import Averages
from server.shading.traced_scene import DeviceLight
from server.transfer.indirect import Indirect
from server.transfer.radiance_transfer import Transfer
from server.transfer.real_depth_views import RealDepthViews

Camera, Light = NewType("Camera", str), NewType("Light", str)
Rendered, Shaded, Glow = NewType("Rendered", str), NewType("Shaded", str), NewType("Glow", str)
Facts = frozenset[str]


def unless(called_for: str, bound: float = 0.0) -> Callable[[Facts], CullReason | None]:
    """Left out where the facts do not hold `called_for`."""
    return lambda facts: None if called_for in facts else CullReason(f"no {called_for}", bound)


def render(camera: Camera) -> Rendered:
    return Rendered(f"render({camera})")


def shade(render: Rendered, light: Light) -> Shaded:
    return Shaded(f"shade({render}, {light})")


def glow(camera: Camera) -> Glow:
    return Glow(f"glow({camera})")


@dataclass(frozen=True)
class Parts:
    camera: Camera
    shade: Shaded | None = None
    glow: Glow | None = None


@dataclass(frozen=True)
class OnlyRendered:
    render: Rendered | None = None


TOYS: EffectTable[Facts] = EffectTable(
    (
        Effect(glow, disabled_by=(unless("lamp", 3.0),)),
        Effect(shade),
        Effect(render, disabled_by=(unless("object"),)),
    )
)
GIVEN: Mapping[Any, object] = {Camera: "c", Light: "l"}


def names(left_out: Any) -> set[str]:
    return {item.effect for item in left_out}


@pytest.mark.parametrize(
    ("facts", "run", "left_out", "result"),
    [
        ("", [], {"shade", "glow"}, Parts(Camera("c"))),
        ("lamp", ["glow"], {"shade"}, Parts(Camera("c"), None, Glow("glow(c)"))),
        ("object", ["render", "shade"], {"glow"}, Parts(Camera("c"), Shaded("shade(render(c), l)"))),
        (
            "object lamp",
            ["render", "shade", "glow"],
            set(),
            Parts(Camera("c"), Shaded("shade(render(c), l)"), Glow("glow(c)")),
        ),
    ],
)
def test_only_what_is_called_for_runs(facts: str, run: list[str], left_out: set[str], result: Parts) -> None:
    plan = make_plan(TOYS, Parts, GIVEN, frozenset(facts.split()))
    assert list(plan.described().run) == run
    assert names(plan.left_out) == left_out
    assert plan.execute(GIVEN) == result


def test_reasons_and_bounds_are_said() -> None:
    (item,) = make_plan(TOYS, Parts, GIVEN, frozenset({"object"})).left_out
    assert (item.effect, item.reason, item.error_bound) == ("glow", "no lamp", 3.0)


def test_what_a_missing_input_leaves_out_says_the_same_reason() -> None:
    plan = make_plan(TOYS, Parts, GIVEN, frozenset({"lamp"}))
    assert [(item.effect, item.reason) for item in plan.left_out] == [("shade", "no object")]


def test_an_input_that_is_absent_is_the_reason_of_all_that_need_it() -> None:
    dark = CullReason("no light", 255.0)
    plan = make_plan(TOYS, Parts, {**GIVEN, Light: dark}, frozenset({"lamp", "object"}))
    assert [(item.effect, item.reason, item.error_bound) for item in plan.left_out] == [("shade", "no light", 255.0)]
    assert list(plan.described().run) == ["glow"]  # what only the shading would have read does not run
    assert plan.execute({**GIVEN, Light: dark}) == Parts(Camera("c"), None, Glow("glow(c)"))


def test_what_nothing_reads_is_culled_without_a_reason() -> None:
    plan = make_plan(TOYS, OnlyRendered, GIVEN, frozenset({"object", "lamp"}))
    assert plan.described("end").run == ("render", "end")
    assert plan.left_out == ()


def test_given_resources_are_not_made() -> None:
    given = {**GIVEN, Shaded: "ready"}
    plan = make_plan(TOYS, Parts, given, frozenset({"object"}))
    assert plan.order == ()
    assert plan.execute(given) == Parts(Camera("c"), Shaded("ready"))


def test_shared_effect_runs_once() -> None:
    base_type, left_type, right_type = (NewType(name, str) for name in ("Base", "Left", "Right"))
    calls = []

    def base(camera: Camera) -> Any:
        calls.append("base")
        return camera

    def left(base: Any) -> Any:
        return base

    def right(base: Any) -> Any:
        return base

    base.__annotations__ = {"camera": Camera, "return": base_type}
    left.__annotations__ = {"base": base_type, "return": left_type}
    right.__annotations__ = {"base": base_type, "return": right_type}

    @dataclass(frozen=True)
    class Both:
        left: Any
        right: Any

    Both.__annotations__ = {"left": left_type, "right": right_type}
    plan = make_plan(EffectTable((Effect(left), Effect(right), Effect(base))), Both, GIVEN, frozenset())
    assert plan.described().run == ("base", "left", "right")
    assert plan.execute(GIVEN) == Both("c", "c")
    assert calls == ["base"]


def chicken(egg: Glow) -> Shaded:
    return Shaded(egg)


def egg(chicken: Shaded) -> Glow:
    return Glow(chicken)


def test_cycle_is_named() -> None:
    with pytest.raises(PlanError, match="Shaded -> Glow -> Shaded"):
        make_plan(EffectTable((Effect(chicken), Effect(egg))), Parts, GIVEN, frozenset())


def test_missing_writer_is_named() -> None:
    with pytest.raises(PlanError, match="nothing writes Light, wanted by Shaded"):
        make_plan(TOYS, Parts, {Camera: "c"}, frozenset({"object"}))
    with pytest.raises(PlanError, match="nothing writes Camera, wanted by the caller"):
        make_plan(TOYS, Parts, {Light: "l"}, frozenset())


def test_two_writers_are_refused() -> None:
    with pytest.raises(PlanError, match="two effects write"):
        EffectTable((*TOYS.effects, Effect(egg)))


# ---- what may be culled ------------------------------------------------------------------------------------------


def hidden(bound: float, reason: str = "hardly seen") -> Callable[[Facts], CullReason | None]:
    """A bound, whatever the facts are."""
    return lambda _facts: CullReason(reason, bound)


def test_culled_effects_run_where_everything_is_asked_for() -> None:
    table = EffectTable((Effect(glow, culled_by=(hidden(0.4),)), *TOYS.effects[1:]))
    plan = make_plan(table, Parts, GIVEN, frozenset({"object"}))
    assert plan.described().run == ("render", "shade")
    assert [(item.effect, item.error_bound) for item in plan.left_out] == [("glow", 0.4)]
    plan = make_plan(table, Parts, GIVEN, frozenset({"object"}), everything=True)
    assert plan.described().run == ("render", "shade", "glow")
    assert plan.left_out == ()


def test_what_was_switched_off_is_left_out_of_everything_too() -> None:
    effect = Effect(glow, disabled_by=(hidden(255.0),), culled_by=(hidden(0.1),))
    for everything in (False, True):
        plan = make_plan(
            EffectTable((effect, *TOYS.effects[1:])), Parts, GIVEN, frozenset({"object"}), everything=everything
        )
        assert [(item.effect, item.error_bound) for item in plan.left_out] == [("glow", 255.0)]


@pytest.mark.parametrize(
    ("bounds", "reasons", "left_out"),
    [
        ((0.4, 0.4), "ab", {"glow", "shade"}),
        ((0.6, 0.6), "ab", {"shade"}),  # the first to be asked for
        ((1.1, 0.6), "ab", {"glow"}),
        ((0.6, 0.6), "aa", {"glow", "shade"}),  # one reason, of both
        ((1.1, 1.1), "aa", set()),
    ],
)
def test_bounds_share_one_allowance(bounds: tuple[float, float], reasons: str, left_out: set[str]) -> None:
    table = EffectTable(
        (
            Effect(shade, culled_by=(hidden(bounds[0], reasons[0]),)),
            Effect(glow, culled_by=(hidden(bounds[1], reasons[1]),)),
            Effect(render),
        )
    )
    plan = make_plan(table, Parts, GIVEN, frozenset())
    assert names(plan.left_out) == left_out
    assert sum({item.reason: item.error_bound or 0.0 for item in plan.left_out}.values()) <= ALLOWANCE


@dataclass(frozen=True)
class Fineness:
    value: int


def refined_glow(camera: Camera, fineness: Fineness) -> Glow:
    return Glow(f"{camera}{fineness.value}")


@pytest.mark.parametrize(("spent", "everything", "value"), [(0.0, False, 1), (0.7, False, 2), (0.0, True, 2)])
def test_the_coarse_value_is_taken_where_its_bound_fits(spent: float, everything: bool, value: int) -> None:
    choice: Approximation[Facts] = Approximation(
        "coarse_glow", Fineness(2), Fineness(1), lambda _facts: CullReason("hardly seen", 0.5)
    )
    table = EffectTable((Effect(refined_glow), *TOYS.effects[1:]), (choice,))
    stages = {"a stage": CullReason("spent before", spent)} if spent else {}
    plan = make_plan(table, Parts, GIVEN, frozenset(), everything=everything, stages=stages)
    assert plan.execute(GIVEN).glow == f"c{value}"
    assert ("coarse_glow" in names(plan.left_out)) == (value == 1)


# ---- the real table ----------------------------------------------------------------------------------------------

DRAWN = {"rasterize"}
SHADED = DRAWN | {"prepare_rays", "add_objects", "shade_virtual"}
BOUNDED = Brightness(picture=0.9, arriving=2.0, shading=1.0, object_sent=0.8, real_sent=0.9)
ASKED = {
    "refine_virtual": "does not refine",
    "refine_real": "does not refine",
    "light_objects": "no indirect",
    "light_samples": "no indirect",
    "bounce_real": "no indirect",
}
SOFT_LIGHT = dict.fromkeys(("direct_virtual", "direct_real", "light_samples"), "soft")
BY_RAYS = {"draw_depth_views": "traces rays"}
LIT = ("shade_virtual", "reflect", "match_average", "direct_virtual", "refine_virtual")
OF_REAL = ("shadow_real", "bounce_real", "direct_real", "refine_real", "mark_changes")
FAINT = {"faint_shadows": "hardly change the rest"}
ALL: dict[Any, object] = dict.fromkeys(
    (
        FrameContext,
        DeviceLight,
        VirtualObjects,
        KnownLight,
        SharpLight,
        RealDepthViews,
        Transfer,
        Indirect,
        ReturnedRadiance,
        Averages,
    ),
    "there",
)
PLAIN: dict[Any, object] = {SharpLight: SOFT, RealDepthViews: TRACED, Indirect: NO_INDIRECT}
"""A soft light, traced, without indirect light."""


@pytest.mark.parametrize(
    ("absent", "facts", "run", "reasons"),
    [
        (
            {**PLAIN, VirtualObjects: NO_OBJECT, Transfer: NO_OBJECT, Averages: OWN_SCALE},
            SceneFacts(objects_in_view=0, influence=NOWHERE, brightness=BOUNDED),
            set(),
            {
                "rasterize": "there is no virtual object",
                **dict.fromkeys(("shade_virtual", "refine_virtual", "reflect"), ""),
                **dict.fromkeys(("shadow_real", "bounce_real", "refine_real", "mark_changes"), ""),
                **dict.fromkeys(("direct_virtual", "direct_real"), ""),
                "match_average": "own scale",
            },
        ),
        (
            {**PLAIN, Averages: OWN_SCALE},
            SceneFacts(objects_in_view=0),
            {"prepare_rays", "shadow_real", "mark_changes"},  # what is out of view may cast a shadow into it
            {
                **ASKED,
                **SOFT_LIGHT,
                **BY_RAYS,
                **FAINT,
                "light_samples": "no indirect",
                "match_average": "own scale",
                "refine_virtual": "does not refine",
            }
            | dict.fromkeys(("rasterize", "shade_virtual"), "in view")
            | {"reflect": "", "direct_virtual": ""},
        ),
        (
            {},
            SceneFacts(objects_in_view=0, adaptive=True, indirect=True, influence=NOWHERE, brightness=BOUNDED),
            set(),
            dict.fromkeys(("rasterize", *LIT), "in view")
            | dict.fromkeys(OF_REAL, "hardly change")
            | {"reflect": "", "refine_real": ""},
        ),
        (
            {**PLAIN, KnownLight: NO_LIGHT, Averages: NOTHING_TO_MATCH},
            SceneFacts(objects_in_view=1),
            DRAWN,
            dict.fromkeys(("shade_virtual", "shadow_real", "mark_changes"), "no light")
            | dict.fromkeys(("refine_virtual", "refine_real"), "does not refine")
            | {"direct_virtual": "soft", "direct_real": "no light"}
            | {"bounce_real": "no indirect", "reflect": "glossy", "match_average": "empty or black"},
        ),
        (
            {**PLAIN, Averages: OWN_SCALE},
            SceneFacts(objects_in_view=1),
            SHADED | {"shadow_real", "mark_changes"},
            {**SOFT_LIGHT, **ASKED, **FAINT, **BY_RAYS, "reflect": "glossy", "match_average": "own scale"},
        ),
        (
            {RealDepthViews: TRACED},
            SceneFacts(objects_in_view=1, adaptive=True, indirect=True, brightness=BOUNDED, influence=NOWHERE),
            SHADED | {"light_objects", "refine_virtual", "match_average", "shadow_map", "direct_virtual"},
            {**BY_RAYS, "reflect": "glossy"}
            | dict.fromkeys((*OF_REAL, "first_shadow"), "hardly change")
            | {"refine_real": ""},
        ),
        (
            {},
            SceneFacts(objects_in_view=1, adaptive=True, indirect=True, glossy=True),
            {effect.name for effect in EFFECTS.effects},
            FAINT,
        ),
    ],
)
def test_effects_of_a_scene(
    absent: dict[Any, object], facts: SceneFacts, run: set[str], reasons: dict[str, str]
) -> None:
    """Where two reasons hold, either may be said: "" stands for any."""
    plan = make_plan(EFFECTS, PictureParts, {**ALL, **absent}, facts)
    assert set(plan.described().run) == run
    made = ALL.keys() | plan.chosen.keys()
    for effect in plan.order:  # everything an effect reads is there before it
        assert {read.resource for read in effect.reads if not read.is_optional} <= made
        made.add(effect.writes)
    assert names(plan.left_out) == reasons.keys()
    for item in plan.left_out:
        assert reasons[item.effect] in item.reason
        is_asked = any(w in item.reason for w in ("asked", "no light", "black"))
        assert item.error_bound == (255.0 if is_asked else ELSEWHERE if item.effect in FAINT else 0.0)


def test_every_input_is_made_or_given() -> None:
    """A plan of everything asks for every resource that any effect reads."""
    facts = SceneFacts(objects_in_view=1, adaptive=True, indirect=True, glossy=True)
    plan = make_plan(EFFECTS, PictureParts, ALL, facts, everything=True)
    assert set(plan.order) == set(EFFECTS.effects)
    assert plan.left_out == ()


def test_what_reuse_may_change_leaves_nothing_to_spare() -> None:
    facts = SceneFacts(objects_in_view=1)
    for bound, is_coarse in ((1.0, False), (1.0 - ELSEWHERE, True)):
        stages = {"estimate_light": CullReason("nothing has changed", bound)}
        plan = make_plan(EFFECTS, PictureParts, {**ALL, **PLAIN}, facts, stages=stages)
        assert ("faint_shadows" in names(plan.left_out)) == is_coarse
