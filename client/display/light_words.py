"""The light in words: where it comes from, and what is not known of it."""

from __future__ import annotations

from protocol.limits import VALID_SPREAD_DEG
from protocol.messages import ArrivingLight, Light

GUESS = "no scanned surface is seen from there, its light is a guess"


def light_line(light: Light) -> str:
    """Direction and intensity of the light from beyond the scan, in one line."""
    x, y, z = light.dominant_direction
    lamps = f", lamps in the room: {len(light.lamps)}" if light.lamps else ""
    doubt = _doubt(light.spread_deg, light.valid)
    sure = f", {doubt}" if doubt is not None else ""
    return f"from ({x:+.2f}, {y:+.2f}, {z:+.2f}), intensity {light.dominant_intensity:.2g}{lamps}{sure}"


def unknown_lines(light: Light) -> list[str]:
    """What is not known of the light at places; places of which the same is not known share a line."""
    places: dict[str, list[str]] = {}
    for arriving in light.at:
        doubt = GUESS if arriving.seen == 0 else _doubt(arriving.spread_deg, arriving.valid)
        if doubt is not None:
            places.setdefault(doubt, []).append(_name(arriving))
    return [f"at {', '.join(names)}: {doubt}" for doubt, names in places.items()]


def light_lines(light: Light) -> list[str]:
    """All that is said after the last frame."""
    return [f"light {light_line(light)}", *(f"light {line}" for line in unknown_lines(light))]


def _doubt(spread_deg: float | None, is_valid: bool) -> str | None:
    """None: the direction is known, and how well."""
    if spread_deg is None:
        return "how far its direction may be off is not known" if is_valid else "not fixed by the pictures so far"
    if spread_deg > VALID_SPREAD_DEG:
        return f"its direction may be off by {spread_deg:.0f} degrees"
    return None


def _name(arriving: ArrivingLight) -> str:
    if arriving.of == "view":
        return "the middle of the view"
    x, y, z = arriving.position
    return f"{arriving.of} {arriving.index + 1} ({x:.2f}, {y:.2f}, {z:.2f})"
