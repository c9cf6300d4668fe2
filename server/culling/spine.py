"""Stages of the spine that a frame leaves out: light estimation, and what a still view keeps."""

from __future__ import annotations

from server.culling.reason import CullReason

GIVEN_LIGHT = CullReason("the light is given, and nothing else is learnt from the picture", 0.0)
NO_DEPTH = CullReason("a client without depth adds nothing to the room's light", 0.0)
NOT_SHADED = CullReason("nothing virtual is drawn, and the light is not estimated from transfer", 0.0)
LOST = CullReason("the camera is lost", 255.0)

GEOMETRY_STAGES = ("locate", "raycast", "merge_depth")
"""Stages of geometry that are not run where nothing has changed."""


def spine_left_out(
    reason: CullReason | None,
    echo: CullReason | None,
    *,
    keeps_geometry: bool,
    keeps_transfer: bool,
    needs_transfer: bool,
    light_is_given: bool,
    denoises: bool,
    has_depth: bool,
) -> dict[str, CullReason]:
    """Stages of the spine that a frame leaves out, each with its reason.

    reason: why a still view is kept; None if it is not. echo: frames that the light has not used.
    needs_transfer: whether virtual objects or the light estimate use it. light_is_given: the light is known, and
    nothing else is learnt from the picture.
    """
    left_out: dict[str, CullReason] = {}
    if not needs_transfer:
        left_out["transfer_radiance"] = NOT_SHADED
    if not has_depth:
        left_out["estimate_light"] = NO_DEPTH
    if light_is_given:
        left_out["estimate_light"] = GIVEN_LIGHT
        if denoises:
            left_out["denoise"] = GIVEN_LIGHT
    if reason is not None:
        left_out["estimate_light"] = reason
        if keeps_geometry:
            left_out |= dict.fromkeys(GEOMETRY_STAGES, reason)
        if keeps_transfer:
            left_out["transfer_radiance"] = reason
    elif echo is not None:
        left_out["light_of_still_frames"] = echo
    return left_out
