"""The table of effects: which functions there are, and the scenes that do not call for each."""

from __future__ import annotations

from typing import Literal

from server.culling import rules
from server.culling.scene_facts import SceneFacts
from server.effects import functions as f
from server.effects.plan import Approximation, Effect, EffectTable
from server.effects.resources import FaintShadows

Answer = Literal["picture", "layer", "light"]
"""What a frame is answered by: `wishes.answer`."""

FAINT_SHADOWS: Approximation[SceneFacts] = Approximation(
    "faint_shadows",
    exact=FaintShadows(0.0, 0.0),
    coarse=FaintShadows(rules.faint_pixel_share(), rules.faint_sample_share()),
    bound=rules.faint_shadows,
)

EFFECTS: EffectTable[SceneFacts] = EffectTable(
    (
        Effect(f.rasterize, culled_by=(rules.out_of_view,)),
        Effect(f.draw_depth_views),
        Effect(f.prepare_rays),
        Effect(f.shadow_map),
        Effect(f.first_shadow, disabled_by=(rules.no_indirect,), culled_by=(rules.no_influence,)),
        Effect(f.light_objects, disabled_by=(rules.no_indirect,), culled_by=(rules.dark_things,)),
        Effect(f.light_samples, disabled_by=(rules.no_indirect,)),
        Effect(f.add_objects),
        Effect(f.reflect, culled_by=(rules.unlit, rules.matt)),
        Effect(f.shade_virtual, culled_by=(rules.unlit,)),
        Effect(f.shadow_real, culled_by=(rules.no_influence,)),
        Effect(f.bounce_real, disabled_by=(rules.no_indirect,), culled_by=(rules.nothing_bounces,)),
        Effect(f.refine_virtual, disabled_by=(rules.not_refined,), culled_by=(rules.unlit,)),
        Effect(f.refine_real, disabled_by=(rules.not_refined,)),
        Effect(f.mark_changes),
        Effect(f.direct_virtual, culled_by=(rules.unlit,)),
        Effect(f.direct_real),
        Effect(f.match_average, culled_by=(rules.out_of_view, rules.unlit)),
    ),
    (FAINT_SHADOWS,),
)
"""Everything that leads to PictureParts. A frame ends with one of the next two, or both."""

COMPOSITE, COMPOSE_LAYER = "composite", "compose_layer"


def effect_names(answer: Answer) -> tuple[str, ...]:
    """Names of all effects that a frame with this answer can run, in the order of the table."""
    end = COMPOSE_LAYER if answer == "layer" else COMPOSITE
    return (*(effect.name for effect in EFFECTS.effects), end)
