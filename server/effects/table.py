"""The table of effects: which functions there are, and the scenes that do not call for each."""

from __future__ import annotations

from typing import Literal

from server.culling import rules as o
from server.culling.reason import CullReason
from server.culling.scene_facts import SceneFacts
from server.effects.functions import (
    add_objects,
    bounce_real,
    compose_layer,
    composite,
    cover,
    direct_real,
    direct_virtual,
    find_reach,
    light_objects,
    light_samples,
    look_around,
    match_average,
    mixture,
    prepare_rays,
    rasterize,
    refine_real,
    refine_virtual,
    reflect,
    shade_virtual,
    shadow_everywhere,
    shadow_map,
    shadow_real,
)
from server.effects.plan import Effect

Answer = Literal["picture", "layer", "light"]
"""What a frame is answered by: `wishes.answer`."""


def _shades_virtual(facts: SceneFacts) -> CullReason | None:
    return o.out_of_view(facts) or o.unlit(facts)


EFFECTS: tuple[Effect[SceneFacts], ...] = (
    Effect(rasterize, "virtual", o.no_object, o.out_of_view),
    Effect(cover, "coverage", lambda f: o.no_object(f) or o.hard_edges(f), o.out_of_view),
    Effect(look_around, "looks", lambda f: o.no_object(f) or o.traced(f)),
    Effect(prepare_rays, "scene", lambda f: o.no_object(f) or o.no_light(f)),
    Effect(shadow_map, "maps", lambda f: o.no_object(f) or o.no_light(f) or o.soft(f)),
    Effect(light_objects, "glow", lambda f: o.no_object(f) or o.no_light(f) or o.no_indirect(f), o.dark_things),
    Effect(add_objects, "changed_scene", lambda f: o.no_object(f) or o.no_light(f)),
    Effect(reflect, "reflected", lambda f: o.no_object(f) or o.no_light(f), lambda f: _shades_virtual(f) or o.matt(f)),
    Effect(shade_virtual, "occluded", lambda f: o.no_object(f) or o.no_light(f), _shades_virtual),
    Effect(shadow_real, "ratio", lambda f: o.no_object(f) or o.no_light(f), o.out_of_reach),
    Effect(light_samples, "samples", lambda f: o.no_object(f) or o.no_light(f) or o.no_indirect(f) or o.soft(f)),
    Effect(
        bounce_real,
        "bounced",
        lambda f: o.no_object(f) or o.no_light(f) or o.no_indirect(f),
        lambda f: o.out_of_reach(f) or o.nothing_bounces(f),
    ),
    Effect(
        refine_virtual,
        "refined_occluded",
        lambda f: o.no_object(f) or o.no_light(f) or o.not_refined(f),
        _shades_virtual,
    ),
    Effect(
        refine_real,
        "refined_ratio",
        lambda f: o.no_object(f) or o.no_light(f) or o.not_refined(f),
        lambda f: o.out_of_reach(f) or o.no_rims(f),
    ),
    Effect(shadow_everywhere, "everywhere", needless=o.hardly_changed),
    Effect(find_reach, "reached", lambda f: o.no_object(f) or o.no_light(f), o.out_of_reach),
    Effect(direct_virtual, "lit_virtual", lambda f: o.no_object(f) or o.no_light(f) or o.soft(f), _shades_virtual),
    Effect(direct_real, "whole_ratio", lambda f: o.no_object(f) or o.no_light(f) or o.soft(f), o.out_of_reach),
    Effect(match_average, "gain", lambda f: o.no_object(f) or o.no_light(f) or o.not_matched(f), _shades_virtual),
    Effect(composite, "picture", through=mixture),
    Effect(compose_layer, "layer", through=mixture),
)
"""One writer a resource; what a frame wants is one of the last two."""


def effects_of(answer: Answer) -> tuple[Effect[SceneFacts], ...]:
    """All but the one that another answer than this ends with."""
    ends = {"picture": "layer", "layer": "picture"}
    return tuple(effect for effect in EFFECTS if effect.writes != ends.get(answer))
