"""`probeless explain`: the plan of one frame in words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from client.commands.run import Run
from client.errors import OptionError
from client.gallery.play import play, wishes_of
from client.gallery.source import GallerySource
from client.options.capture import Capture
from protocol.messages import LeftOut, Plan, Wishes
from server.culling.rules import SHOWN
from server.opencl.device import open_device
from server.reuse.temporal_reuse import ECHO, NOISE
from server.transfer.kept_bounds import MEASURED

PURPOSES = {
    "rasterize": "draws the virtual objects",
    "draw_depth_views": "draws the depth views for visibility look-up",
    "prepare_rays": "prepares the geometry that rays are traced through",
    "shadow_map": "draws shadow maps of the objects for the dominant lights",
    "first_shadow": "computes the shadows that virtual objects are lit in, for bounced light",
    "light_objects": "lights the objects, for bounced light on real surfaces and on each other",
    "light_samples": "computes the dominant lights on real surfaces",
    "shadow_real": "computes shadows of virtual objects on real surfaces",
    "bounce_real": "computes how these shadows change bounced light between real surfaces",
    "add_objects": "updates the room that virtual objects are lit by with their own effect on it",
    "reflect": "computes reflections on glossy virtual objects",
    "shade_virtual": "computes shadows on virtual objects, of real surfaces and of each other",
    "refine_virtual": "refines shadows on virtual objects near edges",
    "refine_real": "refines shadow edges on real surfaces",
    "mark_changes": "finds the parts of the picture in which virtual objects change real surfaces",
    "direct_virtual": "lights virtual objects by the dominant lights",
    "direct_real": "adds sharp shadows of virtual objects on real surfaces",
    "match_average": "matches the average brightness of virtual objects to the picture",
    "composite": "puts the picture together",
    "compose_layer": "puts the virtual content together, without the camera's picture",
}
LEAD_FRAMES = 4
"""Frames processed before the explained one, so that a light is estimated."""


def explain(capture: Capture, frame: int | None, device_name: str | None) -> Iterator[str]:
    """Lines that describe the plan of the frame at position `frame`; default: the fifth, or the last of fewer.

    Raises OptionError for a frame outside of the source, and the errors of Run.
    """
    frames = capture.frames
    chosen = min(frames.start + LEAD_FRAMES, frames[-1]) if frame is None else frame
    if chosen not in frames:
        raise OptionError(f"--frame {chosen}: the source has frames {frames.start}:{frames.stop}")
    yield from lines(f"{capture.source.name}, frame {chosen}", _plan_of(capture, chosen, device_name))


def _plan_of(capture: Capture, chosen: int, device_name: str | None) -> Plan:
    if isinstance(capture.source, GallerySource) and not capture.objects:
        return _gallery_plan(capture.source, capture.wishes, chosen, device_name)
    notes: list[str] = []
    led = range(max(capture.frames.start, chosen - LEAD_FRAMES), chosen + 1)
    with Run(replace(capture, frames=led), device_name, notes.append) as run:
        *_, last = run.outputs()
    return last.plan


def _gallery_plan(source: GallerySource, requested: Wishes, chosen: int, device_name: str | None) -> Plan:
    """The plan of a gallery scene with its own objects and light."""
    wishes = wishes_of(
        source, preset=requested.preset, plan=requested.plan, indirect=requested.indirect, edges=requested.edges
    )
    results = play(open_device(device_name), source, wishes)
    plans = [result.plan for _, (_, result) in zip(range(chosen + 1), results, strict=False)]
    results.close()
    return plans[-1]


def lines(title: str, plan: Plan) -> Iterator[str]:
    """A plan as lines, one per effect."""
    unseen = [left for left in plan.left_out if is_unseen(left)]
    reasons = {(left.reason, left.error_bound) for left in unseen}  # each counts once
    most = sum(bound or 0.0 for _, bound in reasons)
    yield f"{title}: {len(plan.run)} effects run, {len(plan.left_out)} are left out."
    width = max(map(len, (*plan.run, *(left.effect for left in plan.left_out))))
    if plan.point is not None:
        yield f"Sampled with {plan.point.settings}: {plan.point.reason}."
    yield "Runs:"
    for name in plan.run:
        yield f"  {name:{width}}  {PURPOSES.get(name, '')}".rstrip()
    if plan.left_out:
        yield "Left out:"
    for left in plan.left_out:
        yield f"  {left.effect:{width}}  {left.reason} ({_bound(left)})"
    which = "at most one pixel in a thousand" if any(map(is_of_noise, unseen)) else "no pixel"
    yield f"Together, effects left out as invisible change {which} by more than {most:.2f}/255, before rounding."


def is_unseen(left: LeftOut) -> bool:
    """Whether the effect was left out because its change is invisible, not by an option or a missing resource."""
    return left.error_bound is not None and left.error_bound <= 1.0


def is_of_noise(left: LeftOut) -> bool:
    """Whether its bound holds for all but a thousandth of the pixels."""
    return left.reason in (NOISE, ECHO) or left.reason.endswith(MEASURED)


def _bound(left: LeftOut) -> str:
    if left.error_bound is None:
        return "change unknown"
    if left.error_bound == 0:
        return "changes nothing"
    if left.error_bound >= SHOWN:
        return "change not bounded"
    which = "at most one pixel in a thousand" if is_of_noise(left) else "no pixel"
    return f"changes {which} by more than {left.error_bound:.2f}/255"
