"""Culling rules: when a scene does not need an effect, and a bound on the change by leaving it out.

Bounds are in display units, codes of 1/255 before rounding. Two inequalities turn radiance into them; f is sRGB's
encoding times 255, which is concave with f(0) = 0:

- for a radiance that changes by at most d: |f(x + d) - f(x)| <= f(d);
- for a radiance of at most 1 (display white) that is multiplied by 1 + b or 1 - b:
  |f(x (1 +- b)) - f(x)| <= f(1) - f(1 - b). Where f is 269 x^(1/2.4) - 14 the difference grows with x; where it is
  straight, too; and by concavity it is greater downwards than upwards.

A pixel that an object partly covers mixes two surfaces; its change lies between theirs.
"""

from __future__ import annotations

import math

from server.culling.reason import ALLOWANCE, CullReason
from server.culling.scene_facts import SceneFacts

SHOWN = 255.0
"""Bound of an effect that a setting switches off: any change."""


def codes(radiance: float) -> float:
    """f: display units of linear radiance, not rounded; 255 from 1 on."""
    x = min(max(radiance, 0.0), 1.0)
    return float(SHOWN * (12.92 * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055))


def codes_of_share(share: float) -> float:
    """f(1) - f(1 - b)."""
    if share <= 0.0:
        return 0.0
    return SHOWN - codes(1.0 - share) if share < 1.0 else SHOWN


ELSEWHERE = 0.5
"""Allowed change, in display units, of pixels that are treated as unchanged by virtual objects."""


ELSEWHERE_BOUNCED = 0.25
"""Share of it that is allowed for light that bounces off real surface."""


def share_of_codes(bound: float) -> float:
    """The greatest share whose codes_of_share is at most `bound` (0 to 255, where f is not straight)."""
    return float(1.0 - ((1.0 - bound / SHOWN + 0.055) / 1.055) ** 2.4)


# ---- reasons for which an input of the effects is absent -----------------------------------------------------------

NO_OBJECT = CullReason("there is no virtual object", 0.0)
NO_LIGHT = CullReason("no light has been found yet", SHOWN)
NO_INDIRECT = CullReason("asked for: no indirect light", SHOWN)
TRACED = CullReason("the preset traces rays through the volume", 0.0)
OWN_SCALE = CullReason("asked for: virtual things keep the light's own scale", SHOWN)
NOTHING_TO_MATCH = CullReason("the picture or its shading is empty or black: the light's own scale holds", SHOWN)
SOFT = CullReason("the light is soft", 0.0)
"""Rays carry the whole light: nothing is left for a shadow map."""

# ---- what was switched off ---------------------------------------------------------------------------------------


def no_indirect(facts: SceneFacts) -> CullReason | None:
    """A wish."""
    return None if facts.indirect else NO_INDIRECT


def not_refined(facts: SceneFacts) -> CullReason | None:
    """A preset's."""
    return None if facts.adaptive else CullReason("asked for: the preset does not refine", SHOWN)


# ---- what would hardly be seen ------------------------------------------------------------------------------------


def out_of_view(facts: SceneFacts) -> CullReason | None:
    """The pixel boxes of all objects are empty: no pixel shows an object."""
    return None if facts.objects_in_view else CullReason("no virtual object is in view", 0.0)


def unlit(facts: SceneFacts) -> CullReason | None:
    """Virtual surface of no more than the base colour 1 sends no more than what shading it can have (times the gain);
    without any shading it sends nothing: f(gain max(shading, arriving)); shading takes in what surfaces send."""
    lit = max(facts.brightness.shading, facts.brightness.arriving)
    return _if_bounded("hardly any light reaches virtual things", codes(facts.gain * lit))


def matt(facts: SceneFacts) -> CullReason | None:
    """Where nothing is glossy reflect.cl gives 0 and leaves the diffuse light as it is. Else a share s of what arrives
    comes besides and as much of the diffuse light is kept: both are at least 0, so the change is no more than the
    greater: f(gain s max(arriving, sent, shading))."""
    if not facts.glossy:
        return CullReason("no virtual object in view is glossy", 0.0)
    arriving = max(facts.brightness.arriving, facts.brightness.shading, facts.brightness.object_sent)
    if arriving == math.inf:
        return None
    return _if_bounded("what virtual things reflect is hardly seen", codes(facts.gain * facts.reflected * arriving))


def no_influence(facts: SceneFacts) -> CullReason | None:
    """Real surface: R'/R differs from 1 by b at most, and with bounced light by b (1 + k): see influence_bound.cl. The
    picture there is multiplied by it. Virtual surface gets light off real surface that is multiplied by the same; all
    that it gets is not below 0, so it changes by the same share, and by no more than gain b times what real surface
    sends."""
    if math.isinf(facts.influence.change):
        return None
    share = facts.influence.change * (1.0 + (facts.influence.bounced if facts.indirect else 0.0))
    return _if_bounded("virtual things hardly change the light of real surface in view", _codes_of_ratio(facts, share))


def faint_shadows(_facts: SceneFacts) -> CullReason:
    """A pixel of real surface is multiplied by R'/R. Where that differs from 1 by no more than faint_pixel_share, the
    pixel is left as it is (change_mask.cl). Samples where bounced light can change R'/R by no more than
    faint_sample_share get none (bounce_real), and the light that they send to virtual surface changes by as much. Both
    together are ELSEWHERE of the brightest pixel."""
    return CullReason("virtual things hardly change the rest of the picture", ELSEWHERE)


def faint_pixel_share() -> float:
    """Allowed change of a pixel's R'/R."""
    return (1.0 - ELSEWHERE_BOUNCED) * share_of_codes(ELSEWHERE)


def faint_sample_share() -> float:
    """Allowed change of a sample's R'/R."""
    return ELSEWHERE_BOUNCED * share_of_codes(ELSEWHERE)


def dark_things(facts: SceneFacts) -> CullReason | None:
    """What objects send: on real surface a share of R, as above; virtual surface gets no more than gain times it."""
    if math.isinf(facts.influence.sent) and facts.brightness.object_sent > 0:
        return None
    share = facts.influence.sent * (1.0 + facts.influence.bounced) if facts.brightness.object_sent > 0 else 0.0
    on_virtual = codes(facts.gain * facts.brightness.object_sent) if facts.objects_in_view else 0.0
    bound = max(_codes_of_ratio(facts, share), on_virtual)
    return _if_bounded("what virtual things send is hardly seen", bound, ALLOWANCE - ELSEWHERE)


def nothing_bounces(facts: SceneFacts) -> CullReason | None:
    """Bounced light changes R'/R by k times what it bounces off changes: by b at most, or, as no more than all light
    can be hidden, by 1 and what objects send: k min(b, 1 + b of that)."""
    influence = facts.influence
    if math.isinf(influence.bounced):
        return None
    change = min(influence.change, 1.0 + influence.sent)
    share = influence.bounced * change if influence.bounced > 0 else 0.0
    bound = _codes_of_ratio(facts, share)
    return _if_bounded("light that bounces off real surface hardly changes", bound, ALLOWANCE - ELSEWHERE)


def _codes_of_ratio(facts: SceneFacts, share: float) -> float:
    """Of real surface, and of virtual surface that it lights, whose light changes by `share` of itself."""
    if share == 0.0:
        return 0.0
    on_real = codes(min(share * facts.brightness.picture, 1.0))
    on_virtual = codes(min(facts.gain * share * facts.brightness.real_sent, 1.0)) if facts.objects_in_view else 0.0
    return min(codes_of_share(share), max(on_real, on_virtual))


def _if_bounded(reason: str, bound: float, at_most: float = ALLOWANCE) -> CullReason | None:
    """A bound above the allowance is no reason; ALLOWANCE - ELSEWHERE leaves faint_shadows its part."""
    return CullReason(reason, bound) if bound <= at_most else None
